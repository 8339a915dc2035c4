"""Derivatives of the control step and of a return: against differences of the step itself, and where there are none."""

import math
from typing import NamedTuple

import numpy as np
import pytest

from sd_friction_env import (
    OscillatorParameters,
    Task,
    friction_law,
    kernel,
    return_with_gradient,
    step_with_jacobian,
)

NOMINAL = OscillatorParameters()
TASKS = {
    "force": Task(control_interval=1.0),
    "belt_speed": Task(actuator="belt_speed", control_interval=1.0, belt_acceleration_limit=0.05),
}
BY = ("alpha", "g1", "beta", "mu_s", "mu_m", "v_m", "belt_speed")
LIFTING = OscillatorParameters(alpha=1.8)  # N = 0 at |x| = 1.35


def random_starts(n, seed):
    """Return n states and actions, a third of them on the belt."""
    rng = np.random.default_rng(seed)
    states = np.column_stack([rng.uniform(-1.2, 1.2, n), rng.uniform(-0.4, 0.4, n), rng.uniform(0.15, 0.25, n)])
    states[::3, 1] = states[::3, 2]
    return states, rng.uniform(-0.9, 0.9, n)


def outcomes(starts, task, changes):
    """Return the outcomes of steps whose starts and parameters are changed, by name."""
    states, actions = starts
    states, changes = states.copy(), dict(changes)
    if "v_belt" in changes:  # a mass on the belt stays on it
        states[states[:, 1] == states[:, 2], 1] += changes["v_belt"]
    for i, name in enumerate(("x", "v", "v_belt")):
        states[:, i] += changes.pop(name, 0.0)
    actions = actions + changes.pop("action", 0.0)
    values = {name: NOMINAL.values[name] + change for name, change in changes.items()}
    return step_with_jacobian(states, actions, NOMINAL.replace(**values), task).outcomes


def difference(function, h):
    """Return the derivative of a function at 0 by central differences of fourth order."""
    return (8.0 * (function(h) - function(-h)) - (function(2.0 * h) - function(-2.0 * h))) / (12.0 * h)


@pytest.mark.parametrize("actuator", TASKS)
def test_every_column_is_what_differences_of_the_step_give(actuator):
    task, starts = TASKS[actuator], random_starts(90, seed=0)
    found = step_with_jacobian(*starts, NOMINAL, task, by=BY)
    on_belt = starts[0][:, 1] == starts[0][:, 2]
    np.testing.assert_array_equal(found.derivative, np.where(on_belt, kernel.FROM_BELT, kernel.SMOOTH))
    stuck = found.outcomes[:, found.rows.index("stick_fraction")]
    assert ((stuck > 0.0) & (stuck < 1.0)).sum() >= 20  # landings and breakaways
    scale = np.maximum(1.0, np.abs(found.jacobian).max(axis=(1, 2)))
    for j, name in enumerate(found.columns):
        exact = found.jacobian[:, :, j]
        if name == "v_belt":
            exact = exact + on_belt[:, None] * found.jacobian[:, :, found.columns.index("v")]
        h = 1e-3 * NOMINAL.values.get(name, 0.2)  # so small that with this seed no event comes or goes within it
        by_steps = difference(lambda d, name=name: outcomes(starts, task, {name: d}), h)
        error = np.abs(exact - by_steps).max(axis=1) / scale
        assert error[~on_belt if name == "v" else slice(None)].max() < 1e-9, name


def test_a_batch_gives_the_bits_of_its_states_one_by_one():
    states, actions = random_starts(12, seed=1)
    batch = step_with_jacobian(states, actions, by=BY)
    for i in range(12):
        single = step_with_jacobian(states[i], actions[i], by=BY)
        for name in ("state", "reward", "outcomes", "jacobian", "derivative", "status"):
            assert np.asarray(getattr(single, name)).tobytes() == getattr(batch, name)[i].tobytes()
        assert single.smooth == batch.smooth[i]
        assert single.reasons == [batch.reasons[i]]
    empty = step_with_jacobian(np.empty((0, 3)), np.empty(0), by=BY)
    assert empty.jacobian.shape == (0, *batch.jacobian.shape[1:])


def test_rows_and_columns_are_found_by_name():
    found = step_with_jacobian([[0.3, 0.1, 0.2]] * 2, [0.1, 0.2], by=("belt_speed", "mu_m"))
    assert found.columns == ("x", "v", "v_belt", "action", "belt_speed", "mu_m")
    np.testing.assert_array_equal(found.by("reward", "mu_m"), found.jacobian[:, 3, 5])
    np.testing.assert_array_equal(found.reward, found.outcomes[:, found.rows.index("reward")])
    np.testing.assert_allclose(found.by("effort", "action"), -2.0 * Task().w_effort * np.array([0.1, 0.2]))
    assert "2 x 11 x 6" in repr(found)
    with pytest.raises(ValueError, match=r"row must be one of x, v, .*, got 'mu_m'"):
        found.by("mu_m", "x")
    with pytest.raises(ValueError, match=r"column must be one of x, .*, mu_m, got 'reward'"):
        found.by("x", "reward")


@pytest.mark.parametrize("actuator", TASKS)
def test_the_gradient_of_a_return_is_what_differences_give(actuator):
    task, by = TASKS[actuator], ("alpha", "belt_speed")
    state, actions = np.array([0.6, 0.1, 0.2]), np.random.default_rng(0).uniform(-0.9, 0.9, 20)

    def total(state=state, actions=actions, **changes):
        values = {name: NOMINAL.values[name] + change for name, change in changes.items()}
        return return_with_gradient(state, actions, NOMINAL.replace(**values), task).total

    found = return_with_gradient(state, actions, NOMINAL, task, by=by)
    assert found.smooth
    rewards, now = 0.0, state
    for action in actions:
        step = step_with_jacobian(now, action, NOMINAL, task)
        rewards, now = rewards + step.reward, step.state
    assert found.total == pytest.approx(rewards, rel=1e-14)
    for i in range(20):
        by_steps = difference(lambda d, i=i: total(actions=actions + d * np.eye(20)[i]), 1e-4)
        assert found.by_actions[i] == pytest.approx(by_steps, rel=1e-8, abs=1e-9)
    for i in range(2):
        assert found.by_state[i] == pytest.approx(
            difference(lambda d, i=i: total(state + d * np.eye(3)[i]), 1e-5), rel=1e-7
        )
    for name in by:
        by_steps = difference(lambda d, name=name: total(**{name: d}), 1e-5)
        assert found.by_parameters[name] == pytest.approx(by_steps, rel=1e-7)


def test_where_contact_is_lost_there_is_no_derivative():
    lost = step_with_jacobian([[1.3, 2.0, 0.2], [0.3, 0.1, 0.2]], [0.0, 0.0], LIFTING)
    assert lost.reasons == ["contact lost", "exists"]
    assert np.isnan(lost.jacobian[0]).all()
    assert np.isfinite(lost.jacobian[1]).all()
    np.testing.assert_array_equal(lost.smooth, [False, True])
    with pytest.raises(RuntimeError, match="cannot be followed to the end of the actions: contact lost"):
        return_with_gradient([1.3, 2.0, 0.2], [0.0, 0.0], LIFTING)


def test_an_event_on_the_border_of_a_step_is_said():
    """A mass that lands on the belt within 1e-9 of the start."""
    state = [0.3, 0.2 + 1e-11, 0.2]
    assert step_with_jacobian(state, 0.0).reasons == [
        "one-sided: an event falls on the start or the end, or the belt accelerates just at its limit"
    ]
    assert not return_with_gradient(state, [0.0]).smooth


@friction_law
class WithoutDerivatives(NamedTuple):
    """Coulomb's law, with no derivative by its number."""

    mu_s: float

    def coefficient(self, mode, v_rel):
        return mode * self.mu_s

    def slope(self, mode, v_rel):
        return 0.0

    def curvature(self, mode, v_rel):
        return 0.0

    def third_derivative(self, mode, v_rel):
        return 0.0


GOOD = {"state": [0.3, 0.1, 0.2], "action": 0.0}


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"state": [0.3, math.nan, 0.2]}, ValueError, "v must be finite, got nan at state 0"),
        ({"action": math.inf}, ValueError, "action must be finite, got inf at state 0"),
        ({"state": [1e308, 1e308, math.inf]}, ValueError, "v_belt must be finite, got inf"),
        ({"state": [0.3, 0.1]}, ValueError, r"must have shapes .*, got \(2,\) and \(\)"),
        ({"action": [0.0]}, ValueError, r"must have shapes .*, got \(3,\) and \(1,\)"),
        ({"state": np.zeros((2, 2, 3)), "action": np.zeros((2, 2))}, ValueError, "must have shapes"),
        ({"action": -1.5}, ValueError, r"action must be in \[-1, 1\], got -1.5"),
        ({"action": "0.3"}, TypeError, "state and action must be numbers, got .* and '0.3'"),
        ({"state": [0.3j, 0.1, 0.2]}, TypeError, "must be numbers"),
        ({"state": [None, 0.1, 0.2]}, TypeError, "must be numbers"),
        ({"time": math.nan}, ValueError, "time must be"),
        ({"by": ("mass",)}, ValueError, "unknown parameter 'mass'; allowed: alpha"),
        ({"by": ("mu_k",)}, ValueError, "the plant does not use the parameter 'mu_k'"),
        ({"by": ("alpha", "alpha")}, ValueError, "by must be different names"),
        ({"by": "alpha"}, ValueError, "by must be different names"),
        (
            {"by": ("friction.mu_s",), "parameters": NOMINAL.replace(friction=WithoutDerivatives(0.2))},
            ValueError,
            "WithoutDerivatives.* has no method coefficient_gradient",
        ),
    ],
)
def test_what_does_not_fit_is_refused(changes, error, message):
    with pytest.raises(error, match=message):
        step_with_jacobian(**(GOOD | changes))


@pytest.mark.parametrize(
    ("state", "actions", "message"),
    [
        ([0.3, 0.1, 0.2], 0.0, r"actions must have shape \(steps,\) with steps >= 1, got \(\)"),
        ([0.3, 0.1, 0.2], [], r"actions must have shape"),
        (np.full((3, 3), 0.2), [0.0] * 3, r"state must have shape \(3,\), got \(3, 3\)"),
        (0.2, [0.0], r"state must have shape \(3,\), got \(\)"),
        ([0.3, 0.1, math.nan], [0.0], "v_belt must be finite"),
        ([0.3, 0.1, 0.2], [0.0, 1.5], "action must be in"),
    ],
)
def test_a_return_refuses_what_does_not_fit(state, actions, message):
    with pytest.raises(ValueError, match=message):
        return_with_gradient(state, actions)


def test_a_belt_that_accelerates_just_at_its_limit_has_a_one_sided_derivative():
    task = Task(actuator="belt_speed")
    for action, code in (
        (0.5, kernel.AT_BORDER),
        (-0.5, kernel.AT_BORDER),
        (0.499, kernel.SMOOTH),
        (0.6, kernel.SMOOTH),
    ):
        assert step_with_jacobian((0.5, -0.3, 0.2), action, task=task).derivative == code, action
