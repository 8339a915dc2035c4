"""Classical controllers, each tuned on a task's own objective, and stored with the command that tuned them.

The objective is the mean return over the validation episodes, as in training, and never over the report's episodes. A
controller that runs the belt slow may have a higher return than one that suppresses the vibration; the share of
suppressed episodes is stored with it.
"""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import scipy
import scipy.linalg
import scipy.optimize
from numpy.typing import ArrayLike, NDArray

from sd_friction_env import ENVIRONMENT_IDS, SDFrictionEnv
from sd_friction_env.control.observed import ObservedRule
from sd_friction_env.control.observers import LuenbergerObserver
from sd_friction_env.control.policies import (
    Actions,
    DelayedFeedback,
    Dither,
    EstimatingFollower,
    FilteredFeedback,
    LinearFeedback,
    Policy,
    Readings,
    ScheduledFeedback,
    SlidingMode,
    SoftBelt,
    State,
    SuperTwisting,
    ThresholdFollower,
    VelocityFeedback,
)
from sd_friction_env.control.policies.feedback import nearest_equilibrium
from sd_friction_env.environments.ids import bare_id
from sd_friction_env.environments.jacobian import step_with_jacobian
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation
from sd_friction_env.learning.versions import versions
from sd_friction_env.physics.parameters import OscillatorParameters
from sd_friction_env.storage import AGENTS, locked, predecessor_hint, read_json, write_json

GAINS_FILE = AGENTS / "classical.json"
TUNING_SEEDS = evaluation.VALIDATION_SEEDS[:32]

_SCHEDULED = 11  # belt speeds of a gain schedule
_AT_ONCE = 32  # controllers side by side: more are no faster and need more memory
_AT_BOUND = 0.01  # of a range: a value this close to a bound counts as at it


class NotTunedError(ValueError):
    """No tuned controllers are stored for an environment."""


@dataclass(frozen=True)
class Range:
    """Range of a tuned value, and the scale of its search.

    Attributes:
        low, high: its bounds.
        unit: None: a linear scale; otherwise a symmetric logarithm, asinh(value/unit), which is even in the order of
            magnitude beyond the unit, so that the bounds may be far outside the useful range.
        low_is, high_is: meaning of a value at that bound; "" if the bound is only the end of the search.
    """

    low: float
    high: float
    unit: float | None = None
    low_is: str = ""
    high_is: str = ""

    def to_scale(self, value: float) -> float:
        """Return a value on the scale of the search."""
        return value if self.unit is None else math.asinh(value / self.unit)

    def from_scale(self, searched: float) -> float:
        """Return the value at a place on the scale of the search, within the bounds to the bit."""
        value = searched if self.unit is None else self.unit * math.sinh(searched)
        return min(max(value, self.low), self.high)

    def bound_at(self, value: float) -> str | None:
        """Return "low" or "high" if the value is within 1% of the search's scale of that bound, or None."""
        low, place, high = (self.to_scale(number) for number in (self.low, value, self.high))
        near = _AT_BOUND * (high - low)
        return "low" if place < low + near else "high" if place > high - near else None


@dataclass(frozen=True)
class Kind:
    """A kind of controller and its tuned values.

    Attributes:
        build: from an environment and the tuned values, in the order of ``ranges``.
        ranges: of each value, by name.
        needs_velocity: whether it needs the sensor "state" (otherwise it is for the sensors that see x alone).
        everywhere: whether it is for both kinds of sensors.
        actuator: the only one that it is for, "force" or "belt_speed"; None: both.
    """

    build: Callable[[SDFrictionEnv, Sequence[float]], Policy]
    ranges: Callable[[SDFrictionEnv], dict[str, Range]]
    needs_velocity: bool = True
    everywhere: bool = False
    actuator: str | None = None

    def fits(self, env: SDFrictionEnv) -> bool:
        """Whether the controller is for an environment's sensor and actuator."""
        sensor_fits = self.everywhere or self.needs_velocity == (env.task.sensor == "state")
        return sensor_fits and self.actuator in (None, env.task.actuator)


def _lqr(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    return LinearFeedback.from_env(env, lqr_gains(env, *(10.0**value for value in values)))


def _scheduled_lqr(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    weights = 10.0 ** values[0], 10.0 ** values[1]
    low, high = env.task.randomise.get("belt_speed", (env.nominal.belt_speed,) * 2)
    speeds = np.unique(np.linspace(low, high, _SCHEDULED)).tolist()
    plants = [env.nominal.replace(belt_speed=speed) for speed in speeds]
    gains = [lqr_gains(env, *weights, plant) for plant in plants]
    places = [nearest_equilibrium(plant, Readings.from_env(env).x_offset) for plant in plants]
    return ScheduledFeedback.from_env(env, tuple(speeds), tuple(gains), tuple(places))


def _dither(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    amplitude, period = values
    return Dither.from_env(env, amplitude, 2.0 * math.pi / (period * env.task.control_interval))


def _filtered(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    return FilteredFeedback.from_env(env, x_gain=values[0], v_gain=values[1], pole=values[2], bias=values[3])


def _filtered_sliding(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    slope, layer, pole, amplitude = values
    steep = -np.sign(amplitude) / 10.0**layer
    return FilteredFeedback.from_env(env, x_gain=steep * slope, v_gain=steep, pole=pole, amplitude=abs(amplitude))


def _sliding(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    slope, layer, amplitude = values
    return SlidingMode.from_env(env, slope=slope, layer=10.0**layer, amplitude=amplitude)


def _follower(kind: type[ThresholdFollower], env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    return kind.from_env(env, 10.0 ** values[0], *values[1:])


def _observed(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    gain, threshold, x_gain, v_gain = values
    rule = dataclasses.replace(ThresholdFollower.seeing_all(env), gain=10.0**gain, threshold=threshold)
    return ObservedRule.from_env(env, LuenbergerObserver.from_env(env, x_gain=x_gain, v_gain=v_gain), rule=rule)


def _gain(unit: float) -> Range:
    """Return the range of a gain in units of the gain that turns an observation of 1 into an action of 1.

    Feedback acts as a switch long before 1e4 of them.
    """
    return Range(-1e4 * unit, 1e4 * unit, unit)


def _x_gain(env: SDFrictionEnv) -> Range:
    return _gain(1.0 / Readings.from_env(env).x_scale)


def _v_gain(env: SDFrictionEnv) -> Range:
    return _gain(1.0 / Readings.from_env(env).v_scale)


def _linear_ranges(env: SDFrictionEnv) -> dict[str, Range]:
    gains = (_x_gain(env), _v_gain(env), _BIAS)  # the last for the belt, where it moves
    return {**dict(zip(Readings.from_env(env).names, gains, strict=False)), "bias": _BIAS}


def _slope(env: SDFrictionEnv) -> Range:
    unit = Readings.from_env(env).v_scale / Readings.from_env(env).x_scale
    return Range(-100.0 * unit, 100.0 * unit, unit)


_BIAS = _gain(1.0)
_LAYER = Range(-5.0, 2.0, low_is="a switch", high_is="hardly any feedback")
_POLE = Range(0.0, 0.99, low_is="no smoothing")
_PERIOD = Range(2.0, 200.0, low_is="the fastest that can be held")
_AMPLITUDE = Range(-1.0, 1.0, low_is="all that the actuator gives", high_is="all that the actuator gives")
_DELAY = Range(1.0, 100.0, low_is="the shortest delay there is")
_WEIGHT = Range(-8.0, 8.0)
_SHARE = Range(0.0, 1.0, low_is="no action", high_is="all that the actuator gives")
_SOFT = {
    "log10 inertia": Range(-3.0, 5.0, low_is="no inertia", high_is="a belt that does not yield"),
    "log10 damping": Range(-5.0, 5.0, low_is="no damper", high_is="a belt that does not yield"),
    "log10 stiffness": Range(-6.0, 4.0, low_is="no spring", high_is="a belt that does not yield"),
}
_FOLLOWS = {
    "log10 gain": Range(-2.0, 4.0, low_is="hardly any feedback", high_is="a switch"),
    # Of the slowest belt speed (the nominal one: 2 in the tiers). At 1, rounding decides whether the mass rides the
    # slowest belt.
    "threshold": Range(1.005, 4.0, low_is="just above the slowest belt speed"),
}
_CORRECTIONS = {
    "x correction": Range(0.0, 1.0, high_is="the reading itself"),
    "v correction": Range(0.0, 10.0, low_is="the model finds the velocity by itself"),
}
KINDS: dict[str, Kind] = {
    "velocity feedback": Kind(
        lambda env, values: VelocityFeedback.from_env(env, *values),
        lambda env: {"gain": _gain(Readings.from_env(env).authority / Readings.from_env(env).v_scale)},
    ),
    "linear state feedback": Kind(
        lambda env, values: LinearFeedback.from_env(env, values[:-1], values[-1]), _linear_ranges
    ),
    "LQR": Kind(_lqr, lambda env: {"log10 weight of x": _WEIGHT, "log10 weight of the action": _WEIGHT}),
    "sliding mode": Kind(_sliding, lambda env: {"slope": _slope(env), "log10 layer": _LAYER, "amplitude": _AMPLITUDE}),
    "super-twisting": Kind(
        lambda env, values: SuperTwisting.from_env(env, *values),
        lambda env: {
            "slope": _slope(env),
            "proportional": _gain(Readings.from_env(env).v_scale ** -0.5),
            "integral": _gain(1.0),
        },
    ),
    "LQR, gains scheduled by belt speed": Kind(
        _scheduled_lqr, lambda env: {"log10 weight of x": _WEIGHT, "log10 weight of the action": _WEIGHT}
    ),
    "soft belt": Kind(
        lambda env, values: SoftBelt.from_env(env, *(10.0**value for value in values)),
        lambda env: _SOFT,
        actuator="belt_speed",
    ),
    "dither": Kind(
        _dither,
        lambda env: {"amplitude": _SHARE, "period in control intervals": _PERIOD},
        needs_velocity=False,
        everywhere=True,
    ),
    "delayed displacement feedback": Kind(
        lambda env, values: DelayedFeedback.from_env(env, gain=values[0], delay=max(1, round(values[1]))),
        lambda env: {"gain": _x_gain(env), "delay": _DELAY},
        needs_velocity=False,
        everywhere=True,
    ),
    "linear feedback, velocity estimated": Kind(
        _filtered,
        lambda env: {"x gain": _x_gain(env), "v gain": _v_gain(env), "pole": _POLE, "bias": _BIAS},
        needs_velocity=False,
    ),
    "sliding mode, velocity estimated": Kind(
        _filtered_sliding,
        lambda env: {"slope": _slope(env), "log10 layer": _LAYER, "pole": _POLE, "amplitude": _AMPLITUDE},
        needs_velocity=False,
    ),
    "threshold follower": Kind(
        functools.partial(_follower, ThresholdFollower), lambda env: _FOLLOWS, actuator="belt_speed"
    ),
    "threshold follower, belt speed estimated": Kind(
        functools.partial(_follower, EstimatingFollower), lambda env: _FOLLOWS, actuator="belt_speed"
    ),
    "threshold follower, observer": Kind(
        _observed,
        lambda env: {**_FOLLOWS, **_CORRECTIONS},
        needs_velocity=False,
        actuator="belt_speed",
    ),
}


def kinds_for(env_id: str) -> list[str]:
    """Return the names of the controllers that are for an environment's sensor and actuator."""
    env = make_env(env_id)
    return [name for name, kind in KINDS.items() if kind.fits(env)]


# LQR ------------------------------------------------------------------------------------------------------------------


def linearised(
    env: SDFrictionEnv, plant: OscillatorParameters | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return A, shape (k, k), and B, shape (k, 1), of a plant's step about its steady-slip equilibrium.

    The state is what a controller reads (see ``Readings.names``). The matrices are the exact derivatives of the
    environment's own step, so that they include the hold over an interval and the belt's inertia.

    Args:
        env: the environment. plant: None: its nominal plant.
    """
    plant = env.nominal if plant is None else plant
    readings = Readings.from_env(env)
    at_rest = nearest_equilibrium(plant, readings.x_offset), 0.0, plant.belt_speed
    jacobian = step_with_jacobian(at_rest, 0.0, plant, env.task).jacobian
    k = len(readings.names)
    units = np.array([1.0, 1.0, env.task.belt_authority * plant.belt_speed])[:k]
    return jacobian[:k, :k] * units / units[:, None], jacobian[:k, 3:4] / units[:, None]


def lqr_gains(
    env: SDFrictionEnv, x_weight: float, action_weight: float, plant: OscillatorParameters | None = None
) -> tuple[float, ...]:
    """Return the gains of the linear-quadratic regulator at a plant's steady-slip equilibrium.

    The cost of a step is that of the task, v^2/v_b^2 + action_weight w_effort a^2, and x_weight x^2.

    Args:
        env: the environment. x_weight, action_weight: of the cost. plant: None: the nominal one.

    Raises:
        ValueError: if the sensor does not see the velocity.
    """
    if not Readings.from_env(env).sees_velocity:
        raise ValueError("LQR needs the velocity, and this environment's sensor sees the position only")
    plant = env.nominal if plant is None else plant
    a, b = linearised(env, plant)
    q = np.diag([x_weight, 1.0 / plant.belt_speed**2, 0.0][: len(a)])
    r = np.array([[action_weight * max(env.task.w_effort, 1e-6)]])
    p = scipy.linalg.solve_discrete_are(a, b, q, r)
    gains = -np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
    return tuple(gains[0].tolist())


# Tuning ---------------------------------------------------------------------------------------------------------------


@functools.cache
def _nominal_env(env_id: str) -> SDFrictionEnv:
    return make_env(env_id)


def build(name: str, env_id: str, values: Sequence[float]) -> Policy:
    """Return a controller with the values that :func:`tune` tunes."""
    return KINDS[name].build(_nominal_env(env_id), values)


@dataclass(frozen=True)
class _SideBySide:
    """Several controllers, each for an equal share of the observations, in order."""

    controllers: Sequence[Policy]

    def predict(
        self,
        observation: ArrayLike,
        state: State = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, State]:
        """Return the actions of all, and their states."""
        count = len(self.controllers)
        seen = np.split(np.asarray(observation), count)
        starts = np.split(np.broadcast_to(np.asarray(episode_start, dtype=bool), (len(seen[0]) * count,)), count)
        states = [None] * count if state is None else cast(Any, state)
        predicted = [
            controller.predict(what, before, begun, deterministic)
            for controller, what, before, begun in zip(self.controllers, seen, states, starts, strict=True)
        ]
        return np.concatenate([actions for actions, _ in predicted]), cast(Any, tuple(state for _, state in predicted))


def _mean_returns(controllers: Sequence[Policy], env_id: str) -> NDArray[np.float64]:
    """Return the mean return of each controller over the tuning episodes, all side by side."""
    seeds = list(TUNING_SEEDS) * len(controllers)
    episodes = evaluation.run_episodes(_SideBySide(controllers), env_id, seeds)
    means: NDArray[np.float64] = np.nansum(episodes.reward, axis=1).reshape(-1, len(TUNING_SEEDS)).mean(axis=1)
    return means


def _costs(name: str, env_id: str, candidates: Sequence[Sequence[float]]) -> NDArray[np.float64]:
    """Return minus the mean return of a controller with each candidate's values; infinity where there is none."""
    controllers = {}
    for i, values in enumerate(candidates):
        with contextlib.suppress(np.linalg.LinAlgError):  # these weights have no regulator
            controllers[i] = build(name, env_id, values)
    costs = np.full(len(candidates), np.inf)
    built = list(controllers)
    for some in (built[first : first + _AT_ONCE] for first in range(0, len(built), _AT_ONCE)):
        costs[some] = -_mean_returns([controllers[i] for i in some], env_id)
    return costs


def tune(
    name: str,
    env_id: str,
    *,
    seed: int = 0,
    generations: int = 50,
    population: int = 12,
    progress: Callable[[float, float], None] = lambda best, share: None,
) -> dict[str, Any]:
    """Return the best values of a controller that differential evolution finds, with their results.

    Args:
        name: in ``kinds_for(env_id)``. seed: of the search. generations, population: of SciPy's
            ``differential_evolution``, the population per tuned value.
        progress: called with the best mean return so far and the share of the generations done.
    """
    ranges = KINDS[name].ranges(_nominal_env(env_id))
    best = -np.inf
    done = evaluations = 0

    def values_of(searched: NDArray[np.float64]) -> list[float]:
        return [way.from_scale(place) for way, place in zip(ranges.values(), searched.tolist(), strict=True)]

    def costs(searched: Any) -> Any:
        nonlocal best, evaluations
        evaluations += searched.shape[1]
        found = _costs(name, env_id, [values_of(places) for places in searched.T])
        best = max(best, -float(found.min()))
        return found

    def report(*_: Any) -> None:
        nonlocal done
        done += 1
        progress(best, done / generations)

    found = scipy.optimize.differential_evolution(
        costs,
        scipy.optimize.Bounds(
            [way.to_scale(way.low) for way in ranges.values()], [way.to_scale(way.high) for way in ranges.values()]
        ),
        maxiter=generations,
        popsize=population,
        rng=seed,
        tol=1e-6,
        polish=False,
        vectorized=True,
        updating="deferred",
        callback=report,
    )
    values = dict(zip(ranges, values_of(found.x), strict=True))
    return {
        "values": values,
        **measured(name, env_id, values),
        "at_bound": at_bound(name, env_id, values),
        "seed": seed,
        "evaluations": evaluations,
        "versions": versions(),
    }


def measured(name: str, env_id: str, values: Mapping[str, float]) -> dict[str, float]:
    """Return the results of a controller with these values in the validation episodes."""
    table = evaluation.evaluate(_with(name, env_id, values), env_id, evaluation.VALIDATION_SEEDS)
    return {
        "tuning_return": float(table["return"][: len(TUNING_SEEDS)].mean()),  # those come first
        "validation_return": float(table["return"].mean()),
        "suppressed": float(table["suppressed"].mean()),
    }


def at_bound(name: str, env_id: str, values: Mapping[str, float]) -> dict[str, str]:
    """Return the values at a bound of the search, each with its meaning ("": wider bounds may find a better one)."""
    found = {}
    for key, way in KINDS[name].ranges(_nominal_env(env_id)).items():
        bound = way.bound_at(values[key])
        if bound is not None:
            found[key] = way.low_is if bound == "low" else way.high_is
    return found


def _with(name: str, env_id: str, values: Mapping[str, float]) -> Policy:
    return build(name, env_id, [values[key] for key in KINDS[name].ranges(_nominal_env(env_id))])


def stored_gains(path: Path | None = None) -> dict[str, dict[str, Any]]:
    """Return the stored gains: by environment id and controller, what :func:`tune` returned and the command.

    Args:
        path: of the file; None: the one shipped.

    Raises:
        ValueError: if the file does not hold gains.
    """
    path = GAINS_FILE if path is None else path
    if not path.exists():
        return {}
    try:
        gains: dict[str, dict[str, Any]] = read_json(path)["gains"]
        for env_id, controllers in gains.items():
            for name, found in controllers.items():
                if env_id not in ENVIRONMENT_IDS or name not in KINDS:
                    raise ValueError(f"unknown environment or controller: {env_id}: {name}")
                if set(found["values"]) != set(KINDS[name].ranges(_nominal_env(env_id))):
                    raise ValueError(f"{env_id}: {name}: {sorted(found['values'])}")
                _with(name, env_id, found["values"])
    except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{str(path)!r} does not hold gains of classical controllers ({error}){predecessor_hint(path)}"
        ) from None
    return gains


def keep(env_id: str, name: str, found: Mapping[str, Any], path: Path | None = None) -> dict[str, Any]:
    """Store what :func:`tune` found unless the stored entry is better in the present environment; return the entry that
    is then stored.

    Other entries stay unchanged, also if another process stores at the same time. The file is written whole or not at
    all, and its predecessor is kept as "NAME.previous".

    Raises:
        ValueError: if the file does not hold gains. OSError: if it cannot be written.
    """
    path = GAINS_FILE if path is None else path
    with locked(path.with_name(f".{path.name}.lock"), repr(str(path)), wait=True):
        gains = stored_gains(path)
        before = gains.get(env_id, {}).get(name)
        kept = dict(found)
        if before is not None:
            # Measured again: the environment may have changed since.
            again = measured(name, env_id, before["values"])
            if again["validation_return"] > found["validation_return"]:
                kept = {**before, **again, "at_bound": at_bound(name, env_id, before["values"])}
        gains.setdefault(env_id, {})[name] = kept
        write_json(path, {"gains": gains}, indent=1, keep=True)
    return kept


def classical_controllers(env_id: str, path: Path | None = None) -> dict[str, Policy]:
    """Return the tuned controllers of an environment by name.

    Raises:
        NotTunedError: if none is stored for it. ValueError: if the file does not hold gains.
    """
    env_id = bare_id(env_id)
    found = stored_gains(path).get(env_id)
    if not found:
        raise NotTunedError(f"no tuned controllers are stored for {env_id!r}: run sd-friction tune-classical")
    return {name: _with(name, env_id, entry["values"]) for name, entry in found.items()}


def best_controller(env_id: str) -> tuple[str, Policy]:
    """Return name and controller of an environment's best tuned one: by suppressed share, then by return, both in the
    validation episodes.
    """
    controllers, gains = classical_controllers(env_id), stored_gains()[bare_id(env_id)]
    best = max(controllers, key=lambda name: (gains[name]["suppressed"], gains[name]["validation_return"]))
    return best, controllers[best]
