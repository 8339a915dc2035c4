"""The control step as a differentiable function of PyTorch and of JAX, with its exact Jacobian."""

import functools
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from sd_friction_env import kernel
from sd_friction_env.environments.jacobian import (
    StepJacobian,
    control_steps,
    parameter_directions,
    plant_at,
    starts_of,
    step_with_jacobian,
)
from sd_friction_env.environments.task import FloatArray, Task
from sd_friction_env.extras import extra
from sd_friction_env.physics.parameters import OscillatorParameters, checked_choice

if TYPE_CHECKING:
    import jax
    import torch

OnSingular = Literal["raise", "warn", "ignore"]
TorchStep: TypeAlias = "Callable[..., tuple[torch.Tensor, torch.Tensor]]"
JaxStep: TypeAlias = "Callable[..., tuple[jax.Array, jax.Array]]"

_NOMINAL, _TASK = OscillatorParameters(), Task()
_RESULTS = 4  # x, v, v_belt and the reward: the first rows of a Jacobian
_START = 4  # x, v, v_belt and the action: its first columns
_BY_TIME = "the step is not differentiated by time: pass a constant"


def torch_step(
    parameters: OscillatorParameters = _NOMINAL,
    task: Task = _TASK,
    by: Sequence[str] = (),
    *,
    on_singular: OnSingular = "raise",
) -> TorchStep:
    """Return the control step as a function of tensors, with the exact derivative through stick and slip.

    The function is ``step(state, action, values=None, time=0.0) -> (next_state, reward)``:

    - state: (x, v, v_belt), a tensor of shape (3,) or (n, 3), float64 or float32; next_state has its shape and type.
    - action: in [-1, 1], shape () or (n,), as the reward.
    - values: of the parameters named by ``by``, shape (m,), or (n, m) for a plant each; None: their own.
    - time: at the start of the step, a number or shape (n,); matters to an excited plant, and is not differentiated.

    Gradients are those of :func:`step_with_jacobian`, computed only where one is needed; the step is computed in double
    precision, whatever the tensors' type. It is differentiable once, in reverse mode.

    From a state on the belt (v = v_belt) the derivative is that along v = v_belt, as in :func:`step_with_jacobian`. A
    rollout needs no other one, so this is no error; a gradient by the v of such a start has no meaning of its own.

    Args:
        parameters: of the oscillator; the nominal ones by default.
        task: the actuator, control interval and reward weights; those of ``SDFriction/Force-v0`` by default.
        by: names of parameters to differentiate by, as ``mu_m``, ``belt_speed`` or ``friction.NAME``.
        on_singular: what to do where the derivative does not exist (an event falls on the start or the end of the step,
            or is touched) or the motion cannot be followed (contact is lost). "raise" is the default, because such
            steps are rare and their gradient is not the one asked for: raise an error. "warn": warn, and take the
            one-sided derivative, and NaN where there is no motion or where it begins with NaN. "ignore": the same
            without the warning.

    Raises:
        ModuleNotFoundError: if PyTorch is not installed.
        ValueError: if the plant does not use a parameter, or its law offers no derivatives by its numbers.

    The function raises TypeError or ValueError if a shape, type or value does not fit, and RuntimeError, with the state
    and the reason, as ``on_singular`` says.
    """
    with extra("torch"):
        import torch
    on_host = _Step(parameters, task, by, on_singular)

    class Step(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, derivatives: bool, *arguments: torch.Tensor) -> torch.Tensor:
            found = on_host(derivatives, *(argument.detach().cpu().numpy() for argument in arguments))
            results, *jacobian = (torch.from_numpy(array).to(arguments[0].device) for array in found)
            ctx.save_for_backward(*jacobian)
            return results

        @staticmethod
        def backward(ctx: Any, by_results: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
            if torch.is_grad_enabled():  # once_differentiable would take the Jacobian for a constant
                raise RuntimeError("the step is differentiable once: it has no gradient with create_graph=True")
            back = torch.einsum("...i,...ij->...j", by_results, *ctx.saved_tensors)
            return None, back[..., :3], back[..., 3], back[..., _START:], None

    def step(state: Any, action: Any, values: Any = None, time: Any = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
        state = torch.as_tensor(state)
        convert = functools.partial(torch.as_tensor, dtype=state.dtype, device=state.device)
        arguments = on_host.arranged(torch, convert, state, action, values, time)
        if arguments[-1].requires_grad:
            raise TypeError(_BY_TIME)
        derivatives = torch.is_grad_enabled() and any(argument.requires_grad for argument in arguments)
        results = Step.apply(derivatives, *arguments)  # type: ignore[no-untyped-call]
        return results[..., :3], results[..., 3]

    return step


def jax_step(
    parameters: OscillatorParameters = _NOMINAL,
    task: Task = _TASK,
    by: Sequence[str] = (),
    *,
    on_singular: OnSingular = "warn",
) -> JaxStep:
    """Return the control step as a function of JAX arrays, with the exact derivative through stick and slip.

    The function is that of :func:`torch_step`, once differentiable in both modes. It works under ``jit``, ``vmap``,
    ``grad``, ``jacfwd``, ``jacrev`` and ``lax.scan``: ``jax.lax.scan(step, state, actions)`` is a rollout. The step
    runs on the host, in double precision; state and derivatives are float32 unless 64 bits are enabled:
    ``jax.config.update("jax_enable_x64", True)``. (The context manager ``jax.enable_x64`` holds in its own thread only;
    a callback that JAX runs in another one is refused for its types.)

    Args:
        parameters, task, by: as in :func:`torch_step`.
        on_singular: as there, but "warn" is the default: JAX does not define what follows an exception in a callback.
            On a CPU that of "raise", or of a value out of range, arrives as a JaxRuntimeError with the message.

    Raises:
        ModuleNotFoundError: if JAX is not installed.
        ValueError: as :func:`torch_step`.
    """
    with extra("jax"):
        import jax
        import jax.numpy as jnp
        from jax.custom_derivatives import SymbolicZero
    on_host = _Step(parameters, task, by, on_singular)

    def call_host(derivatives: bool, *arguments: jax.Array) -> Any:
        state, action, *_ = arguments
        shape_of: Any = functools.partial(jax.ShapeDtypeStruct, dtype=state.dtype)
        expected = [shape_of((*action.shape, *shape)) for shape in on_host.shapes(derivatives)]
        return jax.pure_callback(
            functools.partial(on_host, derivatives), expected, *arguments, vmap_method="broadcast_all"
        )

    @jax.custom_jvp
    def results_of(*arguments: jax.Array) -> Any:
        return call_host(False, *arguments)[0]

    @functools.partial(results_of.defjvp, symbolic_zeros=True)
    def derivative(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
        if not isinstance(tangents[-1], SymbolicZero):
            raise TypeError(_BY_TIME)
        changes = [jnp.zeros(t.shape, t.dtype) if isinstance(t, SymbolicZero) else t for t in tangents[:-1]]
        changes[1] = changes[1][..., None]
        results, jacobian = call_host(True, *primals)
        return results, jnp.einsum("...ij,...j->...i", jacobian, jnp.concatenate(changes, axis=-1))

    def step(state: Any, action: Any, values: Any = None, time: Any = 0.0) -> tuple[jax.Array, jax.Array]:
        state = jnp.asarray(state)
        convert = functools.partial(jnp.asarray, dtype=state.dtype)
        results = results_of(*on_host.arranged(jnp, convert, state, action, values, time))
        return results[..., :3], results[..., 3]

    return step


class _Step:
    """The step on NumPy arrays, for both libraries."""

    def __init__(self, parameters: OscillatorParameters, task: Task, by: Sequence[str], on_singular: str) -> None:
        parameter_directions(parameters, by)
        self.parameters, self.task, self.by = parameters, task, tuple(by)
        self.on_singular = checked_choice("on_singular", on_singular, get_args(OnSingular))

        @functools.lru_cache(maxsize=64)  # a rollout asks for the same ones at every step
        def parameters_with(*values: float) -> OscillatorParameters:
            return parameters.replace(**dict(zip(self.by, values, strict=True)))

        self.parameters_with = parameters_with

    def shapes(self, derivatives: bool) -> list[tuple[int, ...]]:
        """Return the shapes of what one step gives: its results, and their derivatives if wanted."""
        return [(_RESULTS,), (_RESULTS, _START + len(self.by))][: 1 + derivatives]

    def arranged(
        self, library: Any, convert: Callable[[Any], Any], state: Any, action: Any, values: Any, time: Any
    ) -> tuple[Any, Any, Any, Any]:
        """Return state (n, 3), action (n,), values (n, m) and time (n,), or each without n, as arrays of a library."""
        if state.dtype not in (library.float32, library.float64):
            raise TypeError(f"state must be of type float32 or float64, got {state.dtype}")
        own = [self.parameters.values[name] for name in self.by]
        action, values, time = map(convert, (action, own if values is None else values, time))
        shape = tuple(action.shape)
        if len(shape) > 1 or tuple(state.shape) != (*shape, 3):
            got = f"{tuple(state.shape)} and {shape}"
            raise ValueError(f"state and action must have shapes (3,) and (), or (n, 3) and (n,), got {got}")
        for name, array, one in (("values", values, (len(self.by),)), ("time", time, ())):
            if tuple(array.shape) not in (one, (*shape, *one)):
                raise ValueError(f"{name} must have shape {one}, or one for each state, got {tuple(array.shape)}")
        return state, action, library.broadcast_to(values, (*shape, len(self.by))), library.broadcast_to(time, shape)

    def __call__(self, derivatives: bool, *arguments: Any) -> list[FloatArray]:
        """Return x, v, v_belt and reward after the steps, (..., 4), and their derivatives, (..., 4, 4 + m), if wanted.

        Args:
            derivatives: whether they are wanted.
            arguments: state (..., 3), action (...), values (..., m) and time (...).
        """
        state, action, *_ = arguments
        n, widths = action.size, (3, 1, len(self.by), 1)
        columns = zip(arguments, widths, strict=True)
        rows = np.concatenate([np.asarray(each, np.float64).reshape(n, width) for each, width in columns], axis=1)
        found = [np.full((n, *shape), np.nan, state.dtype) for shape in self.shapes(derivatives)]
        lanes = np.arange(n) if self.on_singular == "raise" else np.flatnonzero(np.isfinite(rows).all(axis=1))
        plants = rows[lanes, _START:]
        changed = (plants[1:] != plants[:-1]).any(axis=1)
        for group in np.split(lanes, np.flatnonzero(changed) + 1):
            if group.size:
                for whole, part in zip(found, self._of_one_plant(derivatives, rows[group]), strict=True):
                    whole[group] = part
        return [array.reshape(*action.shape, *array.shape[1:]) for array in found]

    def _of_one_plant(self, derivatives: bool, rows: FloatArray) -> list[FloatArray]:
        *values, time = rows[0, _START:].tolist()
        parameters = self.parameters_with(*values)
        state, action = rows[:, :3], rows[:, 3]
        if not derivatives:
            starts_of(state, action)  # checks them
            plant, actuator = plant_at(parameters, time), self.task.actuator_of(parameters)
            ends, rewards, failures = control_steps(plant, actuator, state, action)
            if not failures:
                return [np.column_stack((ends, rewards))]
        found = step_with_jacobian(state, action, parameters, self.task, by=self.by, time=time)
        failed = found.status != kernel.OK
        self._report(found, rows, failed | (derivatives & (found.derivative > kernel.FROM_BELT)))
        results = np.where(failed[:, None], np.nan, found.outcomes[:, :_RESULTS])
        return [results, found.jacobian[:, :_RESULTS]][: 1 + derivatives]

    def _report(self, found: StepJacobian, rows: FloatArray, singular: NDArray[np.bool_]) -> None:
        if self.on_singular == "ignore" or not singular.any():
            return
        first = int(np.argmax(singular))
        start = ", ".join(
            f"{name} = {value!r}" for name, value in zip(kernel.CAUSES, rows[first].tolist(), strict=False)
        )
        text = f"{singular.sum()} of {len(rows)} steps cannot be differentiated: from {start}: {found.reasons[first]}"
        if self.on_singular == "raise":
            raise RuntimeError(f"{text} (on_singular='warn' goes on with the one-sided derivative, or with NaN)")
        warnings.warn(text, RuntimeWarning, stacklevel=2)
