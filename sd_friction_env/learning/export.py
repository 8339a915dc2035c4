"""Trained agents as ONNX: from measurements to commands, without this package at run time.

The graph takes physical measurements (dimensionless), scales and clips them as the environment does, runs the network
in double precision, and returns the action in [-1, 1] and the command that it means.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import ArrayLike, NDArray
from onnx import TensorProto, helper, numpy_helper

import sd_friction_env
from sd_friction_env import SDFrictionEnv
from sd_friction_env.control.policies import Actions, NetworkPolicy, State
from sd_friction_env.control.policies.policy import broadcast_starts
from sd_friction_env.environments.single import make_env
from sd_friction_env.storage import atomic_file

OPSET = 17
TOLERANCE = 1e-6
MEASUREMENTS, ACTION, COMMAND = "measurements", "action", "command"
_OPERATORS = {"Tanh": "Tanh", "ReLU": "Relu"}
_IR_VERSION = 8  # the oldest that holds this opset: runtimes of 2022 read it

Measurements = NDArray[np.float32]


@dataclass(frozen=True)
class Interface:
    """Measurements and command of a controller, all dimensionless.

    Where each episode draws the plant's belt speed, the belt's speed is measured and commanded in units of the plant's
    nominal speed (``v_belt/belt_speed``), which its operator sets.

    Attributes:
        names: of the measurements, in order. rest: measurements for observations of zero; they fill the window at the
            start of an episode.
        offsets, scales: the observation of a measurement m is (m - offset)/scale, clipped to [-limit, limit].
        command: its name. command_offset, command_scale: the command is offset + scale x action.
    """

    names: tuple[str, ...]
    rest: tuple[float, ...]
    offsets: tuple[float, ...]
    scales: tuple[float, ...]
    limit: float
    command: str
    command_offset: float
    command_scale: float

    @classmethod
    def of(cls, env: SDFrictionEnv) -> "Interface":
        """Return the interface of an environment.

        Raises:
            ValueError: if it shows parameters, which cannot be measured.
        """
        task, speed = env.task, env.nominal.belt_speed
        if task.show_parameters:
            raise ValueError("an agent that is shown parameters cannot be exported: they cannot be measured")
        x_offset, x_scale, v_scale = task.scales
        names, offsets, scales = ["x"], [x_offset], [x_scale]
        by_force, relative = task.actuator == "force", "belt_speed" in task.randomise
        unit = 1.0 if relative else speed
        if task.sensor == "state":
            names, offsets, scales = [*names, "v"], [*offsets, 0.0], [*scales, v_scale]
            if not by_force:
                names = [*names, "v_belt/belt_speed" if relative else "v_belt"]
                offsets, scales = [*offsets, unit], [*scales, task.belt_authority * unit]
        return cls(
            names=tuple(names),
            rest=tuple(offsets),
            offsets=tuple(offsets),
            scales=tuple(scales),
            limit=task.observation_limit,
            command="force" if by_force else "target of the belt's speed" + relative * ", over its nominal speed",
            command_offset=0.0 if by_force else unit,
            command_scale=task.force_limit if by_force else task.belt_authority * unit,
        )

    def measure(self, env: SDFrictionEnv, info: dict[str, Any]) -> NDArray[np.float64]:
        """Return the true measurements, shape (k,), in an environment that has just returned ``info``."""
        known = {**info, "v_belt/belt_speed": info["v_belt"] / env.parameters.belt_speed}
        return np.array([known[name] for name in self.names])

    def observe(self, measurements: NDArray[Any]) -> NDArray[np.float32]:
        """Return the observations that the environment would show, for measurements of shape (..., k)."""
        values = (np.asarray(measurements, np.float64) - np.array(self.offsets)) / np.array(self.scales)
        return np.asarray(np.clip(values, -self.limit, self.limit), dtype=np.float32)


def build(policy: NetworkPolicy, env: SDFrictionEnv, about: dict[str, Any] | None = None) -> onnx.ModelProto:
    """Return the ONNX model of an agent.

    Input ``measurements``: float32, shape (n, frames, k), oldest first. Outputs ``action`` and ``command``: float32,
    shape (n, 1). ``metadata_props`` hold the columns' names, the control interval, and the values that fill a new
    window.

    Raises:
        ValueError: if the agent does not fit the environment.
    """
    interface = Interface.of(env)
    if policy.observation_size != len(interface.names):
        raise ValueError(
            f"the agent observes {policy.observation_size} values, and the environment gives {len(interface.names)}"
        )
    model = helper.make_model(
        _graph(policy, interface),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=_IR_VERSION,
        producer_name="sd_friction_env",
        producer_version=sd_friction_env.__version__,
    )
    metadata = {
        "units": "dimensionless: lengths over the spring's free length, times times its frequency",
        "measurements": list(interface.names),
        "window": f"the last {policy.frames} measurements, one for each control interval, oldest first",
        "young_window_is_filled_with": list(interface.rest),
        "control_interval": env.task.control_interval,
        "sensor": env.task.sensor,
        "command": interface.command,
        **(about or {}),
    }
    texts = {name: value if isinstance(value, str) else json.dumps(value) for name, value in metadata.items()}
    helper.set_model_props(model, texts)
    onnx.checker.check_model(model, full_check=True)
    return model


def _graph(policy: NetworkPolicy, interface: Interface) -> onnx.GraphProto:
    k = len(interface.names)
    constants: dict[str, NDArray[Any]] = {
        "offsets": np.array(interface.offsets),
        "scales": np.array(interface.scales),
        "low": np.array(-interface.limit),
        "high": np.array(interface.limit),
        "flat": np.array([-1, policy.frames * k], np.int64),
        "minus_one": np.array(-1.0),
        "one": np.array(1.0),
        "command_offset": np.array(interface.command_offset),
        "command_scale": np.array(interface.command_scale),
    }
    nodes = []

    def add(operator: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(operator, inputs, [output], **attributes))
        return output

    double = add("Cast", [MEASUREMENTS], "double", to=TensorProto.DOUBLE)
    scaled = add("Div", [add("Sub", [double, "offsets"], "shifted"), "scales"], "scaled")
    clipped = add("Clip", [scaled, "low", "high"], "clipped")
    # Agents are trained on observations in single precision.
    single = add("Cast", [clipped], "observations", to=TensorProto.FLOAT)
    hidden = add("Reshape", [add("Cast", [single], "observed", to=TensorProto.DOUBLE), "flat"], "window")
    for i, (weights, bias) in enumerate(policy.layers):
        constants |= {f"weights_{i}": weights, f"bias_{i}": bias}
        product = add("MatMul", [hidden, f"weights_{i}"], f"product_{i}")
        hidden = add("Add", [product, f"bias_{i}"], f"sum_{i}")
        if i + 1 < len(policy.layers):
            hidden = add(_OPERATORS[policy.activation], [hidden], f"hidden_{i}")
    operator, limits = ("Clip", ["minus_one", "one"]) if policy.output == "clip" else ("Tanh", [])
    add("Cast", [add(operator, [hidden, *limits], "bounded")], ACTION, to=TensorProto.FLOAT)
    # The command follows from the action in single precision, as it is returned.
    given = add("Cast", [ACTION], "given", to=TensorProto.DOUBLE)
    command = add("Add", [add("Mul", [given, "command_scale"], "change"), "command_offset"], "commanded")
    add("Cast", [command], COMMAND, to=TensorProto.FLOAT)
    return helper.make_graph(
        nodes,
        "agent",
        [helper.make_tensor_value_info(MEASUREMENTS, TensorProto.FLOAT, ["n", policy.frames, k])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", 1]) for name in (ACTION, COMMAND)],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )


def session(model: onnx.ModelProto | Path) -> onnxruntime.InferenceSession:
    """Return a session of onnxruntime on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    source = str(model) if isinstance(model, Path) else model.SerializeToString()
    return onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])


@dataclass(frozen=True, eq=False)
class ExportedPolicy:
    """A file that :func:`build` made, as a policy: it reads the measurements behind the observations.

    Attributes:
        runtime: session of the file. interface: of the environment. frames: measurements in its window.
    """

    runtime: onnxruntime.InferenceSession
    interface: Interface
    frames: int

    @classmethod
    def load(cls, path: Path, env: SDFrictionEnv) -> "ExportedPolicy":
        """Return the policy in a file for an environment.

        Raises:
            ValueError: if it is no such file, or its measurements or its command are not the environment's.
        """
        interface = Interface.of(env)
        try:
            runtime = session(path)
            about, shape = runtime.get_modelmeta().custom_metadata_map, runtime.get_inputs()[0].shape
            made_for = [*json.loads(about["measurements"]), about["command"]]
            if runtime.get_inputs()[0].name != MEASUREMENTS or len(shape) != 3:
                raise ValueError(f"its input is not {MEASUREMENTS} of shape (n, frames, k)")
        except Exception as error:  # the runtime has no class of errors of its own
            reason = f"{type(error).__name__}: {error}"
            raise ValueError(f"{str(path)!r} is no agent of sd-friction export ({reason})") from None
        if made_for != [*interface.names, interface.command]:
            fits = ", ".join([*interface.names, interface.command])
            raise ValueError(f"{str(path)!r} is for {', '.join(made_for)}, and the environment has {fits}")
        return cls(runtime, interface, int(shape[1]))

    def predict(
        self, observation: ArrayLike, state: State = None, episode_start: ArrayLike | None = None, *_: Any, **__: Any
    ) -> tuple[Actions, State]:
        """Return the actions for one observation or a batch, and the window of measurements."""
        observed = np.asarray(observation, np.float64)
        measured = np.atleast_2d(observed * np.array(self.interface.scales) + np.array(self.interface.offsets))
        window = np.tile(np.array(self.interface.rest, np.float32), (len(measured), self.frames, 1))
        if state is not None:
            goes_on = ~broadcast_starts(episode_start, measured[:, 0])
            window[goes_on, :-1] = state[0][goes_on, 1:]
        window[:, -1] = measured
        (actions,) = self.runtime.run([ACTION], {MEASUREMENTS: window})
        return (actions if observed.ndim > 1 else actions[0]), (window,)


def trial_measurements(policy: NetworkPolicy, env_id: str, n: int, seed: int = 0) -> Measurements:
    """Return windows of measurements, shape (n, frames, k): half from episodes that the agent controls, with their
    partly filled first windows, half random over more than the range of an observation."""
    env = make_env(env_id)
    interface, rng = Interface.of(env), np.random.default_rng(seed)
    k, frames = len(interface.names), policy.frames
    driven: list[Measurements] = []
    while len(driven) < n // 2:
        observation, info = env.reset(seed=int(rng.integers(2**31)))
        window = np.tile(np.array(interface.rest, np.float32), (frames, 1))
        state, begins, over = None, True, False
        while not over and len(driven) < n // 2:
            measured = observation[:k] * np.array(interface.scales) + np.array(interface.offsets)
            window = np.concatenate([window[1:], measured[None].astype(np.float32)])
            driven.append(window)
            action, state = policy.predict(observation, state, begins)
            observation, _, terminated, truncated, info = env.step(action)
            begins, over = False, terminated or truncated
    spread = 1.2 * interface.limit * np.array(interface.scales)
    random = rng.uniform(-1.0, 1.0, (n - len(driven), frames, k)) * spread + np.array(interface.offsets)
    # Clipped observations are rare: half of the windows are in the usual range.
    random[::2] = (random[::2] - np.array(interface.offsets)) / interface.limit + np.array(interface.offsets)
    return np.concatenate([np.array(driven, np.float32).reshape(-1, frames, k), random.astype(np.float32)])


def worst_difference(model: onnx.ModelProto, policy: NetworkPolicy, env_id: str, measurements: Measurements) -> float:
    """Return the largest difference between the model's actions and the agent's on the observations of measurements."""
    interface = Interface.of(make_env(env_id))
    (actions,) = session(model).run([ACTION], {MEASUREMENTS: measurements})
    windows = interface.observe(measurements)
    state = None
    for frame in range(policy.frames):  # one after the other, as in an episode
        expected, state = policy.predict(windows[:, frame], state, np.full(len(windows), frame == 0))
    return float(np.abs(actions - expected).max())


def map_difference(env_id: str, n: int, seed: int = 0) -> float:
    """Return the largest difference between the interface and the environment, over n true states: of the observations
    made from their measurements, and of the commands applied to the belt or the mass.

    The sensor's noise and delay are left out: they belong to the plant, not to the map. Measurements do not use the
    environment's observations, so that an error of the map cannot cancel.
    """
    interface = Interface.of(make_env(env_id))
    env = make_env(env_id, {"sensor_noise": 0.0, "sensor_delay": 0})
    by_force, rng, worst, left = env.task.actuator == "force", np.random.default_rng(seed), 0.0, n
    episodes = max(1, min(20, n))  # each with another plant, where they are drawn
    for episode in range(episodes):
        observation, info = env.reset(seed=int(rng.integers(2**31)))
        relative = "belt_speed" in env.task.randomise
        unit = 1.0 if by_force or not relative else env.parameters.belt_speed
        for _ in range(-(-left // (episodes - episode))):
            left -= 1
            seen = interface.observe(interface.measure(env, info))
            worst = max(worst, float(np.abs(seen - observation).max()))
            action = rng.uniform(-1.0, 1.0, 1).astype(np.float32)
            command = unit * (interface.command_offset + interface.command_scale * float(action[0]))
            before = info["v_belt"]
            observation, _, terminated, truncated, info = env.step(action)
            if by_force:
                worst = max(worst, abs(info["force"] - command))
            else:
                most = env.task.belt_acceleration_limit * env.task.control_interval
                worst = max(worst, abs(info["v_belt"] - before - float(np.clip(command - before, -most, most))))
            if terminated or truncated:
                observation, info = env.reset(seed=int(rng.integers(2**31)))
                unit = 1.0 if by_force or not relative else env.parameters.belt_speed
    return worst


def latency(model: onnx.ModelProto, measurements: Measurements, calls: int = 5000) -> tuple[float, float]:
    """Return median and 99th percentile of the time of one call on one thread, in seconds."""
    run = session(model).run
    singles = [measurements[i % len(measurements)][None] for i in range(calls)]
    for one in singles[:200]:
        run(None, {MEASUREMENTS: one})
    taken = np.empty(calls)
    for i, one in enumerate(singles):
        begun = time.perf_counter()
        run(None, {MEASUREMENTS: one})
        taken[i] = time.perf_counter() - begun
    return float(np.median(taken)), float(np.quantile(taken, 0.99))


def write(model: onnx.ModelProto, path: Path) -> None:
    """Write a model, whole or not at all."""
    with atomic_file(path, "wb") as file:
        file.write(model.SerializeToString())
