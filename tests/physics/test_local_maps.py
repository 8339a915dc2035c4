"""The leading term of the map at sliding bifurcations, against the kernel's map and a closed form."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from sd_friction_env import OscillatorParameters
from sd_friction_env.physics.forced import follow_orbit, forced_orbit, sliding_map
from sd_friction_env.physics.forced.branches import OrbitProblem

COULOMB = OscillatorParameters(
    geometry="linear", friction="coulomb", mu_s=0.2, mu_k=0.2, beta=0.05, belt_speed=0.5, force_amplitude=0.1
).replace(force_frequency=1.3)
STRIBECK = OscillatorParameters(alpha=0.7, belt_speed=0.2, force_amplitude=0.12, force_frequency=1.0)
SLOW = COULOMB.replace(belt_speed=0.1, force_amplitude=0.45, force_frequency=0.3)
DUFFING = SLOW.replace(geometry="duffing")
GAUSSIAN = SLOW.replace(friction="gaussian", mu_k=0.1, v_0=1.0, force_amplitude=0.5)
RIPPLED = SLOW.replace(force_amplitude=0.0, ripple_amplitude=0.3, ripple_frequency=0.5)
PULSED = SLOW.replace(stiffness_amplitude=0.1, stiffness_frequency=0.3)
OVER_FORCE = ("force_amplitude", 0.02, 0.8)


def at(kind, p, over):
    """Orbits of a branch at the sliding bifurcations of a kind."""
    branch = follow_orbit(forced_orbit(p), over, points=20)
    found = [orbit for name, orbit in zip(branch.table["kind"], branch.orbits, strict=True) if name == kind]
    assert found
    return found


def measured(orbit, found, steps):
    """By how much the kernel's map leaves the smooth map, as a polynomial continues it, over d**order."""
    problem = OrbitProblem(orbit, "beta", (0.0, 1.0), found.phase / orbit.multiple)
    y, way = np.array([found.x, found.v, orbit.parameters.beta]), np.append(found.by, 0.0) / (found.by @ found.by)
    nodes = 4e-3 * np.cos(np.pi * (np.arange(12) + 0.5) / 12) - 4.001e-3
    ends = np.array([problem.residual(y + node * way) for node in nodes])
    smooth = [np.polynomial.Chebyshev.fit(nodes, ends[:, column], 9) for column in (0, 1)]
    assert len({problem.sequence(y + node * way) for node in nodes}) == 1
    return np.array([(problem.residual(y + d * way) - [fit(d) for fit in smooth]) / d**found.order for d in steps])


@pytest.mark.parametrize(
    ("kind", "p", "over"),
    [
        ("grazing-sliding", COULOMB, OVER_FORCE),
        ("grazing-sliding", STRIBECK, OVER_FORCE),
        ("grazing-sliding", GAUSSIAN, ("force_frequency", 0.3, 0.35)),
        ("grazing-sliding", PULSED, ("force_amplitude", 0.2, 0.5)),
        ("crossing-sliding", COULOMB, OVER_FORCE),
        ("crossing-sliding", STRIBECK, OVER_FORCE),
        ("switching-sliding", COULOMB, OVER_FORCE),
        ("switching-sliding", STRIBECK, OVER_FORCE),
        ("switching-sliding", DUFFING, ("force_frequency", 0.28, 0.6)),
        ("adding-sliding", SLOW, ("force_frequency", 0.25, 0.45)),
        ("adding-sliding", DUFFING, ("force_frequency", 0.29, 0.5)),
        ("adding-sliding", PULSED, ("force_amplitude", 0.4, 0.6)),
        *(
            (kind, RIPPLED, ("ripple_amplitude", 0.08, 0.49))
            for kind in ("grazing-sliding", "crossing-sliding", "switching-sliding", "adding-sliding")
        ),
    ],
)
def test_the_leading_term_is_that_of_the_kernels_map(kind, p, over):
    for orbit in at(kind, p, over):
        found = sliding_map(orbit)
        assert found.kind == kind
        # The next terms are half an order higher where an arc begins as a square root, else one order.
        power, d = (0.5, 1e-4) if kind in ("grazing-sliding", "adding-sliding") else (1.0, 5e-4)
        steps = d * np.array([1.0, 2.0, 4.0])
        ends = measured(orbit, found, steps)
        size = np.linalg.norm(found.coefficient)
        errors = [np.linalg.norm(end - found.coefficient) / size for end in ends]
        limit = np.polyfit(steps**power, ends, 2)[-1]
        assert errors[0] < 0.8 * errors[1] < 0.64 * errors[2]
        assert np.linalg.norm(limit - found.coefficient) < 1e-3 * size


def test_under_coulomb_friction_the_term_at_a_graze_is_a_matrix_exponential():
    (orbit,) = at("grazing-sliding", COULOMB, ("force_amplitude", 0.1, 0.29))
    found = sliding_map(orbit)
    rate, period, matrix = 1.3, 2.0 * math.pi / 1.3, np.array([[0.0, 1.0], [-1.0, -0.1]])
    graze = -np.angle(1j * rate / (1.0 - rate**2 + 0.1j * rate)) / rate  # where the linear response is fastest
    to_graze = (graze - found.phase * period) % period
    assert found.by == pytest.approx(expm(to_graze * matrix)[1], abs=1e-6)
    assert found.coefficient == pytest.approx(-expm((period - to_graze) * matrix)[:, 1], abs=1e-6)


def test_what_has_no_such_map_is_refused():
    with pytest.raises(TypeError, match="orbit must be a ForcedOrbit"):
        sliding_map(COULOMB)
    with pytest.raises(ValueError, match="orbit must be at one sliding bifurcation"):
        sliding_map(forced_orbit(COULOMB))
    still = SLOW.replace(belt_speed=0.0, force_amplitude=0.4, force_frequency=0.25)  # symmetric: two events at once
    with pytest.raises(ValueError, match="meets two at once"):
        sliding_map(at("adding-sliding", still.replace(force_frequency=0.2), ("force_frequency", 0.16, 0.3))[0])
    with pytest.raises(ValueError, match="friction must be continuous at rest"):
        sliding_map(at("grazing-sliding", COULOMB.replace(mu_s=0.3), ("force_amplitude", 0.05, 0.8))[0])
