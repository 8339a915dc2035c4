"""Classical controllers, each tuned on a task's own objective, and kept with the command that tuned them.

The objective is the mean return over the validation episodes: what the agents are trained for, and never the episodes
of the report. It may prefer a controller that runs the belt slow to one that suppresses the vibration; the share of
suppressed episodes is kept beside it.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import scipy.linalg
import scipy.optimize
from numpy.typing import NDArray

import sd_friction_env
from agents import evaluation
from sd_friction_env import ENVIRONMENT_IDS, SDFrictionEnv
from sd_friction_env.policies import (
    DelayedFeedback,
    FilteredFeedback,
    LinearFeedback,
    Policy,
    Readings,
    SlidingMode,
    VelocityFeedback,
)
from sd_friction_env.tables import atomic_file

GAINS_FILE = Path(__file__).parent / "classical.json"
TUNING_SEEDS = evaluation.VALIDATION_SEEDS[:32]

_DIFFERENCE = 1e-5


@dataclass(frozen=True)
class Kind:
    """A kind of controller and what is tuned of it.

    Attributes:
        build: makes it from an environment and the tuned values, in the order of ``bounds``.
        bounds: of each value, by name.
        needs_velocity: whether it needs the sensor "state" (else: it is for the sensors that see x alone, or all).
        everywhere: whether it is for both kinds of sensors.
    """

    build: Callable[[SDFrictionEnv, Sequence[float]], Policy]
    bounds: Callable[[SDFrictionEnv], dict[str, tuple[float, float]]]
    needs_velocity: bool = True
    everywhere: bool = False


def _linear(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    return LinearFeedback.from_env(env, values[:-1], values[-1])


def _velocity(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    return VelocityFeedback.from_env(env, values[0])


def _lqr(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    return LinearFeedback.from_env(env, lqr_gains(env, *(10.0**value for value in values)))


def _filtered(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    return FilteredFeedback.from_env(env, x_gain=values[0], v_gain=values[1], pole=values[2], bias=values[3])


def _filtered_sliding(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    slope, layer, pole, amplitude = values
    steep = -np.sign(amplitude) / 10.0**layer
    return FilteredFeedback.from_env(env, x_gain=steep * slope, v_gain=steep, pole=pole, amplitude=abs(amplitude))


def _delayed(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    return DelayedFeedback.from_env(env, gain=values[0], delay=max(1, round(values[1])))


def _sliding(env: SDFrictionEnv, values: Sequence[float]) -> Policy:
    slope, layer, amplitude = values
    return SlidingMode.from_env(env, slope=slope, layer=10.0**layer, amplitude=amplitude)


_GAIN = (-60.0, 60.0)
_LAYER = (-4.0, 1.0)
_BIAS = (-6.0, 6.0)
KINDS: dict[str, Kind] = {
    "velocity feedback": Kind(_velocity, lambda env: {"gain": (-5.0, 5.0)}),
    "linear state feedback": Kind(
        _linear, lambda env: {**dict.fromkeys(Readings.from_env(env).names, _GAIN), "bias": _BIAS}
    ),
    "LQR": Kind(_lqr, lambda env: {"log10 weight of x": (-4.0, 4.0), "log10 weight of the action": (-4.0, 4.0)}),
    "sliding mode": Kind(_sliding, lambda env: {"slope": (-3.0, 3.0), "log10 layer": _LAYER, "amplitude": (-1.0, 1.0)}),
    "delayed displacement feedback": Kind(
        _delayed, lambda env: {"gain": (-300.0, 300.0), "delay": (1.0, 100.0)}, needs_velocity=False, everywhere=True
    ),
    "linear feedback, velocity estimated": Kind(
        _filtered,
        lambda env: {"x gain": _GAIN, "v gain": _GAIN, "pole": (0.0, 0.99), "bias": _BIAS},
        needs_velocity=False,
    ),
    "sliding mode, velocity estimated": Kind(
        _filtered_sliding,
        lambda env: {"slope": (-3.0, 3.0), "log10 layer": _LAYER, "pole": (0.0, 0.99), "amplitude": (-1.0, 1.0)},
        needs_velocity=False,
    ),
}


def kinds_for(env_id: str) -> list[str]:
    """Return the names of the controllers that an environment's sensor allows."""
    sees = evaluation.make_env(env_id).task.sensor == "state"
    return [name for name, kind in KINDS.items() if kind.everywhere or kind.needs_velocity == sees]


# LQR ------------------------------------------------------------------------------------------------------------------


def linearised(env: SDFrictionEnv) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return A, shape (k, k), and B, shape (k, 1), of the nominal plant's step about its steady-slip equilibrium.

    The state is what a controller reads (see ``Readings.names``); differences of the environment's own step, so that
    the hold over an interval and the belt's inertia are in them.
    """
    readings = Readings.from_env(env)
    k = len(readings.names)
    speed, plant = env.nominal.belt_speed, dataclasses.asdict(env.nominal)

    def step(deviation: NDArray[np.float64], action: float) -> NDArray[np.float64]:
        start = {"x": readings.x_equilibrium + deviation[0], "v": deviation[1]}
        env.reset(seed=0, options=start | {"parameters": plant})
        if k == 3:
            env.set_state(dataclasses.replace(env.get_state(), v_belt=speed + readings.authority * deviation[2]))
        _, _, _, _, info = env.step(np.array([action]))
        end = [info["x"] - readings.x_equilibrium, info["v"], (info["v_belt"] - speed) / readings.authority]
        return np.array(end[:k])

    h = _DIFFERENCE
    a = np.stack([(step(h * e, 0.0) - step(-h * e, 0.0)) / (2.0 * h) for e in np.eye(k)], axis=1)
    # The action is float32 in use, not here.
    b = (step(np.zeros(k), h) - step(np.zeros(k), -h)) / (2.0 * h)
    return a, b[:, None]


def lqr_gains(env: SDFrictionEnv, x_weight: float, action_weight: float) -> tuple[float, ...]:
    """Return the gains of the linear-quadratic regulator at the nominal plant's steady-slip equilibrium.

    The cost of a step is that of the task, v^2/v_b^2 + action_weight w_effort a^2, and x_weight x^2.

    Raises:
        ValueError: if the sensor does not see the velocity.
    """
    if not Readings.from_env(env).sees_velocity:
        raise ValueError("LQR needs the velocity, and this environment's sensor sees the position only")
    a, b = linearised(env)
    q = np.diag([x_weight, 1.0 / env.nominal.belt_speed**2, 0.0][: len(a)])
    r = np.array([[action_weight * max(env.task.w_effort, 1e-6)]])
    p = scipy.linalg.solve_discrete_are(a, b, q, r)
    gains = -np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
    return tuple(gains[0].tolist())


# Tuning ---------------------------------------------------------------------------------------------------------------


@functools.cache
def _nominal_env(env_id: str) -> SDFrictionEnv:
    return evaluation.make_env(env_id)


def build(name: str, env_id: str, values: Sequence[float]) -> Policy:
    """Return a controller with the values that :func:`tune` tunes."""
    return KINDS[name].build(_nominal_env(env_id), values)


def tune(
    name: str,
    env_id: str,
    *,
    seed: int = 0,
    generations: int = 50,
    population: int = 12,
    progress: Callable[[float, float], None] = lambda best, share: None,
) -> dict[str, Any]:
    """Return the best values of a controller that differential evolution finds, and what they came to.

    Args:
        name: in ``kinds_for(env_id)``. seed: of the search. generations, population: of SciPy's
            ``differential_evolution``, the population per tuned value.
        progress: told the best mean return so far and the share of the generations done.
    """
    bounds = KINDS[name].bounds(_nominal_env(env_id))
    best = -np.inf
    done = 0

    def cost(values: NDArray[np.float64]) -> float:
        nonlocal best
        try:
            controller = build(name, env_id, values.tolist())
        except np.linalg.LinAlgError:  # no regulator for such weights
            return np.inf
        episodes = evaluation.run_episodes(controller, env_id, TUNING_SEEDS)
        mean = float(np.nansum(episodes.reward, axis=1).mean())
        best = max(best, mean)
        return -mean

    def told(*_: Any) -> None:
        nonlocal done
        done += 1
        progress(best, done / generations)

    found = scipy.optimize.differential_evolution(
        cost,
        scipy.optimize.Bounds(*np.transpose(list(bounds.values()))),
        maxiter=generations,
        popsize=population,
        rng=seed,
        tol=1e-6,
        polish=False,
        callback=told,
    )
    values = [float(value) for value in found.x]
    table = evaluation.evaluate(build(name, env_id, values), env_id, evaluation.VALIDATION_SEEDS)
    return {
        "values": dict(zip(bounds, values, strict=True)),
        "tuning_return": -float(found.fun),
        "validation_return": float(table["return"].mean()),
        "suppressed": float(table["suppressed"].mean()),
        "seed": seed,
        "evaluations": int(found.nfev),
    }


def versions() -> dict[str, str]:
    """Return the versions of what tunes."""
    return {"sd_friction_env": sd_friction_env.__version__, "numpy": np.__version__, "scipy": scipy.__version__}


def stored_gains(path: Path | None = None) -> dict[str, dict[str, Any]]:
    """Return what is stored: by environment id and controller, what :func:`tune` returned and the command.

    Args:
        path: of the file; None: the one that comes with the project.

    Raises:
        ValueError: if the file is not one of ours.
    """
    path = GAINS_FILE if path is None else path
    if not path.exists():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        gains: dict[str, dict[str, Any]] = content["gains"]
        for env_id, controllers in gains.items():
            for name, found in controllers.items():
                if env_id not in ENVIRONMENT_IDS or name not in KINDS:
                    raise ValueError(f"{env_id}: {name}")
                if set(found["values"]) != set(KINDS[name].bounds(_nominal_env(env_id))):
                    raise ValueError(f"{env_id}: {name}: {sorted(found['values'])}")
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{str(path)!r} does not hold gains of classical controllers ({error})") from None
    return gains


def store(gains: Mapping[str, Any], path: Path | None = None) -> None:
    """Write gains, whole or not at all."""
    with atomic_file(GAINS_FILE if path is None else path) as file:
        json.dump({"versions": versions(), "gains": gains}, file, indent=1)
        file.write("\n")


def classical_controllers(env_id: str, path: Path | None = None) -> dict[str, Policy]:
    """Return the tuned controllers of an environment by name.

    Args:
        env_id: its id. path: of the gains, as :func:`stored_gains` takes it.

    Raises:
        ValueError: if none is stored for it, or the file is not one of ours.
    """
    env_id = env_id.rpartition(":")[2]
    found = stored_gains(path).get(env_id)
    if not found:
        raise ValueError(f"no tuned controllers are stored for {env_id!r}: run scripts/tune_classical.py")
    return {
        name: build(name, env_id, [entry["values"][key] for key in KINDS[name].bounds(_nominal_env(env_id))])
        for name, entry in found.items()
    }
