"""The explorer: what it shows is what the package computes, and the page works in a browser."""

import socket

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("bokeh")

from bokeh.document import Document

from scripts import explorer_latency
from sd_friction_env import OscillatorParameters, amplitude_curve, explorer, limit_cycle, load_pretrained
from sd_friction_env.cli import main
from sd_friction_env.explorer import AGENT, FEEDBACK, HAND, OFF, ROBUST, Live, Page, basin_picture, controllers


def test_what_runs_is_the_environment_under_the_agent():
    live = Live("belt")
    live.choose_controller(AGENT)
    env = gym.make("SDFriction/BeltSpeed-v0")
    agent = load_pretrained("SDFriction/BeltSpeed-v0")
    x, v = live.rider.info["x"], live.rider.info["v"]
    observation, _ = env.reset(seed=0, options={"x": x, "v": v})
    rows = live.advance(50)
    for t in range(50):
        observation, _, _, _, info = env.step(agent.predict(observation)[0])
        assert (rows["x"][t], rows["v"][t], rows["v_belt"][t]) == (info["x"], info["v"], info["v_belt"])
    assert rows["t"] == pytest.approx(0.1 * np.arange(1, 51))
    costs = live.costs()
    assert costs["now"] == costs[AGENT]  # the same agent from the same start
    assert costs["without control"] > 0.0


@pytest.mark.parametrize("task", ["force", "belt"])
def test_controllers_are_switched_while_it_runs_and_compared_from_there(task):
    live = Live(task)
    live.advance(100)
    before = (live.rider.info["x"], live.rider.info["v"])
    assert "optimum" in controllers()
    for controller in controllers():
        live.choose_controller(controller)
        assert (live.rider.info["x"], live.rider.info["v"]) == before  # not moved by the switch
        assert live.steps == 0
    assert live.missing == {}
    live.restart()
    for controller, good in (
        (OFF, False),
        (AGENT, True),
        (ROBUST, True),
        ("optimum", True),
        (FEEDBACK, task == "force"),
    ):
        live.restart()
        live.choose_controller(controller)
        live.advance(400)
        rows = live.advance(100)
        passive = limit_cycle(OscillatorParameters()).amplitude
        assert (0.5 * np.ptp(rows["x"]) < 0.05 * passive) == good, controller
        assert (live.share() > 0.9) == good, controller


def test_the_hand_drives_the_mass_and_is_compared_with_the_agent():
    live = Live("force")
    live.choose_controller(HAND)
    live.steer(0.75)
    assert live.advance(3)["action"] == [0.75] * 3
    live.steer(-7.0)
    assert live.advance(3)["action"] == [-1.0] * 3
    live.restart()
    live.advance(300)
    assert live.share() < 0.3  # a push that never changes does not help


def test_a_changed_plant_is_the_plant_that_is_shown():
    live = Live("belt")
    live.advance(20)
    before = live.rider.info["x"]
    live.change(alpha=0.7, belt_speed=0.3)
    plant = OscillatorParameters(alpha=0.7, belt_speed=0.3)
    assert live.rider.env.parameters == plant
    assert live.rider.info["x"] == before
    cycle = live.cycle()
    assert cycle is not None
    assert cycle.amplitude == limit_cycle(plant).amplitude
    curve = live.curve()
    assert np.array_equal(curve["amplitude"], amplitude_curve(plant, curve["belt_speed"])["amplitude"])
    live.choose_controller(OFF)
    live.restart()
    live.advance(600)
    rows = live.advance(200)
    assert 0.5 * np.ptp(rows["x"]) == pytest.approx(cycle.amplitude, rel=0.01)
    with pytest.raises(ValueError, match="mu_m"):
        live.change(mu_m=0.9)
    assert live.parameters == plant


def test_basins_tell_where_starts_end():
    image, words = basin_picture(OscillatorParameters(alpha=0.2))
    assert image.shape == (80, 120)
    found = np.unique(image[np.isfinite(image)])
    assert found.tolist() == list(range(len(found)))
    assert words.count("of the starts") == len(found)


def test_a_mass_that_loses_contact_is_put_back():
    live = Live("force", OscillatorParameters(geometry="cubic", alpha=0.9))
    live.rider.start({"parameters": {"geometry": "cubic", "alpha": 0.9}, "x": 9.0, "v": 0.0})
    rows = live.advance(50)
    assert rows["t"] == []  # what came before is of the past
    assert abs(live.rider.info["x"]) < 3.0
    live.rider.info |= {"x": 11.0}  # on its way out: a changed plant must not start there
    live.change(beta=0.06)
    assert live.parameters.beta == live.rider.env.parameters.beta == 0.06


def test_an_agent_that_is_not_there_is_told(monkeypatch):
    def none(env_id):
        raise ValueError("none here")

    monkeypatch.setattr(explorer, "load_pretrained", none)
    live = Live("force")
    live.choose_controller(AGENT)
    assert live.missing[AGENT] == "trained agent is not there: none here"
    assert live.advance(5)["action"] == [0.0] * 5


def test_the_page_follows_its_widgets():
    document = Document()
    page = Page(document)
    page.tick()
    before = page.curve.data["amplitude"].copy()
    page.sliders["alpha"].value = 0.6
    assert not np.array_equal(before, page.curve.data["amplitude"])
    assert page.live.parameters.alpha == 0.6
    page.sliders["mu_m"].value = 0.3  # above mu_s: refused in words, and all goes on
    assert "mu_m" in page.message.text
    page.tick()
    page.sliders["mu_s"].value = 0.4  # now it fits
    assert page.message.text == ""
    assert (page.live.parameters.mu_m, page.live.parameters.mu_s) == (0.3, 0.4)
    page.sliders["mu_m"].value, page.sliders["mu_s"].value = 0.05, 0.2
    page.geometry.value = "cubic"
    assert page.live.parameters.geometry == "cubic"
    page._nominal()
    assert page.live.parameters == OscillatorParameters()
    assert page.sliders["alpha"].value == 0.8
    page.document.add_next_tick_callback = lambda callback: callback()
    page._show_basins()
    page.pool.shutdown()
    assert "of the starts" in page.message.text
    page._take_over(1.0)
    assert page.controller.value == HAND
    page.tick()
    assert page.path.data["action"][-1] == 1.0
    page.task.active = 0
    assert page.live.task == "force"
    assert len(page.path.data["t"]) > 0


def test_the_page_goes_on_when_an_episode_ends(monkeypatch):
    monkeypatch.setattr(explorer, "_LONGEST", 8)
    page = Page(Document())
    for _ in range(12):
        page.tick()
        assert (np.diff(page.path.data["t"]) > 0.0).all()
        assert len(page.path.data["t"]) <= 8
    assert np.isfinite(page.point.data["amplitude"]).all()


def test_a_page_without_a_cycle_shows_no_nan():
    page = Page(Document())
    page.sliders["belt_speed"].value = 0.6
    for _ in range(60):
        page.tick()
    assert "nan" not in page.readout.text


def test_another_friction_law_and_excitation_are_shown_and_the_curve_is_of_the_plant_without():
    page = Page(Document())
    before = page.curve.data["amplitude"].copy()
    page.friction.value = "hyperbolic"
    assert "compiled" in page.message.text  # and on the next tick of the server it is done
    assert np.array_equal(before, page.curve.data["amplitude"])
    for callback in page.document.session_callbacks:
        if not hasattr(callback, "period"):
            callback.callback()
    assert page.live.rider.env.parameters.friction == "hyperbolic"
    plant = OscillatorParameters(friction="hyperbolic")
    assert np.array_equal(
        page.curve.data["amplitude"], amplitude_curve(plant, page.curve.data["belt_speed"])["amplitude"], equal_nan=True
    )
    page.sliders["force_amplitude"].value = 0.2
    page.sliders["ripple_amplitude"].value = 0.05
    assert page.live.rider.env.parameters.excited
    cycle = page.live.cycle()
    assert cycle is not None
    assert cycle.amplitude == limit_cycle(plant).amplitude
    belts = page.live.advance(40)["v_belt"]
    assert np.ptp(belts) > 0.05
    page.tick()
    assert "Without excitation" in basin_picture(page.live.parameters)[1]


def test_a_plugin_that_fails_is_told_and_forgotten(monkeypatch):
    class Failing:
        names = ("broken",)

        def __getitem__(self, name):
            return self

        def load(self):
            raise KeyError("anything")

    monkeypatch.setattr(explorer, "plugins", Failing)
    live = Live("force")
    live.choose_controller("broken")
    assert "anything" in live.missing["broken"]
    assert live.advance(2)["action"] == [0.0, 0.0]
    live.choose_controller(AGENT)
    assert AGENT not in live.missing


def test_the_amplitude_is_of_whole_cycles():
    page = Page(Document())
    passive = limit_cycle(OscillatorParameters()).amplitude
    shown = []
    for _ in range(60):
        page.tick()
        shown += list(page.point.data["amplitude"])
    assert len(shown) > 20
    assert shown == pytest.approx([passive] * len(shown), rel=0.01)
    page._restarted()
    page.tick()
    assert len(page.point.data["amplitude"]) == 0  # a few points are no cycle, however close together


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--host ::1", "--host must be a name or an IPv4 address, got '::1'"),
        ("--port 70000", "--port must be in [0, 65535], got 70000"),
        ("--host no.such.host.invalid", "cannot listen"),
    ],
)
def test_the_command_refuses_what_cannot_be(arguments, message, capsys):
    assert main(["explore", "--no-browser", *arguments.split()]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_taken_port_is_told(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["explore", "--no-browser", "--port", str(port)]) == 2
    assert f"--port {port}" in capsys.readouterr().err


@pytest.fixture(scope="module")
def page():
    pytest.importorskip("playwright")
    if explorer_latency.browser() is None:
        pytest.skip("no Chromium is installed")
    with explorer_latency.explorer_page() as (page, errors):
        yield page
        assert errors == []


def data(page, source):
    return page.evaluate(
        "name => Object.fromEntries(Object.entries(Bokeh.documents[0].get_model_by_name(name).data)"
        ".map(([key, values]) => [key, Array.from(values)]))",
        source,
    )


def test_in_a_browser_a_slider_moves_the_curve(page):
    before = data(page, "curve")["amplitude"]
    handle = page.locator(".noUi-handle").nth(2)  # the hand, the belt's speed, alpha
    handle.focus()
    for _ in range(5):
        handle.press("ArrowLeft")
    page.wait_for_function("Bokeh.documents[0].get_model_by_name('alpha').value < 0.78")
    page.wait_for_function(
        "before => Array.from(Bokeh.documents[0].get_model_by_name('curve').data.amplitude)"
        ".some((value, i) => value !== before[i])",
        arg=before,
    )
    for name in ("belt_speed", "mu_m"):
        assert explorer_latency.move(page, name, 0.15) > 0.0
    page.get_by_role("button", name="nominal plant").click()
    page.wait_for_function("Bokeh.documents[0].get_model_by_name('alpha').value === 0.8")


def test_in_a_browser_the_agent_suppresses_and_a_picture_is_made(page, tmp_path):
    page.get_by_text("squeal again").click()
    page.wait_for_function("Bokeh.documents[0].get_model_by_name('point').data.amplitude[0] > 0.35", timeout=60_000)
    page.locator("select").first.select_option(AGENT)
    page.wait_for_function("Bokeh.documents[0].get_model_by_name('point').data.amplitude[0] < 0.02", timeout=60_000)
    picture = tmp_path / "explorer.png"
    page.screenshot(path=str(picture))
    assert picture.stat().st_size > 40_000
    readout = page.evaluate("Bokeh.documents[0].get_model_by_name('readout').text")
    assert "passive 0.393" in readout


def test_in_a_browser_one_takes_over_by_hand(page):
    page.get_by_text("+1 ▶").click()
    page.wait_for_function("Bokeh.documents[0].get_model_by_name('controller').value === 'by hand'")
    page.wait_for_function("Array.from(Bokeh.documents[0].get_model_by_name('path').data.action).at(-1) === 1")
    page.get_by_text("push the mass (force)").click()
    page.wait_for_function("Array.from(Bokeh.documents[0].get_model_by_name('path').data.v_belt).at(-1) === 0.2")
    page.get_by_text("basins", exact=True).click()
    page.wait_for_function("Bokeh.documents[0].get_model_by_name('message').text.includes('of the starts')")
