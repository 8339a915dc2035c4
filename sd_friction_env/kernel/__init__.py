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

from sd_friction_env.kernel.automaton import Motion, Trace, advance, excitation_work, mode_of, trace
from sd_friction_env.kernel.batch import Steppers, arrays_in, fill_plant, memory_size, steppers
from sd_friction_env.kernel.codes import (
    BELT_SPEED,
    BREAKAWAY,
    CONTACT_LOSS,
    CONTACT_LOST,
    CROSSING,
    EVENT_LIMIT,
    EVENT_NAMES,
    FORCE,
    GRAZING,
    MAX_EVENTS,
    MAX_SLIP_STEP,
    OK,
    RESTICK,
    SLIP_BACKWARD,
    SLIP_FORWARD,
    STATUS_NAMES,
    STEP_LIMIT,
    STEP_SIZE_UNDERFLOW,
    STICK,
    STIFF,
    SWITCHING,
    TIME_ZERO,
    TOLERANCE,
    TURNING,
    UNKNOWN,
    V_REL_ZERO,
)
from sd_friction_env.kernel.episodes import (
    CYCLE_POINTS,
    blank_episodes,
    cycle_points,
    cycle_state,
    episode_statistics,
    first_bad,
    left_alone,
    observe_one,
    unexcited,
)
from sd_friction_env.kernel.events import Look
from sd_friction_env.kernel.excitation import Excitation, Unexcited
from sd_friction_env.kernel.forces import (
    breakaway_mode,
    energy_in_spring,
    friction_coefficient,
    friction_curvature,
    friction_slope,
    friction_third_derivative,
    mode_at_zero_v_rel,
    normal_curvature,
    normal_force,
    normal_slope,
    potential,
    restoring_curvature,
    restoring_force,
    restoring_slope,
    slip_acceleration,
    slip_jerk,
    stick_limit,
    stick_load,
)
from sd_friction_env.kernel.friction.asymmetric import Asymmetric
from sd_friction_env.kernel.friction.coulomb import Coulomb
from sd_friction_env.kernel.friction.exponential import Exponential
from sd_friction_env.kernel.friction.gaussian import Gaussian
from sd_friction_env.kernel.friction.hyperbolic import Hyperbolic
from sd_friction_env.kernel.friction.scaled import ScaledFriction
from sd_friction_env.kernel.friction.stribeck import Stribeck
from sd_friction_env.kernel.friction.tabulated import Tabulated
from sd_friction_env.kernel.interval import Actuator, Interval, control_interval, control_intervals
from sd_friction_env.kernel.laws import FRICTION, SPRING, friction_law, spring_law
from sd_friction_env.kernel.leaves import leaf_names, leaves_of, shape_of, tables_of
from sd_friction_env.kernel.plant import Drive, Plant, State, at_time, drive_at, select_field, steady
from sd_friction_env.kernel.random import random_normal, random_uniform, random_uniforms
from sd_friction_env.kernel.return_map import (
    AT_EQUILIBRIUM,
    AT_REST,
    ORBIT_LOST_CONTACT,
    ORBIT_UNDECIDED,
    REPEATED_BREAKAWAY,
    SETTLING_EXITS,
    SETTLING_LAPS,
    TRAP_ROW,
    TRAP_X,
    classify,
    iterate_to_attractor,
    maxima,
    next_maximum,
    slip_returns_to_stick,
    stick_slip_lap,
    trap_extent,
    trap_of,
)
from sd_friction_env.kernel.rows import (
    COUNT_EPISODE,
    COUNT_FIRST_STEP,
    COUNT_KEY,
    COUNT_OVER,
    COUNT_ROWS,
    COUNT_SEEN,
    COUNT_STATUS,
    COUNT_STEPS,
    ENDED,
    LANE_A_BELT,
    LANE_ACTION,
    LANE_BELT_END,
    LANE_CONTACT_LOSS,
    LANE_CONTROL_POWER,
    LANE_EFFORT,
    LANE_EVENTS,
    LANE_FRICTION_POWER,
    LANE_MEAN_V2,
    LANE_MODE,
    LANE_NORMAL,
    LANE_PLANT,
    LANE_STICK,
    LANE_STICK_FRACTION,
    LANE_TIME,
    LANE_U,
    LANE_V_END,
    LANE_V_REL,
    LANE_VIBRATION,
    LANE_X_END,
    LANE_X_MAX,
    LANE_X_MIN,
    LANES,
    RUNNING,
    STATE_BELT,
    STATE_BELT_SPEED,
    STATE_PLANT,
    STATE_RETURN,
    STATE_TRAVEL,
    STATE_V,
    STATE_WORST,
    STATE_X,
    STRIDE,
    TASK_A_LIMIT,
    TASK_ACTUATOR,
    TASK_AUTHORITY,
    TASK_BELT_AUTHORITY,
    TASK_CODES,
    TASK_CONTACT_LOSS_COST,
    TASK_EPISODE_STEPS,
    TASK_FULL_STATE,
    TASK_INTERVAL,
    TASK_LATE_STEPS,
    TASK_LIMIT,
    TASK_NUMBERS,
    TASK_ONE_PLANT,
    TASK_SEES_BELT,
    TASK_SEES_PHASES,
    TASK_SENSOR_DELAY,
    TASK_SENSOR_NOISE,
    TASK_SHOWS,
    TASK_TRAVEL,
    TASK_V_SCALE,
    TASK_W_EFFORT,
    TASK_W_STICK,
    TASK_X_OFFSET,
    TASK_X_SCALE,
)
from sd_friction_env.kernel.runge_kutta import SlipStep, slip_step
from sd_friction_env.kernel.slip import TO_EVENT, UNTRIED, Trial, select_field_in_slip, slip_across, slip_until_event
from sd_friction_env.kernel.springs.cubic import Cubic
from sd_friction_env.kernel.springs.discontinuous import Discontinuous
from sd_friction_env.kernel.springs.duffing import Duffing
from sd_friction_env.kernel.springs.inclined import Inclined
from sd_friction_env.kernel.springs.linear import Linear
from sd_friction_env.kernel.springs.scaled import ScaledSpring
from sd_friction_env.kernel.stick import cone_excess, ride_across
from sd_friction_env.kernel.tangent import (
    CYCLE_FORWARD_ARCS,
    CYCLE_MODE,
    CYCLE_ROW,
    CYCLE_STICK_TIME,
    CYCLE_STICKS,
    CYCLE_V,
    CYCLE_X,
    CYCLE_X_MAX,
    CYCLE_X_MIN,
    integrate_with_tangents,
    label_attractors,
    saltation,
    stroboscope,
)
