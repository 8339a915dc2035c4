"""One control interval: actuation, motion, averages and reward terms."""

from typing import NamedTuple

from sd_friction_env.kernel.automaton import follow
from sd_friction_env.kernel.codes import FORCE, OK, UNKNOWN
from sd_friction_env.kernel.compilation import entry, in_lanes
from sd_friction_env.kernel.plant import Drive, State
from sd_friction_env.kernel.slip import UNTRIED


class Actuator(NamedTuple):
    """What an action in [-1, 1] does over an interval, and what it costs.

    FORCE: u = authority * action. BELT_SPEED: the belt heads for (1 + authority * action) * belt_speed at no more than
    a_limit, evenly over the interval.
    """

    kind: int
    authority: float
    a_limit: float
    belt_speed: float
    interval: float
    w_effort: float
    w_stick: float


class Averages(NamedTuple):
    """Means over an interval, and the reward terms (all <= 0)."""

    mean_v2: float
    stick_fraction: float
    friction_power: float  # of the contact force
    control_power: float  # of the control force
    vibration: float
    effort: float
    stick: float


@in_lanes
def actuation(kind, authority, a_limit, belt_speed, interval, v_belt, action):
    """Return the force and the belt's acceleration that an action in [-1, 1] means."""
    if kind == FORCE:
        return authority * action, 0.0
    target = (1.0 + authority * action) * belt_speed
    return 0.0, min(max((target - v_belt) / interval, -a_limit), a_limit)


@in_lanes
def interval_averages(x, x_end, int_v2, stick_time, int_fv, action, u, belt_speed, interval, w_effort, w_stick):
    """Return the means over an interval and the reward terms."""
    mean_v2 = int_v2 / interval
    stick_fraction = stick_time / interval
    return Averages(
        mean_v2,
        stick_fraction,
        int_fv / interval,
        u * (x_end - x) / interval,
        -mean_v2 / (belt_speed * belt_speed),
        -w_effort * (action * action),
        -w_stick * stick_fraction,
    )


@entry
def control_intervals(plant, actuator, x, v, v_belt, action, x_end, v_end, v_belt_end, reward):
    """Apply actions in [-1, 1] to n independent states for one control interval.

    Arrays are of shape (n,); the last four take what comes out. Return how many ended with a status other than OK.
    """
    kind, authority, a_limit, belt_speed, interval, w_effort, w_stick = actuator
    failures = 0
    for i in range(len(x)):
        u, a_belt = actuation(kind, authority, a_limit, belt_speed, interval, v_belt[i], action[i])
        drive = Drive(v_belt[i], a_belt, u)
        end = follow(plant, UNKNOWN, State(x[i], v[i]), drive, interval, None, UNTRIED)
        averages = interval_averages(
            x[i], end.x, end.int_v2, end.stick_time, end.int_fv, action[i], u, belt_speed, interval, w_effort, w_stick
        )
        x_end[i] = end.x
        v_end[i] = end.v
        v_belt_end[i] = end.v_belt
        reward[i] = averages.vibration + averages.effort + averages.stick
        if end.status != OK:
            failures += 1
    return failures
