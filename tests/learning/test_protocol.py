"""The protocol's entries: what is run is what is stored, and whatever else an entry says is found out."""

import copy
import json

import numpy as np
import pytest

from sd_friction_env import ENVIRONMENT_IDS
from sd_friction_env.control.policies import ConstantPolicy, VelocityFeedback, ZeroPolicy
from sd_friction_env.environments import ids
from sd_friction_env.environments.single import make_env
from sd_friction_env.learning import evaluation, protocol
from sd_friction_env.learning.protocol import EntryError
from sd_friction_env.storage import StoredFileError, read_json, write_json

FORCE, BELT, HIDDEN = "SDFriction/Force-v0", "SDFriction/BeltSpeed-v0", "SDFriction/ForceRandomised-v0"


def feedback(env_id):
    return VelocityFeedback.from_env(make_env(env_id), 1.5)


@pytest.fixture(scope="module")
def made():
    """Return an entry of velocity feedback on two environments."""
    entry = protocol.new_entry("feedback", "velocity-feedback")
    for env_id in (FORCE, HIDDEN):
        entry["environments"][env_id] = protocol.measure(feedback(env_id), "feedback", env_id)
    return entry


@pytest.fixture
def entry(made):
    return copy.deepcopy(made)


@pytest.fixture
def path(tmp_path, made):
    protocol.write_entry(made, tmp_path / "entry.json")
    return tmp_path / "entry.json"


def test_an_entry_holds_the_episodes_and_is_read_as_it_was_written(path, made):
    table = evaluation.evaluate(feedback(FORCE), FORCE)
    result = made["environments"][FORCE]
    assert np.abs(result["returns"] - table["return"]).max() <= 0.05 + 1e-9
    assert [flag == "1" for flag in result["suppressed"]] == table["suppressed"].tolist()
    assert result["rms_action"] == pytest.approx(table["rms_action"].mean(), abs=1e-4)
    assert 0.0 < result["milliseconds"] < 10.0
    assert protocol.read_entry(path) == made
    assert path.stat().st_size < 5000
    for env_id in (FORCE, HIDDEN):
        assert protocol.differences(protocol.read_entry(path), env_id, feedback(env_id)) == []


def test_environments_after_the_first_are_stored_as_what_differs_from_it(entry, tmp_path):
    entry["environments"][BELT] = protocol.measure(ZeroPolicy(), "passive", BELT)
    protocol.write_entry(entry, tmp_path / "three.json")
    stored = read_json(tmp_path / "three.json")["environments"]
    assert list(stored[HIDDEN]["configuration"]["task"]) == ["randomise"]
    assert stored[BELT]["configuration"]["parameters"] == {}
    assert "randomise" not in stored[BELT]["configuration"]["task"]  # as in the first
    assert protocol.read_entry(tmp_path / "three.json") == entry


def test_an_entry_changed_by_hand_differs_from_its_digest(path):
    text = path.read_text()
    for old, new in (
        ('"knows": ""', '"knows": "x"'),
        (
            "[-",
            "[-1",
        ),
        ('"suppressed":"1', '"suppressed":"0'),
    ):
        assert old in text
        path.write_text(text.replace(old, new, 1))
        with pytest.raises(StoredFileError, match=r"entry\.json.*differs from its digest"):
            protocol.read_entry(path)
    unsealed = json.loads(text)
    del unsealed["sha256"]
    path.write_text(json.dumps(unsealed))
    with pytest.raises(StoredFileError, match=r"entry\.json.*no digest"):
        protocol.read_entry(path)


def test_an_entry_with_a_new_digest_is_found_out_when_it_is_recomputed(entry, tmp_path):
    result = entry["environments"][FORCE]
    result["returns"][3] += 0.2
    result["suppressed"] = result["suppressed"][:5] + "0" + result["suppressed"][6:]
    result["rms_action"] *= 0.9
    protocol.write_entry(entry, tmp_path / "forged.json")
    forged = protocol.read_entry(tmp_path / "forged.json")
    first, second, third = protocol.differences(forged, FORCE, feedback(FORCE))
    assert first.startswith("seed 1000003: ")
    assert second.startswith("seed 1000005: ")
    assert "not suppressed, in the entry" in second
    assert third.startswith("rms action: ")
    assert len(protocol.differences(forged, FORCE, feedback(FORCE), 4)) == 1
    assert protocol.differences(forged, FORCE, feedback(FORCE), 3) == []
    assert len(protocol.differences(forged, FORCE, ZeroPolicy(), 10)) == 10


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        ({"kind": "another"}, "not a sd_friction_env benchmark entry"),
        ({"format": 2}, "of format 1"),
        ({"seeds": [0, 99]}, "seeds must be the protocol's, 1000000 to 1000099"),
        ({"environments": {}}, "no environment"),
        ({"name": "a | b"}, "name must be one line"),
    ],
)
def test_what_is_no_entry_is_refused_by_name(path, damage, said):
    write_json(path, read_json(path) | damage)
    with pytest.raises(StoredFileError, match=rf"entry\.json.*{said}"):
        protocol.read_entry(path)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        ({"returns": [1.0] * 99}, "100 finite returns"),
        ({"milliseconds": None}, "100 finite returns"),
        ({"suppressed": "1" * 99 + "2"}, "100 times 0 or 1"),
        ({"suppressed": "1" * 99}, "100 times 0 or 1"),
    ],
)
def test_an_entry_without_all_results_is_refused(entry, tmp_path, damage, said):
    entry["environments"][FORCE] |= damage
    protocol.write_entry(entry, tmp_path / "entry.json")
    with pytest.raises(StoredFileError, match=rf"entry\.json.*{said}"):
        protocol.read_entry(tmp_path / "entry.json")


def test_an_entry_of_another_environment_names_what_changed(path, monkeypatch):
    stored = protocol.read_entry(path)
    now = protocol.fingerprint

    def changed(env_id):
        found = copy.deepcopy(now(env_id))
        found["configuration"]["task"]["w_effort"] = 0.3
        found["configuration"]["parameters"]["mu_s"] = 0.21
        found["golden"][8][0] += 1e-4
        return found

    monkeypatch.setattr(protocol, "fingerprint", changed)
    for check in (
        lambda: protocol.check_environment(stored, HIDDEN),
        lambda: protocol.differences(stored, HIDDEN, feedback(HIDDEN)),
        lambda: protocol.leaderboard([stored]),
        lambda: protocol.resumed(stored, path),
    ):
        with pytest.raises(EntryError) as caught:
            check()
        for said in ("'feedback'", "w_effort: 0.1 -> 0.3", "mu_s: 0.2 -> 0.21", "the dynamics", "0.1.0"):
            assert said in str(caught.value)
    monkeypatch.undo()
    stored["environments"]["SDFriction/Gone-v0"] = stored["environments"][FORCE]
    with pytest.raises(EntryError, match=r"'SDFriction/Gone-v0' that is not known.*BeltSpeed-v0"):
        protocol.check_environment(stored, "SDFriction/Gone-v0")


def test_only_the_same_entry_is_resumed(path, made):
    assert protocol.resumed(protocol.new_entry("feedback", "velocity-feedback"), path) == made
    for changes in ({"name": "other"}, {"policy": "rollout"}, {"knows": "all"}):
        other = protocol.new_entry(**{"name": "feedback", "policy": "velocity-feedback"} | changes)
        (key, value) = next(iter(changes.items()))
        with pytest.raises(EntryError, match=rf"entry\.json' holds another entry: its {key} is .*, not '{value}'"):
            protocol.resumed(other, path)
    for wrong in ("", "two\nlines", "a | b"):
        with pytest.raises(ValueError, match="name must be one line"):
            protocol.new_entry(wrong, "rollout")


class Returns:
    """A policy that returns what it was given, from the 20th decision on."""

    def __init__(self, returned):
        self.returned, self.calls = returned, 0

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.calls += 1
        return self.returned(len(observation)) if self.calls >= 20 else (np.zeros((len(observation), 1)), None)


@pytest.mark.parametrize(
    ("returned", "said"),
    [
        (lambda n: (np.full((n, 1), np.nan), None), r"actions in \[-1, 1\], got nan"),
        (lambda n: (np.full((n, 1), np.inf), None), r"actions in \[-1, 1\], got inf"),
        (lambda n: (np.full((n, 1), -1.5, np.float32), None), r"actions in \[-1, 1\], got -1\.5"),
        (lambda n: (np.zeros(n), None), r"shape \(100, 1\) for 100 observations, got \(100,\)"),
        (lambda n: (np.zeros((n, 2)), None), r"got \(100, 2\)"),
        (lambda n: (np.zeros((n, 1), int), None), "float32 or float64, got int64"),
        (lambda n: (np.zeros((n, 1), complex), None), "got complex128"),
        (lambda n: (np.full((n, 1), None), None), "got object"),
        (lambda n: np.zeros((n, 1)), r"must return \(action, state\), got ndarray"),
        (lambda n: np.zeros((n, 1)) @ np.zeros((n, 1)), r"fails: ValueError: .*\(test_protocol.py, line \d+\)"),
    ],
)
def test_what_is_no_action_is_refused_naming_policy_environment_and_value(returned, said):
    with pytest.raises(EntryError, match=f"policy 'mine' on {BELT} .*{said}"):
        protocol.measure(Returns(returned), "mine", BELT)


def test_every_decision_is_reported():
    count = []
    protocol.measure(ConstantPolicy(0.5), "half", FORCE, lambda: count.append(1))
    assert len(count) == protocol.decisions(FORCE)


# The leaderboard ------------------------------------------------------------------------------------------------------


def changed_entry(made, name, knows, change, suppressed="1"):
    """Return an entry with other returns, of the same environments."""
    other = copy.deepcopy(made) | {"name": name, "knows": knows}
    for result in other["environments"].values():
        result["returns"] = [value + change for value in result["returns"]]
        result["suppressed"] = suppressed * 100
    return other


def test_the_table_has_two_blocks_and_the_best_first(made):
    worse, better = changed_entry(made, "worse", "", -40.0), changed_entry(made, "better", "", 1.0)
    model = changed_entry(made, "model", "the plant", 2.0, suppressed="0")
    rows = protocol.leaderboard([worse, model, made, better])
    assert [(row["block"], row["environment"], row["entry"]) for row in rows] == [
        ("knows the plant", FORCE, "model"),
        ("knows the plant", HIDDEN, "model"),
        *(
            ("does not know the plant", env_id, name)
            for env_id in (FORCE, HIDDEN)
            for name in ("better", "feedback", "worse")
        ),
    ]
    passive = evaluation.metrics(*[evaluation.passive_episodes(FORCE)] * 2)
    summary = evaluation.summarise(
        "x", evaluation.evaluate(feedback(FORCE), FORCE), passive, evaluation.optimal_returns(FORCE, protocol.SEEDS)
    )
    row = rows[3]
    for name in ("score", "score_low", "score_high", "credited"):
        assert row[name] == pytest.approx(summary[name], abs=2e-5)  # returns are stored to 0.1
    assert (rows[0]["credited"], rows[0]["suppressed"], rows[0]["score"] > 0.9) == (0.0, 0.0, True)
    assert row["worst_start"] == min(made["environments"][FORCE]["returns"])
    assert rows[4]["scored_episodes"] == 100
    assert rows[5]["scored_episodes"] == 32
    text = protocol.as_markdown(rows)
    first, second = text.split("### Does not know the plant")
    assert first.startswith(
        "### Knows the plant\n\n| environment | entry | knows | score | credited | suppressed | return |"
    )
    assert first.count("| model | the plant |") == 2
    assert "feedback" not in first
    assert second.count("| feedback | - |") == 2
    assert "(32 starts)" in second
    assert protocol.leaderboard([made], [BELT]) == []
    slow = changed_entry(made, "slow", "", 2.0, suppressed="0")
    assert [row["entry"] for row in protocol.leaderboard([made, slow], [FORCE])] == ["slow", "feedback"]


def test_without_an_optimum_the_share_suppressed_ranks_and_the_score_is_a_dash(made, monkeypatch):
    monkeypatch.setattr(evaluation, "optimal_returns", lambda *_: None)
    good, slow = changed_entry(made, "good", "", -10.0), changed_entry(made, "slow", "", 10.0, suppressed="0")
    rows = protocol.leaderboard([slow, made, good], [FORCE])
    assert [row["entry"] for row in rows] == ["feedback", "good", "slow"]
    assert "| slow | - | - | - | 0% | -" in protocol.as_markdown(rows)


def test_the_protocol_takes_whatever_environments_are_listed(monkeypatch):
    # A tier that is added to ids.py needs no line here: fingerprint and episodes come from the environment.
    assert set(ids.ARGUMENTS) == set(ENVIRONMENT_IDS)
    for env_id in ENVIRONMENT_IDS:
        assert protocol.decisions(env_id) > 500
        assert protocol.measure(ZeroPolicy(), "passive", env_id)["suppressed"].count("1") < 100
