"""Tables show themselves briefly, in a terminal and in a notebook."""

from sd_friction_env import OscillatorParameters, Table, load_pretrained, simulate
from sd_friction_env.control.policies import LinearFeedback, SlidingMode
from sd_friction_env.environments.single import make_env


def test_a_table_prints_its_size_and_columns_in_one_line():
    assert repr(Table({"x": [1.0, 2.0], "kind": ["a", "b"]})) == "Table of 2 rows: x, kind"
    assert repr(Table({})) == "Table of 0 rows: "


def test_a_notebook_shows_the_first_rows_escaped():
    shown = Table({"<x>": [0.1 + 0.2] * 12, "note": ["<script>"] * 12})._repr_html_()
    assert "<script>" not in shown
    assert "&lt;script&gt;" in shown
    assert "<th>&lt;x&gt;</th>" in shown
    assert shown.count("<td>0.3</td>") == 10
    assert shown.endswith("<p>10 of 12 rows</p>")
    assert "rows" not in Table({"x": [1.0]})._repr_html_()


def test_a_history_and_controllers_print_a_summary():
    history = simulate(OscillatorParameters(), t_end=30.0, dt=0.5)
    assert repr(history).startswith("Trajectory(61 samples up to t = 30, ")
    assert repr(history).endswith("status 'ok')")
    policy = repr(load_pretrained("SDFriction/Force-v0"))
    assert policy.startswith("NetworkPolicy(")
    assert policy.endswith("ppo SDFriction/Force-v0)")
    env = make_env("SDFriction/Force-v0")
    assert repr(LinearFeedback.from_env(env, (1.0, 2.0))) == "LinearFeedback(gains=(1.0, 2.0), bias=0.0)"
    for shown in (repr(history), policy, repr(SlidingMode.from_env(env, slope=1.0, layer=0.1))):
        assert len(shown) < 160
