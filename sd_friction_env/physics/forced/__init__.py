"""Motion under excitation: stroboscopic sections, periodic orbits, Lyapunov exponents, bifurcation diagrams, basins.

A section is taken once a cycle of the excitation, at a fixed phase. The tangent flow behind exponents and multipliers
has the jumps (saltation) that landing, crossing, breakaway and the switch at x = 0 (alpha = 0) put into it; see Leine
and Nijmeijer (2004), Dynamics and Bifurcations of Non-Smooth Mechanical Systems. A stick leaves one direction of two:
the exponent of the other is minus infinity. Where an event is touched but not passed (grazing) the derivative does not
exist: such events are counted in ``singular_events``, and passed over.
"""

from sd_friction_env.physics.forced.basins import LOST_CONTACT, UNDECIDED, ForcedBasins, forced_basins
from sd_friction_env.physics.forced.branches import OrbitBranch, doubled_orbit, follow_orbit, orbit_branches
from sd_friction_env.physics.forced.diagrams import Direction, bifurcation_diagram, response_curve
from sd_friction_env.physics.forced.exponents import LyapunovExponent, lyapunov_exponent
from sd_friction_env.physics.forced.local_maps import SlidingMap, sliding_map
from sd_friction_env.physics.forced.orbits import ForcedOrbit, forced_orbit
from sd_friction_env.physics.forced.sections import dithered_amplitude, drive_period, poincare_section

__all__ = [
    "LOST_CONTACT",
    "UNDECIDED",
    "Direction",
    "ForcedBasins",
    "ForcedOrbit",
    "LyapunovExponent",
    "OrbitBranch",
    "SlidingMap",
    "bifurcation_diagram",
    "dithered_amplitude",
    "doubled_orbit",
    "drive_period",
    "follow_orbit",
    "forced_basins",
    "forced_orbit",
    "lyapunov_exponent",
    "orbit_branches",
    "poincare_section",
    "response_curve",
    "sliding_map",
]
