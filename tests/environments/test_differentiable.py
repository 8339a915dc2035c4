"""The control step in PyTorch and JAX: their checks of gradients, rollouts, transformations, and what is refused."""

import functools
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from jax.test_util import check_grads

from sd_friction_env import (
    OscillatorParameters,
    Task,
    jax_step,
    return_with_gradient,
    step_with_jacobian,
    torch_step,
)
from sd_friction_env.environments import differentiable

BY = ("alpha", "mu_m", "belt_speed", "beta")
VALUES = [OscillatorParameters().values[name] for name in BY]
TASKS = {"force": Task(), "belt_speed": Task(actuator="belt_speed")}
ACTION = 0.3
STARTS = {  # off the belt: what happens within a control interval
    ("force", "slip"): [0.3, 0.1, 0.2],
    ("force", "landing"): [0.59, 0.209, 0.2],
    ("force", "landing, breakaway"): [0.91, 0.21, 0.2],
    ("force", "crossing"): [1.035, 0.239, 0.2],
    ("belt_speed", "slip"): [0.3, 0.1, 0.2],
    ("belt_speed", "landing"): [-1.034, 0.206, 0.2],
    ("belt_speed", "landing, breakaway"): [-0.9, 0.208, 0.2],
    ("belt_speed", "crossing"): [0.491, 0.209, 0.2],
}
ON_BELT = {("force", "stick"): 0.3, ("force", "breakaway"): 0.904, ("belt_speed", "breakaway"): -0.905}  # x
BORDER = [0.3, 0.2 + 1e-11, 0.2]  # lands on the belt within 1e-9
LIFTING = OscillatorParameters(alpha=1.8)
LOST = [1.3, 2.0, 0.2]  # leaves the belt of LIFTING
ROLLOUT = np.sin(np.arange(50.0))


def tensor(values, requires_grad=True):
    return torch.tensor(np.array(values), dtype=torch.float64, requires_grad=requires_grad)


@pytest.fixture
def x64():
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("actuator", TASKS)
def test_the_starts_are_what_they_are_called(actuator):
    starts = [state for (kind, _), state in STARTS.items() if kind == actuator]
    starts += [[x, 0.2, 0.2] for (kind, _), x in ON_BELT.items() if kind == actuator]
    found = step_with_jacobian(starts, [ACTION] * len(starts), task=TASKS[actuator])
    stuck = found.outcomes[:, found.rows.index("stick_fraction")]
    before, after = np.sign(np.array(starts)[:, 1] - 0.2), np.sign(found.state[:, 1] - found.state[:, 2])
    names = [name for kind, name in (*STARTS, *ON_BELT) if kind == actuator]
    for name, share, first, last in zip(names, stuck, before, after, strict=True):
        assert (share > 0.0) == (name not in ("slip", "crossing"))
        assert (share == 1.0) == (name == "stick")
        assert (first == 0.0) == (name in ("stick", "breakaway"))
        assert (last == 0.0) == (name in ("stick", "landing"))
        assert (first * last == -1.0) == (name in ("crossing", "landing, breakaway"))


# The libraries' own checks --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("actuator", "happening"), STARTS)
def test_gradients_off_the_belt(actuator, happening, x64):
    state, task = STARTS[actuator, happening], TASKS[actuator]
    options = {"eps": 1e-6, "atol": 1e-6, "rtol": 1e-6}
    assert torch.autograd.gradcheck(
        torch_step(task=task, by=BY), (tensor(state), tensor(ACTION), tensor(VALUES)), **options
    )
    check_grads(
        jax_step(task=task, by=BY), (jnp.array(state), ACTION, jnp.array(VALUES)), 1, modes=("fwd", "rev"), **options
    )


@pytest.mark.parametrize(("actuator", "happening"), ON_BELT)
def test_gradients_on_the_belt(actuator, happening, x64):
    x, task = ON_BELT[actuator, happening], TASKS[actuator]
    in_torch, in_jax = torch_step(task=task, by=BY), jax_step(task=task, by=BY)
    options = {"eps": 1e-6, "atol": 1e-6, "rtol": 1e-6}

    def from_belt(step, library, x, v_belt, action, values):
        return step(library.stack([x, v_belt, v_belt]), action, values)

    arguments = (x, 0.2, ACTION, VALUES)
    assert torch.autograd.gradcheck(
        functools.partial(from_belt, in_torch, torch), tuple(map(tensor, arguments)), **options
    )
    arguments = tuple(map(jnp.array, arguments))
    check_grads(functools.partial(from_belt, in_jax, jnp), arguments, 1, modes=("fwd", "rev"), **options)


@pytest.mark.parametrize("one_plant", [True, False])
def test_gradients_of_a_batch(one_plant, x64):
    states = [state for (kind, _), state in STARTS.items() if kind == "force"]
    actions, values = [ACTION] * len(states), VALUES if one_plant else [VALUES] * len(states)
    options = {"eps": 1e-6, "atol": 1e-6, "rtol": 1e-6}
    assert torch.autograd.gradcheck(torch_step(by=BY), tuple(map(tensor, (states, actions, values))), **options)
    arguments = tuple(map(jnp.array, (states, actions, values)))
    check_grads(jax_step(by=BY), arguments, 1, modes=("fwd", "rev"), **options)


# Rollouts and transformations -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("actuator", TASKS)
def test_a_rollout_has_the_gradient_of_the_return(actuator, x64):
    start, task = [0.6, 0.1, 0.2], TASKS[actuator]
    expected = return_with_gradient(start, ROLLOUT, task=task, by=BY)
    assert expected.smooth
    wanted = expected.by_state, expected.by_actions, np.array(list(expected.by_parameters.values()))

    step = torch_step(task=task, by=BY)
    arguments = tensor(start), tensor(ROLLOUT), tensor(VALUES)
    state, total = arguments[0], torch.tensor(0.0)
    for action in arguments[1]:
        state, reward = step(state, action, arguments[2])
        total = total + reward
    assert total.item() == pytest.approx(expected.total, rel=1e-14)
    for found, exact in zip(torch.autograd.grad(total, arguments), wanted, strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-11, atol=1e-11)

    step_in_jax = jax_step(task=task, by=BY)

    def total_of(state, actions, values):
        return jax.lax.scan(lambda state, action: step_in_jax(state, action, values), state, actions)[1].sum()

    arguments = tuple(map(jnp.array, (start, ROLLOUT, VALUES)))
    total, gradient = jax.jit(jax.value_and_grad(total_of, (0, 1, 2)))(*arguments)
    assert float(total) == pytest.approx(expected.total, rel=1e-14)
    for found, exact in zip(gradient, wanted, strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-11, atol=1e-11)


def test_jax_transformations_agree(x64):
    step = jax_step(by=BY)
    states = jnp.array([state for (kind, _), state in STARTS.items() if kind == "force"])
    actions, values = jnp.linspace(-0.5, 0.5, len(states)), jnp.array([VALUES, VALUES]) * jnp.array([[1.0], [1.01]])
    exact = step_with_jacobian(states, actions, by=BY)

    for jacobian_of in (jax.jacfwd, jax.jacrev):
        by_state, by_action, by_values = jacobian_of(step, (0, 1, 2))(states[0], actions[0], values[0])[0]
        found = np.column_stack([by_state, by_action, by_values])
        np.testing.assert_allclose(found, exact.jacobian[0, :3], rtol=1e-14)
    # A batch, vmap over states, and vmap over plants within vmap over states: the same numbers.
    batch = step(states, actions, values[0])
    np.testing.assert_array_equal(batch[0], exact.state)
    np.testing.assert_array_equal(batch[1], exact.reward)
    mapped = jax.jit(jax.vmap(step, (0, 0, None)))(states, actions, values[0])
    np.testing.assert_array_equal(mapped[0], batch[0])
    reward_gradient = jax.grad(lambda *arguments: step(*arguments)[1], (0, 1, 2))
    nested = jax.vmap(jax.vmap(reward_gradient, (None, None, 0)), (0, 0, None))(states, actions, values)
    for j, plant in enumerate(values.tolist()):
        parameters = OscillatorParameters().replace(**dict(zip(BY, plant, strict=True)))
        rewards = step_with_jacobian(states, actions, parameters, by=BY).jacobian[:, 3]
        found = np.column_stack([nested[0][:, j], nested[1][:, j], nested[2][:, j]])
        np.testing.assert_allclose(found, rewards, rtol=1e-13, atol=1e-13)


def test_without_a_gradient_no_jacobian_is_computed(monkeypatch, x64):
    exact = step_with_jacobian(STARTS["force", "landing"], ACTION)
    monkeypatch.setattr(differentiable, "step_with_jacobian", None)
    state = tensor(STARTS["force", "landing"])
    for found in (torch_step()(state.detach(), ACTION), jax.jit(jax_step())(STARTS["force", "landing"], ACTION)):
        np.testing.assert_array_equal(found[0], exact.state)
        np.testing.assert_array_equal(found[1], exact.reward)
    with torch.no_grad():
        assert not torch_step()(state, ACTION)[0].requires_grad
    with pytest.raises(TypeError, match="not callable"):
        torch_step()(state, ACTION)


def test_single_precision_stays_and_only_the_results_are_rounded():
    exact = step_with_jacobian(np.float32(STARTS["force", "landing"]), np.float32(ACTION))
    state = torch.tensor(STARTS["force", "landing"], requires_grad=True)
    action = torch.tensor(ACTION, dtype=torch.float64, requires_grad=True)  # as from a network of another precision
    after, reward = torch_step()(state, action)
    by_state, by_action = torch.autograd.grad(reward, (state, action))
    assert (after.dtype, by_state.dtype, by_action.dtype) == (torch.float32, torch.float32, torch.float64)
    in_jax = jax_step()(jnp.array(STARTS["force", "landing"], "float32"), ACTION)
    gradient = jax.grad(lambda state: jax_step()(state, ACTION)[1])(jnp.array(STARTS["force", "landing"], "float32"))
    assert in_jax[0].dtype == gradient.dtype == np.float32
    for found, wanted in (
        (after.detach(), exact.state),
        (by_state, exact.jacobian[3, :3]),
        (in_jax[0], exact.state),
        (gradient, exact.jacobian[3, :3]),
    ):
        np.testing.assert_allclose(found, np.float32(wanted), rtol=1e-6)


def test_time_matters_to_an_excited_plant(monkeypatch, x64):
    excited = OscillatorParameters(force_amplitude=0.1, force_frequency=2.0)
    later = excited.replace(force_phase=2.0 * 0.7)
    state = tensor(STARTS["force", "slip"], requires_grad=False)
    expected = torch_step(later)(state, 0.0)[0]
    torch.testing.assert_close(torch_step(excited)(state, 0.0, time=0.7)[0], expected)
    step = jax_step(excited)
    at_times = jax.vmap(lambda time: step(STARTS["force", "slip"], 0.0, time=time)[0])(jnp.array([0.0, 0.7]))
    np.testing.assert_allclose(at_times[1], expected, rtol=1e-14)
    assert not np.array_equal(at_times[0], at_times[1])
    times = []  # of steps with derivatives, which would take long to compile for an excited plant

    def noted(*arguments, time, **options):
        times.append(time)
        return step_with_jacobian(*arguments, **options)

    monkeypatch.setattr(differentiable, "step_with_jacobian", noted)
    torch_step()(tensor([STARTS["force", "slip"]] * 2), [0.0, 0.1], time=[0.7, 0.8])
    assert times == [0.7, 0.8]


# What has no derivative -----------------------------------------------------------------------------------------------


def test_a_singular_step_is_an_error_a_warning_or_nothing(x64):
    message = r"1 of 2 steps .* x = 0.3, v = 0.20000000001, v_belt = 0.2, action = 0.1: one-sided: an event falls on"
    states, actions = [STARTS["force", "slip"], BORDER], [0.2, 0.1]
    exact = step_with_jacobian(states, actions)

    def in_torch(on_singular):
        state = tensor(states)
        results = torch_step(on_singular=on_singular)(state, actions)[1].sum()
        return torch.autograd.grad(results, state)[0]

    def in_jax(on_singular):
        return jax.grad(lambda state: jax_step(on_singular=on_singular)(state, actions)[1].sum())(jnp.array(states))

    with pytest.raises(RuntimeError, match=message):
        in_torch("raise")
    with pytest.raises(jax.errors.JaxRuntimeError, match=message):
        in_jax("raise").block_until_ready()
    for gradient in (in_torch, in_jax):
        with pytest.warns(RuntimeWarning, match=message):
            np.testing.assert_allclose(gradient("warn"), exact.jacobian[:, 3, :3])
        np.testing.assert_allclose(gradient("ignore"), exact.jacobian[:, 3, :3])
    # Nothing is wrong with the step itself; the defaults are to raise, and in JAX to warn.
    torch_step()(tensor(BORDER, requires_grad=False), 0.0)
    with pytest.raises(RuntimeError, match="one-sided"):
        torch_step()(tensor(BORDER), 0.0)
    with pytest.warns(RuntimeWarning, match="one-sided"):
        jax.jacfwd(jax_step())(jnp.array(BORDER), 0.0)


def test_lost_contact_is_an_error_or_nan_in_its_own_lane(x64):
    states, actions = [STARTS["force", "slip"], LOST], [0.0, 0.0]
    message = r"1 of 2 steps .* x = 1.3, v = 2.0, v_belt = 0.2, action = 0.0: contact lost"
    for state in (tensor(states), tensor(states, requires_grad=False)):
        with pytest.raises(RuntimeError, match=message):
            torch_step(LIFTING)(state, actions)
        with pytest.warns(RuntimeWarning, match=message):
            after, reward = torch_step(LIFTING, on_singular="warn")(state, actions)
        np.testing.assert_array_equal(after.isnan().any(dim=1), [False, True])
        np.testing.assert_array_equal(reward.isnan(), [False, True])
    step = jax.vmap(jax_step(LIFTING))

    def twice(state):
        return step(step(state, jnp.array(actions))[0], jnp.array(actions))[1].sum()

    with pytest.warns(RuntimeWarning, match=message):
        gradient = jax.jit(jax.grad(twice))(jnp.array(states))
    np.testing.assert_array_equal(jnp.isnan(gradient).any(axis=1), [False, True])


def test_second_derivatives_are_refused(x64):
    state = tensor(STARTS["force", "slip"])
    with pytest.raises(RuntimeError, match="differentiable once"):
        torch.autograd.grad(torch_step()(state, ACTION)[1], state, create_graph=True)
    with pytest.raises(ValueError, match="do not support JVP"):
        jax.hessian(lambda state: jax_step()(state, ACTION)[1])(jnp.array(STARTS["force", "slip"]))


def test_a_derivative_by_time_is_refused(x64):
    state = STARTS["force", "slip"]
    with pytest.raises(TypeError, match="not differentiated by time"):
        torch_step()(torch.tensor(state), ACTION, time=tensor(0.0))
    with pytest.raises(TypeError, match="not differentiated by time"):
        jax.grad(lambda time: jax_step()(state, ACTION, time=time)[1])(0.0)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"by": ("mass",)}, ValueError, "unknown parameter 'mass'"),
        ({"by": ("mu_k",)}, ValueError, "does not use the parameter 'mu_k'"),
        ({"on_singular": "stop"}, ValueError, "on_singular must be one of 'raise', 'warn', 'ignore', got 'stop'"),
    ],
)
@pytest.mark.parametrize("make", [torch_step, jax_step])
def test_what_a_step_cannot_be_made_of_is_refused(make, arguments, error, message):
    with pytest.raises(error, match=message):
        make(**arguments)


@pytest.mark.parametrize(
    ("state", "rest", "error", "message"),
    [
        (np.array([1, 0, 0]), (0.0,), TypeError, "state must be of type float32 or float64, got .*int"),
        (np.zeros(3, np.float16), (0.0,), TypeError, "state must be of type float32 or float64, got .*float16"),
        (np.zeros(2), (0.0,), ValueError, r"must have shapes .*, got \(2,\) and \(\)"),
        (np.zeros((4, 3)), (np.zeros(2),), ValueError, r"must have shapes .*, got \(4, 3\) and \(2,\)"),
        (np.zeros(3), (0.0, [0.8]), ValueError, r"values must have shape \(2,\), or one for each state, got \(1,\)"),
        (np.zeros((4, 3)), (np.zeros(4), np.zeros((3, 2))), ValueError, r"values must have shape .*, got \(3, 2\)"),
        (np.zeros(3), (0.0, None, [0.0]), ValueError, r"time must have shape \(\), or one .*, got \(1,\)"),
    ],
)
@pytest.mark.parametrize(("make", "convert"), [(torch_step, torch.tensor), (jax_step, jnp.array)])
def test_arguments_that_do_not_fit_are_refused(make, convert, state, rest, error, message):
    with pytest.raises(error, match=message):
        make(by=("alpha", "mu_m"))(convert(state), *rest)


def test_values_out_of_range_are_refused():
    step, state = torch_step(by=("mu_m",)), torch.tensor(STARTS["force", "slip"])
    for rest, message in (((1.5,), "action must be in"), ((0.0, [0.5]), "mu_m must not exceed mu_s")):
        with pytest.raises(ValueError, match=message):
            step(state, *rest)
        with pytest.raises(jax.errors.JaxRuntimeError, match=message):
            jax.block_until_ready(jax_step(by=("mu_m",))(jnp.array(STARTS["force", "slip"]), *rest))
    with pytest.raises(ValueError, match="v must be finite, got nan"):
        step(torch.tensor([0.3, np.nan, 0.2]), 0.0)


def test_the_package_imports_neither_library():
    program = (
        "import sys, sd_friction_env as s\n"
        "s.torch_step, s.jax_step, s.step_with_jacobian, s.return_with_gradient, s.StepJacobian\n"
        "print({'torch', 'jax'} & set(sys.modules))"
    )
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True)
    assert printed.stdout == "set()\n"
