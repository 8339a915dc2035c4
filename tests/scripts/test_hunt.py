"""The hunt finds what is planted, passes over what is right, and outlives what hangs or crashes."""

import dataclasses
import math
import os
import time

import numpy as np
import pytest

from scripts import hunt as script
from scripts.hunting import against_scipy, draws, environments, events, fuzz, motions, steps, trials
from scripts.hunting.trials import Check, Failure, SetAside
from sd_friction_env import OscillatorParameters, SDFrictionEnv, SDFrictionVectorEnv, simulate

# Trials that hold, and take little time.
HELD = {
    "steps": range(14),
    "slow": range(6),
    "scipy": range(3),
    "events": (0, 1, 2, 3, 4, 6, 7),
    "batches": (0, 1, 2),
    "interpreted": (0,),
    "infos": (0, 1, 2, 3, 4, 5, 7),
    "attractors": (1, 3, 4),
    "multipliers": (1, 4),
    "legal": (0, 2, 3, 5),
    "arguments": range(20),
    "commands": (0,),
}


COMPILES_MUCH = ("steps", "batches", "interpreted", "multipliers")


def failure_of(trial, *arguments):
    """Return the kind of failure that a trial raises."""
    with pytest.raises(Failure) as found:
        trial(*arguments)
    return script.kind_of(str(found.value))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in COMPILES_MUCH else []) for name in HELD]
)
def test_what_is_right_holds(name):
    check = script.CHECKS[name]
    check.prepare()
    outcomes = [trials.outcome(check, 0, index) for index in HELD[name]]
    assert [outcome for outcome in outcomes if outcome.kind != "held"] == []


def test_every_check_is_tried_here_or_lends_another_script():
    assert script.CHECKS.keys() - HELD.keys() == {"labels", "files"}


def test_a_trial_depends_on_its_seed_and_index_alone():
    assert steps.drawn(3, 8) == steps.drawn(3, 8)
    assert len({steps.drawn(seed, index) for seed in (3, 4) for index in (8, 9)}) == 4


def test_plants_are_drawn_over_the_whole_range():
    plants = [draws.plant(draws.generator(0, index)) for index in range(2000)]
    kinds = {(p.geometry, p.friction) for p in plants}
    assert len(kinds) == 20
    assert {p.alpha for p in plants if p.geometry == "exact"} >= {0.0, 0.001, 10.0}
    assert {p.beta for p in plants} >= {0.0, 10.0}
    assert any(p.mu_m == p.mu_s > 0.0 and p.friction == "stribeck" for p in plants)
    assert min(p.v_m for p in plants) == 0.01
    assert {p.belt_speed for p in plants} >= {0.0, 10.0}
    assert 0.2 < np.mean([p.excited for p in plants]) < 0.4
    for kind in ("force", "ripple", "stiffness"):
        assert max(getattr(p, f"{kind}_frequency") for p in plants) == 1000.0
    exactly_with_the_belt = sum(at.v == at.v_belt for _, at in (steps.drawn(0, index) for index in range(500)))
    assert exactly_with_the_belt > 50


# What is planted ------------------------------------------------------------------------------------------------------

PLAIN = OscillatorParameters()
START = draws.Start(0.3, 0.1, 0.2, 0.0, 0.01, 0.0)


def step_with(monkeypatch, spoil, start=START):
    """Return the kind of failure that a step gives whose rows are spoiled."""
    right = steps.run

    def wrong(p, at, duration, pieces, moved=(-1, 0, 0)):
        rows = right(p, at, duration, pieces, moved)
        spoil(rows)
        return rows

    monkeypatch.setattr(steps, "run", wrong)
    return failure_of(steps.examine, PLAIN, start)


def spoil_whole(column, by):
    def spoil(rows):
        if len(rows) == 1:
            rows[0, column] += by

    return spoil


def spoil_all(column, by):
    def spoil(rows):
        rows[:, column] += by

    return spoil


@pytest.mark.parametrize(
    ("spoil", "kind"),
    [
        (spoil_whole(steps.V, 1e-8), "pieces: inexact"),
        (spoil_whole(steps.V, 1e-3), "pieces: garbage"),
        (spoil_all(steps.V, 1e-6), "energy: inexact"),
        (spoil_all(steps.INT_FV, 1e-3), "energy: garbage"),
        (spoil_all(steps.X, 1.0), "extremes"),
        (spoil_all(steps.X, math.nan), "not finite"),
        (spoil_all(steps.MODE, 2.0), "mode"),
        (spoil_all(steps.STICK_TIME, 1.0), "times"),
        (spoil_all(steps.INT_V2, -1.0), "integrals"),
        (spoil_all(steps.STATUS, 1.0), "contact"),
    ],
)
def test_a_spoiled_step_is_found(monkeypatch, spoil, kind):
    assert step_with(monkeypatch, spoil) == kind


def test_creep_and_stick_outside_the_cone_are_found(monkeypatch):
    stuck = START._replace(x=0.0, v=0.2)
    with monkeypatch.context() as patch:
        assert step_with(patch, spoil_all(steps.V, 1e-9), stuck) == "creep"

    def far_away(rows):
        rows[:, [steps.X, steps.X_MIN, steps.X_MAX]] = 5.0

    assert step_with(monkeypatch, far_away, stuck) == "cone"


def test_a_limit_is_set_aside(monkeypatch):
    with pytest.raises(SetAside, match="step limit"):
        step_with(monkeypatch, spoil_all(steps.STATUS, 3.0))


def test_a_graze_is_judged_by_what_the_promised_error_does_to_it():
    # The mass comes to the belt's speed at the end of the first half, or just does not.
    p = OscillatorParameters(geometry="linear", friction="coulomb", mu_s=0.0, mu_k=0.0, mu_m=0.0, beta=0.0)
    quarter = START._replace(x=math.cos(0.05), v=0.2 - math.sin(0.05) + 1e-16, v_belt=0.2, u=0.0)
    steps.examine(p, quarter)


def test_a_gap_to_scipy_is_found(monkeypatch):
    right = against_scipy.answer

    def wrong(p, at):
        run = right(p, at)
        return dataclasses.replace(run, x=run.x + 1e-5 * max(1.0, abs(run.x), abs(run.v)))

    monkeypatch.setattr(against_scipy, "answer", wrong)
    assert failure_of(against_scipy.trial, 0, 1) == "scipy: inexact"


def spoiled_simulate(spoil):
    def wrong(*arguments, **keywords):
        history = simulate(*arguments, **keywords)
        return spoil(history, keywords)

    return wrong


def drop_last(history, keywords):
    return dataclasses.replace(history, events=history.events[:-1]) if keywords["dt"] == 0.1 else history


def delay_last(history, keywords):
    if "hold" not in keywords or not history.events:
        return history
    last = history.events[-1]
    return dataclasses.replace(history, events=(*history.events[:-1], last._replace(time=last.time + 1e-6)))


def with_events():
    """Return the index of a trial whose history has events, and holds."""
    return next(i for i in HELD["events"] if events.drawn(0, i).history.events)


def test_events_that_depend_on_the_sampling_are_found(monkeypatch):
    index = with_events()
    with monkeypatch.context() as patch:
        patch.setattr(events, "simulate", spoiled_simulate(drop_last))
        assert failure_of(events.trial, 0, index) == "events: dt"
    monkeypatch.setattr(events, "simulate", spoiled_simulate(delay_last))
    assert failure_of(events.trial, 0, index) == "event times"


def test_a_reward_one_bit_off_in_a_batch_is_found(monkeypatch):
    class Wrong(SDFrictionVectorEnv):
        def step(self, actions):
            observations, rewards, *rest = super().step(actions)
            rewards[-1] = np.nextafter(rewards[-1], -np.inf)
            return observations, rewards, *rest

    monkeypatch.setattr(environments, "SDFrictionVectorEnv", Wrong)
    assert failure_of(environments.batch_trial, 0, 1) == "batch"


@pytest.mark.slow
def test_another_answer_of_interpreted_code_is_found(monkeypatch):
    right = environments.fingerprints

    def wrong(seed, index):
        prints = right(seed, index)
        prints[0][1] = {**prints[0][1], "reward": "0x1p0"}
        return prints

    monkeypatch.setattr(environments, "fingerprints", wrong)
    assert failure_of(environments.interpreted_trial, 0, 0) == "interpreted"


@pytest.mark.parametrize(("name", "value"), [("v_rel", 0.1), ("time", 0.3), ("normal_force", 2.0), ("x_max", -9.0)])
def test_an_info_of_two_moments_is_found(monkeypatch, name, value):
    class Wrong(SDFrictionEnv):
        def step(self, action):
            *rest, info = super().step(action)
            return *rest, {**info, name: value}

    monkeypatch.setattr(environments, "SDFrictionEnv", Wrong)
    assert failure_of(environments.info_trial, 0, 3) in ("info", "extremes")


def test_an_attractor_that_attracts_nothing_is_found(monkeypatch):
    monkeypatch.setattr(motions, "distance_left", lambda cycle, moved: 1.0)
    monkeypatch.setattr(draws, "plant", lambda rng, **choices: PLAIN.replace(belt_speed=0.42))
    assert failure_of(motions.attractor_trial, 0, 0) == "attracts nothing"


@pytest.mark.slow
def test_a_multiplier_that_depends_on_the_section_is_found(monkeypatch):
    right = motions.forced_orbit

    def wrong(p, x, v, **keywords):
        orbit = right(p, x, v, **keywords)
        if keywords.get("transient") == 0:
            orbit = dataclasses.replace(orbit, multipliers=tuple(1.1 * m for m in orbit.multipliers))
        return orbit

    monkeypatch.setattr(motions, "forced_orbit", wrong)
    kinds = [trials.outcome(motions.MULTIPLIERS, 0, index).words[:13] for index in HELD["multipliers"]]
    assert "[multipliers]" in kinds


def test_a_slow_interval_is_found(monkeypatch):
    monkeypatch.setattr(steps, "LONGEST", -1.0)
    assert failure_of(steps.slow_trial, 0, 0) == "slow"


def test_errors_of_a_wrong_kind_or_without_a_name_are_found(monkeypatch):
    def without_a_name(**arguments):
        raise ValueError("something is wrong")

    def of_a_wrong_kind(**arguments):
        raise KeyError("alpha")

    assert failure_of(fuzz.refused, "call", without_a_name, ("alpha",)) == "names no argument"
    assert failure_of(fuzz.refused, "call", of_a_wrong_kind, ("alpha",)) == "KeyError"
    monkeypatch.setattr(fuzz, "OscillatorParameters", without_a_name)
    assert failure_of(fuzz.legal_trial, 0, 0) == "legal parameters refused"


def test_a_command_that_ends_in_a_traceback_or_takes_too_long_is_found(monkeypatch):
    monkeypatch.setattr(fuzz, "command_line", lambda rng: ["--version"])
    fuzz.command_trial(0, 0)
    monkeypatch.setattr(fuzz, "MODULE", ("-c", "raise SystemExit(3)"))
    assert failure_of(fuzz.command_trial, 0, 0) == "command"
    monkeypatch.setattr(fuzz, "MODULE", ("-c", "import time; time.sleep(60)"))
    monkeypatch.setattr(fuzz, "COMMAND_SECONDS", 0.5)
    assert failure_of(fuzz.command_trial, 0, 0) == "command: slow"


# The process of the trials -------------------------------------------------------------------------------------------


def mixed_trial(seed, index):
    """Hold, fail, hang, crash or be set aside, by the index."""
    if index == 2:
        raise Failure("planted", "two is wrong")
    if index == 3:
        raise SetAside("three says nothing")
    if index == 4:
        time.sleep(100.0)
    if index == 5:
        os._exit(7)
    if index == 6:
        raise KeyError("six")
    return {"largest": float(index)}


@pytest.mark.slow
def test_a_hunt_outlives_trials_that_hang_or_crash():
    check = Check("mixed", "all kinds", mixed_trial, patience=3.0)
    findings, interrupted = script.hunt(check, 0, 0, 9, math.inf)
    assert (findings.tried, findings.held, findings.ended, interrupted) == (9, 4, 2, False)
    assert findings.aside == {"three says nothing": 1}
    kinds = {index: script.kind_of(words) for index, words in findings.failures.items()}
    assert kinds == {2: "planted", 4: "slow", 5: "crash", 6: "KeyError"}
    assert findings.greatest == {"largest": (8.0, 8)}


def test_a_check_that_cannot_begin_ends_the_hunt():
    check = Check("broken", "never ready", mixed_trial, prepare=lose_heart)
    with pytest.raises(RuntimeError, match="broken cannot begin"):
        script.hunt(check, 0, 0, 9, math.inf)


def lose_heart():
    raise SystemExit(5)


def test_the_command_prints_what_was_tried_and_exits_1_on_failures(monkeypatch, capsys):
    monkeypatch.setattr(script, "CHECKS", {"mixed": Check("mixed", "all kinds", mixed_trial)})
    assert script.main(["--plants", "4", "--seed", "7"]) == 1
    told = capsys.readouterr().out
    assert "tried 4, held 2, failed 1" in told
    assert "FAILED mixed-7-2: [planted] two is wrong" in told
    assert "set aside: 1 (three says nothing)" in told
    assert script.main(["--plants", "2"]) == 0
    assert script.main(["--replay", "mixed-7-2"]) == 1
    assert script.main(["--replay", "mixed-7-3"]) == 0
    assert script.main(["--replay", "mixed-7"]) == 2
