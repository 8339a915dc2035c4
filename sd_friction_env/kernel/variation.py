"""The variational equation: how small changes of a slip's start, drive and plant grow, by the slip's own formula.

A tangent is a column of ``tangents`` (TANGENT_ROWS, n): the first-order change of the state in the belt's frame, of the
drive, and of the integrals so far, in one direction. The last m tangents are of a plant that changes too, by a row each
of ``directions`` (m, numbers of the plant), or none does (None).
"""

import math
from typing import Any, NamedTuple

import numpy as np

from sd_friction_env.kernel import tableau
from sd_friction_env.kernel.codes import (
    MAX_SLIP_STEP,
    MIN_SLIP_STEP,
    SLIP_TRIAL_RATE,
    SLIP_TRIALS,
    STEP_DOUBLING,
    STIFF,
    V_REL_ZERO,
)
from sd_friction_env.kernel.compilation import compiled, in_lanes, reader
from sd_friction_env.kernel.events import Surface, find_double_crossing, leaps_over_layer, look_at
from sd_friction_env.kernel.forces import normal_force, normal_slope, restoring_slope, stick_load
from sd_friction_env.kernel.plant import State, at_time, drive_at, select_field
from sd_friction_env.kernel.plant_gradients import contact_gradient, external_gradient, ripple_gradient
from sd_friction_env.kernel.runge_kutta import slip_stages
from sd_friction_env.kernel.slip import error_bounds, select_field_in_slip
from sd_friction_env.kernel.stick import NODES, WEIGHTS, ridden

# The rows of tangents: x, v, the belt's speed and acceleration, the force, the integral of v^2, the time stuck and the
# integral of the contact force's power.
(TANGENT_X, TANGENT_V, TANGENT_BELT, TANGENT_A_BELT, TANGENT_U, TANGENT_V2, TANGENT_STICK, TANGENT_FV) = range(8)
TANGENT_ROWS = 8
_STAGES = 12
TANGENT_TOLERANCE = 1e-9  # estimated error per unit of time of a tangent, relative to its size
_C = tuple(getattr(tableau, f"C{i}", 0.0) for i in range(1, _STAGES + 1))


# Rows of the flat scratch array of _BLOCK tangents: at a step's start, what the plant's changes add at each stage to
# the acceleration, the contact force and the velocity, and at the step's end.
_BLOCK, _LANES = 16, 8  # tangents are stepped in blocks, so many of them side by side
_SOURCE_ROW = 5
_END_ROW = _SOURCE_ROW + 3 * _STAGES
_ROWS = _END_ROW + 6  # x, v, the changes of the integrals of v^2 and of the power, the estimated error, dv/dt at first


class Work(NamedTuple):
    """Scratch arrays for n tangents."""

    linear: Any  # at each stage: stiffness, damping, grip, contact stiffness, velocity, contact force, (6 _STAGES,)
    lanes: Any  # (blocks, _ROWS _BLOCK)
    contact: Any  # derivatives of the contact force, or of the limit of stick, by the plant's numbers
    external: Any  # of the other forces, or of the load
    shift: Any  # of the ripple's speed or displacement


@compiled
def work_for(tangents, numbers):
    """Return scratch arrays for so many tangents of a plant of so many numbers."""
    blocks = (tangents + _BLOCK - 1) // _BLOCK
    lanes = np.zeros((blocks, _ROWS * _BLOCK))
    return Work(np.empty(6 * _STAGES), lanes, np.empty(numbers), np.empty(numbers), np.empty(numbers))


def _column_source():
    """Return the source of a step of n tangents, written out from the tableau: its loop becomes vector instructions."""

    def total(letter, coefficients):
        return " + ".join(f"{value!r} * {letter}{i}" for i, value in enumerate(coefficients, 1) if value)

    def row(name):
        return [getattr(tableau, f"{name}{i}", 0.0) for i in range(1, _STAGES + 1)]

    def lane(row):
        return f"lanes[{row * _BLOCK} + j]"

    linear = [f"{name}{i + 1} = linear[{r * _STAGES + i}]" for r, name in enumerate("kcgruf") for i in range(_STAGES)]
    body = [f"{name} = {lane(r)}" for r, name in enumerate(("x", "v", "belt", "a_belt", "force"))]
    for i in range(1, _STAGES + 1):
        a = row(f"A{i}_")
        by_a, by_contact, by_velocity = (lane(_SOURCE_ROW + r * _STAGES + i - 1) for r in range(3))
        body += [
            f"v{i} = v + h * ({total('a', a)})" if any(a) else f"v{i} = v",
            f"x{i} = x + h * ({total('v', a)})" if any(a) else f"x{i} = x",
            f"b{i} = belt + {_C[i - 1]!r} * h * a_belt",
            f"a{i} = g{i} * b{i} - k{i} * x{i} - c{i} * v{i} + force + {by_a}",
            f"w{i} = v{i} + {by_velocity}",
            f"p{i} = 2.0 * u{i} * w{i}",
            f"q{i} = ({by_contact} - r{i} * x{i} - g{i} * (v{i} - b{i})) * u{i} + f{i} * w{i}",
        ]
    for name in ("E5", "E3"):
        body += [f"{name}x = {total('v', row(f'{name}_'))}", f"{name}v = {total('a', row(f'{name}_'))}"]
    body += ["fifth = E5x * E5x + E5v * E5v", "third = E3x * E3x + E3v * E3v"]
    for r, (start, letter) in enumerate((("x + ", "v"), ("v + ", "a"), ("", "p"), ("", "q"))):
        body += [f"{lane(_END_ROW + r)} = {start}h * ({total(letter, row('B'))})"]
    body += [
        f"{lane(_END_ROW + 4)} = h * fifth / math.sqrt(2.0 * (fifth + 0.01 * third) + 1e-200)",
        f"{lane(_END_ROW + 5)} = a1",
    ]
    loop = ["for j in range(n):", *(f"    {line}" for line in body)]
    return "def column_steps(linear, lanes, n, h):\n" + "".join(f"    {line}\n" for line in (*linear, *loop))


_names: dict[str, Any] = {"math": math}
exec(_column_source(), _names)
_column_steps = reader(_names["column_steps"], _column_source(), [], 0)


@compiled
def linearise(plant, mode, stages, drive, h, work):
    """Write how the forces change with the state at each stage: da = -stiffness dx - damping dv + grip dv_belt."""
    for i in range(_STAGES):
        t = _C[i] * h
        now = at_time(plant, t)
        place = now.excitation.lab_position(stages.x[i])
        v_rel = stages.v[i] - (drive.v_belt + drive.a_belt * t)
        grip = now.friction.slope(mode, v_rel) * normal_force(now, place)
        pull = now.friction.coefficient(mode, v_rel) * normal_slope(now, place)
        work.linear[0 * _STAGES + i] = restoring_slope(now, place) + pull
        work.linear[1 * _STAGES + i] = 2.0 * now.beta + grip
        work.linear[2 * _STAGES + i] = grip
        work.linear[3 * _STAGES + i] = pull
        work.linear[4 * _STAGES + i] = now.excitation.lab_velocity(stages.v[i])
        work.linear[5 * _STAGES + i] = stages.contact[i]


@compiled
def along(direction, gradient):
    """Return the derivative in a direction."""
    total = 0.0
    for i in range(len(gradient)):
        total += direction[i] * gradient[i]
    return total


@compiled
def slip_gradients(plant, mode, x, v, v_belt, work):
    """Write the derivatives of the contact force and of the external ones by the plant's numbers, and the ripple's."""
    v_rel = v - v_belt
    mu = plant.friction.coefficient(mode, v_rel)
    contact_gradient(plant, mu, plant.friction.coefficient_gradient(mode, v_rel), x, work.contact)
    external_gradient(plant, x, v, work.external)
    ripple_gradient(plant, work.shift, 0.0)


@compiled
def sources_of(plant, mode, stages, drive, h, directions, first, work):
    """Write what the plant's changes add at each stage to the tangents from ``first`` on."""
    for i in range(_STAGES):
        t = _C[i] * h
        now = at_time(plant, t)
        slip_gradients(now, mode, stages.x[i], stages.v[i], drive.v_belt + drive.a_belt * t, work)
        for j in range(len(directions)):
            lanes = work.lanes[(first + j) // _BLOCK]
            place = (_SOURCE_ROW + i) * _BLOCK + (first + j) % _BLOCK
            contact = -along(directions[j], work.contact)
            lanes[place] = contact - along(directions[j], work.external)
            lanes[place + _STAGES * _BLOCK] = contact
            lanes[place + 2 * _STAGES * _BLOCK] = along(directions[j], work.shift)


@compiled
def step_tangents(tangents, h, work):
    """Step all tangents by h, with what :func:`linearise` and :func:`sources_of` wrote."""
    n = tangents.shape[1]
    for block in range(len(work.lanes)):
        lanes = work.lanes[block]
        first = block * _BLOCK
        count = min(_BLOCK, n - first)
        for j in range(count):
            for row in range(_SOURCE_ROW):
                lanes[row * _BLOCK + j] = tangents[row, first + j]
        _column_steps(work.linear, lanes, (count + _LANES - 1) // _LANES * _LANES, h)


@in_lanes
def _end_of(work, row, j):
    """Return what a step of tangent j came to."""
    return work.lanes[j // _BLOCK, (_END_ROW + row) * _BLOCK + j % _BLOCK]


@compiled
def carry_in_slip(plant, mode, state, drive, duration, tangents, directions, work, known, stages):
    """Carry tangents along a slip of this length, in which nothing happens.

    Return whether that could be done, the least v_rel, in size, where it has a minimum in between (infinity without
    one), and where the slip ends. If ``known`` is 1, ``stages`` are those of the step over all of it.
    """
    plant = select_field_in_slip(plant, mode, state, drive)
    longest = plant.excitation.shortened(1.0, MAX_SLIP_STEP)
    layer = plant.friction.layer_width(mode)
    x, v = state
    n = tangents.shape[1]
    t = 0.0
    h = longest
    trials = SLIP_TRIALS
    nearest = math.inf
    while t < duration:
        remaining = duration - t
        h = min(h, remaining)
        trials -= 1.0
        if trials + SLIP_TRIAL_RATE * t < 0.0:
            return False, nearest, x, v
        now = at_time(plant, t)
        here = drive_at(drive, t)
        if known != 1.0:
            stages = slip_stages(now, mode, State(x, v), here, h)
        known = 0.0
        step = stages.step
        linearise(now, mode, stages, here, h, work)
        if directions is not None:
            sources_of(now, mode, stages, here, h, directions, n - len(directions), work)
        step_tangents(tangents, h, work)
        # The motion's own steps, so that tangents are the derivative of what was computed; shorter where a law bends.
        allowed, noise = error_bounds(now, mode, State(x, v), here.v_belt, step.a, h)
        accepted = step.error <= max(allowed, noise)
        for j in range(n):
            dx, dv, rate = tangents[TANGENT_X, j], tangents[TANGENT_V, j], _end_of(work, 5, j)
            size = max(1.0, abs(dx), abs(dv), STIFF * abs(rate))
            accepted = accepted and _end_of(work, 4, j) <= max(TANGENT_TOLERANCE * h, noise) * size
        gap = mode * (v - here.v_belt)
        gap_end = mode * (step.v - here.v_belt - here.a_belt * h)
        slope, slope_end = mode * (step.a - here.a_belt), mode * (step.a_end - here.a_belt)
        if not accepted or leaps_over_layer(layer, gap, gap_end, slope, slope_end, h):
            h = 0.5 * h
            if h < MIN_SLIP_STEP:
                return False, nearest, x, v
            continue
        if V_REL_ZERO < gap < h * (slope_end - slope) and slope < 0.0 < slope_end:
            # It nears the belt and leaves it again.
            to_belt = Surface(float(mode), here.v_belt, here.a_belt, False)
            bottom = find_double_crossing(now, mode, State(x, v), here, h, to_belt, slope, slope_end)[1]
            nearest = min(nearest, abs(look_at(now, mode, State(x, v), here, bottom, to_belt).gap))
        x, v = step.x, step.v
        for j in range(n):
            tangents[TANGENT_X, j] = _end_of(work, 0, j)
            tangents[TANGENT_V, j] = _end_of(work, 1, j)
            tangents[TANGENT_BELT, j] += tangents[TANGENT_A_BELT, j] * h
            tangents[TANGENT_V2, j] += _end_of(work, 2, j)
            tangents[TANGENT_FV, j] += _end_of(work, 3, j)
        t = duration if h == remaining else t + h
        if step.error < max(STEP_DOUBLING * allowed, noise):
            h = min(2.0 * h, longest)
    return True, nearest, x, v


@compiled
def carry_in_stick(plant, x, drive, duration, tangents, directions, work):
    """Carry tangents along a stick of this length: they ride with the belt."""
    plant = select_field(plant, x, drive.v_belt)
    n = tangents.shape[1]
    unchanged = n if directions is None else n - len(directions)
    fastest = max(abs(drive.v_belt), abs(drive.v_belt + drive.a_belt * duration)) + plant.excitation.ripple_speed()
    piece = plant.excitation.shortened(0.125, 0.5)
    if fastest > 0.0:
        piece = min(piece, 0.125 * plant.spring.length_scale() / fastest)
    pieces = int(duration / piece) + 1
    for i in range(5 * pieces):
        length = duration / pieces
        t = (i // 5 + NODES[i % 5]) * length
        weight = WEIGHTS[i % 5] * length
        now = at_time(plant, t)
        there = drive_at(drive, t)
        x_t = ridden(x, drive, t)
        place = now.excitation.lab_position(x_t)
        w = now.excitation.lab_velocity(there.v_belt)
        load = stick_load(now, x_t, there)
        if directions is not None:
            external_gradient(now, x_t, there.v_belt, work.external)
            ripple_gradient(now, work.shift, 0.0)
        for j in range(n):
            a_belt = tangents[TANGENT_A_BELT, j]
            dw = tangents[TANGENT_BELT, j] + a_belt * t
            dx = tangents[TANGENT_X, j] + (tangents[TANGENT_BELT, j] + 0.5 * a_belt * t) * t
            d_load = a_belt + 2.0 * plant.beta * dw + restoring_slope(now, place) * dx - tangents[TANGENT_U, j]
            if directions is not None:
                if j >= unchanged:
                    d_load += along(directions[j - unchanged], work.external)
                    dw += along(directions[j - unchanged], work.shift)
            tangents[TANGENT_V2, j] += weight * (2.0 * w * dw)
            tangents[TANGENT_FV, j] += weight * (d_load * w + load * dw)
    for j in range(n):
        a_belt = tangents[TANGENT_A_BELT, j]
        tangents[TANGENT_X, j] += (tangents[TANGENT_BELT, j] + 0.5 * a_belt * duration) * duration
        tangents[TANGENT_BELT, j] += a_belt * duration
        tangents[TANGENT_V, j] = tangents[TANGENT_BELT, j]
    return State(ridden(x, drive, duration), drive.v_belt + drive.a_belt * duration)
