"""Controllers on other plants: the plants squeal, and what is hidden stays hidden."""

import numpy as np
import pytest

from sd_friction_env import OscillatorParameters, limit_cycle, load_pretrained
from sd_friction_env.control.policies import EstimatingFollower, ThresholdFollower, ZeroPolicy
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation, off_nominal

BELT = "SDFriction/BeltSpeed-v0"
SEEDS = evaluation.VALIDATION_SEEDS[:3]


@pytest.mark.parametrize("plant", off_nominal.PLANTS)
def test_every_plant_squeals_with_stick(plant):
    nominal = OscillatorParameters()
    parameters = nominal.replace(**off_nominal.PLANTS[plant])
    assert parameters != nominal
    cycle = limit_cycle(parameters)
    assert cycle.amplitude > 0.2
    assert cycle.sticks >= 1


def test_there_are_fifteen_different_plants():
    plants = [OscillatorParameters().replace(**change) for change in off_nominal.PLANTS.values()]
    assert len(set(plants)) == 15


class Sees:
    """A policy that keeps the first observation."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.first = observation if state is None else self.first
        return np.zeros((len(observation), 1), np.float32), (np.zeros(1),)


def test_each_controller_meets_each_plant_with_the_scales_of_the_nominal_one():
    env = make_env(BELT)
    sees = Sees()
    policies = {"passive": ZeroPolicy(), "told": ThresholdFollower.from_env(env), "sees": sees}
    policies["not told"] = EstimatingFollower.from_env(env)
    plants = {name: off_nominal.PLANTS[name] for name in ("alpha 0.7", "belt speed +20%")}
    table = off_nominal.evaluate_off_nominal(policies, BELT, SEEDS, plants)
    assert table["plant"].tolist() == [plant for plant in plants for _ in policies]
    shares = {(row["plant"], row["controller"]): row["suppressed"] for row in table.rows()}
    assert (
        shares["alpha 0.7", "told"] == shares["alpha 0.7", "not told"] == shares["belt speed +20%", "not told"] == 1.0
    )
    assert shares["belt speed +20%", "told"] == 0.0  # the slowest belt is faster than its threshold
    assert shares["alpha 0.7", "passive"] == 0.0
    states = evaluation.run_episodes(ZeroPolicy(), BELT, SEEDS, options={"parameters": {"belt_speed": 0.24}})
    place = sees.first[:, 0] * env.task.x_scale + env.task.x_offset
    assert (place >= states.x_min.min(axis=1) - 1e-6).all()
    assert (place <= states.x_max.max(axis=1) + 1e-6).all()
    one = evaluation.evaluate(ThresholdFollower.from_env(env), BELT, SEEDS)
    same = off_nominal.evaluate_off_nominal({"told": ThresholdFollower.from_env(env)}, BELT, SEEDS, {"none": {}})
    assert same["return"][0] == one["return"].mean()
    lines = off_nominal.as_markdown(table).splitlines()
    assert lines[0] == "| plant | passive | told | sees | not told |"
    assert lines[2].startswith("| alpha 0.7 | 0%, -4")
    assert lines[-1] == "| all suppressed | 0 of 2 | 1 of 2 | 0 of 2 | 2 of 2 |"


def test_under_coulombs_law_only_the_damping_ends_the_vibration():
    # Its friction does not depend on the sliding speed: while the mass slips, the belt has no effect (docs/control.md).
    env, seeds = make_env(BELT), evaluation.VALIDATION_SEEDS[:20]
    options = {"parameters": off_nominal.PLANTS["Coulomb friction, 0.3 and 0.05"]}
    for policy in (EstimatingFollower.from_env(env), load_pretrained("SDFriction/BeltSpeedRandomised-v0")):
        for steps, share in ((500, 0.0), (1000, 1.0)):
            how = {"env_kwargs": {"episode_steps": steps}, "options": options}
            passive, controlled = (evaluation.run_episodes(acts, BELT, seeds, **how) for acts in (ZeroPolicy(), policy))
            table = evaluation.metrics(controlled, passive)
            assert table["suppressed"].mean() == share
            assert table["late_stick_fraction"].max() == 0.0
