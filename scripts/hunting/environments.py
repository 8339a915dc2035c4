"""Environments of random legal tasks: single against batch and against the interpreted kernel, and honest infos."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import tests.oracle as oracle
from scripts.hunting import draws
from scripts.hunting.trials import Check, Failure, SetAside
from sd_friction_env import OscillatorParameters, SDFrictionEnv, SDFrictionVectorEnv, kernel
from sd_friction_env.environments.task import RANDOMISABLE
from sd_friction_env.physics.parameters import RANGES, SMALLEST_ALPHA

SIZES = (1, 3, 300, 1100)  # of the last two threads take a share each
STEPS = 7
LANES = 12  # of a batch that are compared, its ends among them
TASKS = 3  # in one interpreted process
_MOMENT = ("v_belt", "v_rel", "normal_force", "time")
_INTEGRALS = ("x_min", "x_max", "mean_square_velocity", "stick_fraction", "friction_power", "control_power")
_REWARDS = ("reward_vibration", "reward_effort", "reward_stick", "reward_contact_loss")


class Episode(NamedTuple):
    """What one trial makes: arguments of the environment, of its first reset, and actions (steps, lanes)."""

    arguments: dict[str, Any]
    seed: int
    starts: list[dict[str, Any]] | None
    actions: NDArray[np.float32]

    def described(self) -> str:
        """Return the call that makes the environment."""
        arguments = {name: value for name, value in self.arguments.items() if name != "parameters"}
        return f"SDFrictionEnv({draws.described(self.arguments['parameters'])}, {draws.keywords(arguments)})"


def randomised(rng: np.random.Generator, p: OscillatorParameters) -> dict[str, tuple[float, float]]:
    """Return ranges for some of a plant's parameters, close to the plant's own values."""
    chosen = {}
    used = draws.fields_used(p.geometry, p.friction) - {"alpha" if p.alpha == 0.0 else ""}
    for name in RANDOMISABLE:
        if name in used and name not in ("mu_s", "mu_m", "mu_k") and rng.random() < 0.3:
            low, high = RANGES[name]
            low = max(low, SMALLEST_ALPHA) if name == "alpha" else low
            value = getattr(p, name)
            chosen[name] = max(low, 0.8 * value), max(low, min(high, 1.25 * value))
    return chosen


def task_arguments(rng: np.random.Generator, p: OscillatorParameters, longest: float) -> dict[str, Any]:
    """Return legal arguments of a task on a plant, over the whole of what is accepted."""
    arguments: dict[str, Any] = {
        "actuator": str(rng.choice(["force", "belt_speed"])),
        "force_limit": draws.number(rng, 0.0, 100.0),
        "belt_authority": draws.number(rng, 0.0, 1.0),
        "belt_acceleration_limit": draws.number(rng, 0.0, 1e6),
        "control_interval": draws.number(rng, 1e-4, longest),
        "episode_steps": int(rng.integers(1, 6)),
        "w_effort": draws.number(rng, 0.0, 1e6),
        "w_stick": draws.number(rng, 0.0, 1e6),
        "start": str(rng.choice(["cycle", "rest", "random"])),
        "kick": draws.signed(rng, 10.0),
        "show_phases": bool(rng.random() < 0.3),
        "sensor": str(rng.choice(["state", "position"])),
        "sensor_noise": draws.number(rng, 0.0, 10.0) if rng.random() < 0.3 else 0.0,
        "sensor_delay": int(rng.integers(0, 4)) if rng.random() < 0.9 else 1000,
        "contact_loss_cost": draws.number(rng, 0.0, 1e6),
        "observation_limit": draws.number(rng, 1e-3, 1e6),
    }
    for name, (low, high) in {"x_offset": (-1e3, 1e3), "x_scale": (1e-6, 1e3), "v_scale": (1e-6, 1e3)}.items():
        if rng.random() < 0.2:
            arguments[name] = draws.number(rng, low, high)
    if rng.random() < 0.3:
        arguments["randomise"] = randomised(rng, p)
        arguments["show_parameters"] = bool(rng.random() < 0.5)
    return arguments


def episode(rng: np.random.Generator, lanes: int, longest: float = 1.0, steps: int = STEPS) -> Episode:
    """Return a random legal task on a random legal plant, starts and actions."""
    p = draws.plant(rng)
    if p.belt_speed == 0.0:
        p = p.replace(belt_speed=RANGES["belt_speed"][1] if rng.random() < 0.3 else 0.01)
    arguments = {"parameters": p, **task_arguments(rng, p, longest)}
    starts = None
    if rng.random() < 0.6:
        starts = []
        for _ in range(lanes):
            at = draws.start(rng, p, arguments["control_interval"])
            v = p.first_belt_speed if rng.random() < 0.2 else at.v
            starts.append({"x": at.x, "v": min(10.0, max(-10.0, v))})
    actions = rng.uniform(-1.2, 1.2, (steps, lanes)).astype(np.float32)
    ends = rng.random((steps, lanes))
    actions[ends < 0.1] = 0.0
    actions[ends > 0.9] = 1.0
    return Episode(arguments, int(rng.integers(2**31)), starts, actions)


def bits(value: Any) -> Any:
    """Return a value such that equal ones are the same to the bit, NaN included."""
    if isinstance(value, float | np.floating):
        return float(value).hex()
    if isinstance(value, np.ndarray):
        return value.tobytes().hex()
    if isinstance(value, Mapping):
        return {name: bits(entry) for name, entry in sorted(value.items())}
    return value.item() if isinstance(value, np.generic) else value


def row_of(observation: Any, *rest: Any) -> dict[str, Any]:
    """Return what a reset (observation, info) or a step of one environment gives, by name."""
    *judged, info = rest
    reward, terminated, truncated = judged or (0.0, False, False)
    ends = {"terminated": bool(terminated), "truncated": bool(truncated)}
    return {"observation": observation, "info": info, "reward": float(reward), **ends}


def single_rollout(made: Episode, lane: int, mode: str) -> list[dict[str, Any]]:
    """Return the rows of the single environment at reset and at each step, as a batch with an autoreset mode has them.

    A step of mode "SameStep" or "Disabled" that ends an episode has ``final``: its row before the reset.
    """
    env = SDFrictionEnv(**made.arguments)
    rows = [row_of(*env.reset(seed=made.seed + lane, options=made.starts[lane] if made.starts else None))]
    over = False
    for action in made.actions[:, lane]:
        if over:
            rows.append(row_of(*env.reset()))
            over = False
            continue
        row = row_of(*env.step(np.array([action])))
        over = row["terminated"] or row["truncated"]
        if over and mode != "NextStep":
            row["final"] = {"observation": row["observation"], "info": row["info"]}
            row["observation"], row["info"] = env.reset()
            over = False
        rows.append(row)
    return rows


def lane_of(info: Mapping[str, Any], lane: int) -> dict[str, Any]:
    """Return the part of a batch's info for one environment."""
    part = {}
    for name, values in info.items():
        if name.startswith("_") or not np.all(info.get(f"_{name}", True)[lane]):
            continue
        part[name] = lane_of(values, lane) if isinstance(values, Mapping) else values[lane]
    return part


def batch_rollout(made: Episode, lanes: list[int], mode: str, threads: int) -> list[list[dict[str, Any]]]:
    """Return the rows of some environments of a batch, as :func:`single_rollout` does for one."""
    n = made.actions.shape[1]
    env = SDFrictionVectorEnv(n, **made.arguments, autoreset_mode=mode, threads=threads, info_keys="all")
    observations, info = env.reset(seed=made.seed, options=made.starts)
    rows = [[row_of(observations[i], lane_of(info, i))] for i in lanes]
    for actions in made.actions:
        observations, rewards, terminated, truncated, info = env.step(actions[:, None])
        over = terminated | truncated
        restarted = (observations, info)
        if mode == "Disabled" and over.any():
            restarted = env.reset(options={"reset_mask": over})
        for place, i in enumerate(lanes):
            row = row_of(observations[i], rewards[i], terminated[i], truncated[i], lane_of(info, i))
            if over[i] and mode == "SameStep":
                row["final"] = {"observation": row["info"].pop("final_obs"), "info": row["info"].pop("final_info")}
            elif over[i] and mode == "Disabled":
                row["final"] = {"observation": row["observation"], "info": row["info"]}
                row["observation"], row["info"] = restarted[0][i], lane_of(restarted[1], i)
            rows[place].append(row)
    return rows


def first_gap(single: list[dict[str, Any]], other: list[dict[str, Any]]) -> str:
    """Return in words where two rollouts differ first in what both say, "" if nowhere."""
    for step, (a, b) in enumerate(zip(single, other, strict=True)):
        for part in ("observation", "reward", "terminated", "truncated", "info", "final"):
            mine, its = a.get(part), b.get(part)
            if isinstance(mine, Mapping) and isinstance(its, Mapping):
                for name in sorted(mine.keys() & its.keys()):
                    if bits(mine[name]) != bits(its[name]):
                        return f"{part}[{name!r}] of step {step}: {mine[name]!r} alone, {its[name]!r} otherwise"
            elif bits(mine) != bits(its):
                return f"{part} of step {step}: {mine!r} alone, {its!r} otherwise"
    return ""


class Batch(NamedTuple):
    """What a trial of batches compares: an episode, the lanes that are looked at, autoreset mode and threads."""

    made: Episode
    lanes: list[int]
    mode: str
    threads: int


def drawn_batch(seed: int, index: int) -> Batch:
    """Return the batch of a trial."""
    rng = draws.generator(seed, index)
    size = int(rng.choice(SIZES, p=[0.35, 0.35, 0.2, 0.1]))
    mode = str(rng.choice(["NextStep", "SameStep", "Disabled"]))
    threads = 1 + int(rng.random() < 0.5)
    made = episode(rng, size, longest=0.3)
    return Batch(made, sorted({0, size - 1, *rng.integers(0, size, LANES - 2).tolist()}), mode, threads)


def described_batch(seed: int, index: int) -> str:
    """Return the call that makes the environment of a trial."""
    return drawn_batch(seed, index).made.described()


def batch_trial(seed: int, index: int) -> None:
    """Compare the single environment with a batch, bit for bit."""
    made, lanes, mode, threads = drawn_batch(seed, index)
    for lane, rows in zip(lanes, batch_rollout(made, lanes, mode, threads), strict=True):
        gap = first_gap(single_rollout(made, lane, mode), rows)
        if gap:
            how = f"{made.actions.shape[1]} environments, lane {lane}, {mode}, {threads} threads, seed {made.seed}"
            raise Failure("batch", f"{gap}\n      {how}, options {made.starts[lane] if made.starts else {}}")


def interpreted_trial(seed: int, index: int) -> None:
    """Compare compiled and interpreted code, bit for bit, single and in a batch of three."""
    command = [sys.executable, "-m", "scripts.hunting.environments", str(seed), str(index)]
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    try:
        done = subprocess.run(command, check=False, env=environment, capture_output=True, text=True, timeout=100.0)
    except subprocess.TimeoutExpired:
        raise SetAside("interpreted, too slow") from None
    if done.returncode:
        raise Failure("interpreted", f"exit status {done.returncode}: {done.stderr[-500:]}")
    its, mine = json.loads(done.stdout), json.loads(json.dumps(fingerprints(seed, index)))
    for a, b in zip(mine, its, strict=True):
        if a != b:
            words = next((f"compiled {x}, interpreted {y}" for x, y in zip(a, b, strict=True) if x != y), "")
            made = interpreted_episode(seed, index, mine.index(a))
            raise Failure("interpreted", f"{words[:600]}\n      {made.described()}, seed {made.seed}, {made.starts}")


def interpreted_episode(seed: int, index: int, which: int) -> Episode:
    """Return one of the tasks that an interpreted process tries: short, and without orbits to find, for it is slow."""
    made = episode(draws.generator(seed, TASKS * index + which), 3, longest=0.02, steps=4)
    found = {"x_offset": 0.1, "x_scale": 0.7, "v_scale": 0.3, "start": "random"}
    return made._replace(arguments={**made.arguments, **found})


def fingerprints(seed: int, index: int) -> list[Any]:
    """Return the bits of what short rollouts give."""
    prints = []
    for which in range(TASKS):
        made = interpreted_episode(seed, index, which)
        rows = [single_rollout(made, 0, "NextStep"), *batch_rollout(made, [0, 1, 2], "NextStep", 1)]
        for lane in rows:
            for row in lane:
                row["info"] = {name: value for name, value in row["info"].items() if name != "parameters"}
        prints.append([bits(row) for lane in rows for row in lane])
    return prints


def drawn_info(seed: int, index: int) -> Episode:
    """Return the task of a trial of infos: of one plant, and no episode ends by itself."""
    made = episode(draws.generator(seed, index), 1)
    return made._replace(arguments={**made.arguments, "randomise": {}, "show_parameters": False, "episode_steps": 1000})


def described_info(seed: int, index: int) -> str:
    """Return the call that makes the environment of a trial."""
    return drawn_info(seed, index).described()


def info_trial(seed: int, index: int) -> None:
    """Check that a step's info tells one moment: the interval's end, or that at which contact was lost."""
    made = drawn_info(seed, index)
    p, interval = made.arguments["parameters"], made.arguments["control_interval"]
    env = SDFrictionEnv(**made.arguments)
    info = env.reset(seed=made.seed, options=made.starts[0] if made.starts else None)[1]
    for step, action in enumerate(made.actions[:, 0]):
        before, state = info, env.get_state()
        _, _, terminated, truncated, info = env.step(np.array([action]))
        drive = kernel.Drive(state.v_belt, info["belt_acceleration"], info["force"])
        plant = kernel.at_time(p.plant, step * interval)
        end = kernel.advance(plant, kernel.State(state.x, state.v), drive, interval, None)
        try:
            check_info(p, before, info, terminated, truncated, step * interval + end.time, end.v_belt)
        except Failure as found:
            raise Failure(found.kind, f"{found.words}; step {step} from {state}, action {float(action)!r}") from None
        if terminated or truncated:
            break


def check_info(
    p: OscillatorParameters,
    before: Mapping[str, Any],
    info: Mapping[str, Any],
    terminated: bool,
    truncated: bool,
    time: float,
    belt: float,
) -> None:
    """Check one step's info against itself and the oracle's forces.

    Raises:
        Failure: if something does not fit.
    """
    # (The statistics of an episode that was too short for them are NaN.)
    told = {name: info[name] for name in ("x", "v", *_MOMENT, *_INTEGRALS, *_REWARDS)}
    status = kernel.STATUS_NAMES.get(info["status"], info["status"])
    wrong = [name for name, value in told.items() if not math.isfinite(value)]
    if wrong:
        raise Failure("info", f"{wrong[0]} = {told[wrong[0]]!r}, status {status}")
    phases = 1e-15 * time * max(p.ripple_frequency, p.stiffness_frequency) + 1e-14
    speed = belt + float(oracle.ripple(p, time)[1])
    size = 1e-12 * max(1.0, abs(info["v"]), abs(speed)) + phases * p.ripple_amplitude
    normal = float(oracle.normal_force(p, info["x"], time))
    loads = 1e-12 * max(p.g1, abs(normal), abs(normal - p.g1)) + phases * abs(normal - p.g1)
    expected = {
        "time": (time, 1e-12 * max(1.0, time)),
        "v_belt": (speed, size),
        "v_rel": (info["v"] - speed, size),
        "normal_force": (normal, loads),
    }
    for name, (value, error) in expected.items():
        if not abs(info[name] - value) <= error:
            words = f"{name} = {info[name]!r}, expected {value!r} at {time!r}, status {status}"
            raise Failure("info of a loss" if status == "contact lost" else "info", words)
    if info["mode"] == 0 and info["v_rel"] != 0.0:
        raise Failure("info", f"stuck with v_rel = {info['v_rel']!r}")
    if info["mode"] * (info["v_rel"] + size * info["mode"]) < 0.0:
        raise Failure("info", f"mode {info['mode']} with v_rel = {info['v_rel']!r}, status {status}")
    if not info["x_min"] <= info["x"] <= info["x_max"]:
        raise Failure("extremes", f"x = {info['x']!r} is not in [{info['x_min']!r}, {info['x_max']!r}]")
    if not info["x_min"] <= before["x"] <= info["x_max"]:
        raise Failure("extremes", f"the x before, {before['x']!r}, is not in [{info['x_min']!r}, {info['x_max']!r}]")
    lost = status == "contact lost"
    if terminated != lost or (status in ("step limit", "event limit") and not truncated):
        raise Failure("info", f"status {status}, terminated {terminated}, truncated {truncated}")
    if lost and not abs(info["normal_force"]) <= 1e-6 * max(1.0, p.g1) and time > 0.0 and info["x"] != before["x"]:
        raise Failure("info of a loss", f"contact is lost at N = {info['normal_force']!r}")
    if not 0.0 <= info["stick_fraction"] <= 1.0 + 1e-12 or info["mean_square_velocity"] < 0.0:
        raise Failure("info", f"{info['stick_fraction']!r} stuck, mean v^2 {info['mean_square_velocity']!r}")


BATCHES = Check(
    "batches",
    "single environments against batches of 1, 3, 300 and 1,100, bit for bit",
    batch_trial,
    drawn=described_batch,
    patience=120.0,
)
INTERPRETED = Check(
    "interpreted",
    "compiled against interpreted code, bit for bit",
    interpreted_trial,
    patience=120.0,
    slow_fails=False,
)
INFOS = Check(
    "infos",
    "a step's info: of one moment, and of the plant's forces there",
    info_trial,
    drawn=described_info,
    patience=60.0,
)

if __name__ == "__main__":
    print(json.dumps(fingerprints(int(sys.argv[1]), int(sys.argv[2]))))
