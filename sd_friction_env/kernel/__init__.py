"""The oscillator's laws, its slip/stick automaton and the event-exact step, compiled once and cached.

Everything is dimensionless (physics of the paper's Eqs. 4-10). Floats and NamedTuples go in and come out, nothing is
raised: functions return a status. The same text runs interpreted with ``NUMBA_DISABLE_JIT=1`` and gives the same bits,
so powers are written as products and step sizes change by factors of two only.

The slip phase is integrated by the eighth-order Runge-Kutta formula of Dormand and Prince under one rule for every
caller: the estimated error of a step of length h stays under ``TOLERANCE`` h. A step is first tried over all of what is
asked for, then halved until the rule holds. In slip the sign of the relative velocity is frozen, so that the vector
field is smooth up to and across the surface v = v_belt, and events are located by repeating the last step with another
length.

Each file imports from those before it: batch - lanes - interval - automaton - slip, stick - events - runge_kutta -
forces - springs, friction, excitation - plant - codes.
"""

from sd_friction_env.kernel.automaton import *
from sd_friction_env.kernel.batch import *
from sd_friction_env.kernel.codes import *
from sd_friction_env.kernel.control_gradients import *
from sd_friction_env.kernel.episodes import *
from sd_friction_env.kernel.events import *
from sd_friction_env.kernel.excitation import *
from sd_friction_env.kernel.forces import *
from sd_friction_env.kernel.friction.asymmetric import *
from sd_friction_env.kernel.friction.coulomb import *
from sd_friction_env.kernel.friction.exponential import *
from sd_friction_env.kernel.friction.gaussian import *
from sd_friction_env.kernel.friction.hyperbolic import *
from sd_friction_env.kernel.friction.scaled import *
from sd_friction_env.kernel.friction.stribeck import *
from sd_friction_env.kernel.friction.tabulated import *
from sd_friction_env.kernel.interval import *
from sd_friction_env.kernel.laws import FRICTION, OPTIONAL, SPRING, friction_law, spring_law
from sd_friction_env.kernel.leaves import *
from sd_friction_env.kernel.memory import *
from sd_friction_env.kernel.plant import *
from sd_friction_env.kernel.random import *
from sd_friction_env.kernel.return_map import *
from sd_friction_env.kernel.rows import *
from sd_friction_env.kernel.runge_kutta import *
from sd_friction_env.kernel.sensitivity import *
from sd_friction_env.kernel.slip import *
from sd_friction_env.kernel.springs.cubic import *
from sd_friction_env.kernel.springs.discontinuous import *
from sd_friction_env.kernel.springs.duffing import *
from sd_friction_env.kernel.springs.inclined import *
from sd_friction_env.kernel.springs.linear import *
from sd_friction_env.kernel.springs.scaled import *
from sd_friction_env.kernel.stick import *
from sd_friction_env.kernel.stroboscope import *
from sd_friction_env.kernel.traps import *
from sd_friction_env.kernel.variation import *
