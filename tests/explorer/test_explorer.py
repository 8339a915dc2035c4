"""The explorer: what it shows is what the package computes, and the page works in a browser."""

import asyncio
import json
import socket
from concurrent import futures

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("bokeh")

import tornado.httpclient
import tornado.websocket
from bokeh.document import Document
from bokeh.events import ButtonClick

from scripts import explorer_latency
from sd_friction_env import OscillatorParameters, amplitude_curve, limit_cycle, load_pretrained, stability_chart
from sd_friction_env.cli.main import main
from sd_friction_env.environments.task import passive_motion
from sd_friction_env.explorer import model
from sd_friction_env.explorer import page as page_module
from sd_friction_env.explorer.model import (
    AGENT,
    FEEDBACK,
    FOLLOWER,
    HAND,
    OFF,
    ROBUST,
    Latest,
    Live,
    PlantPicture,
    basin_picture,
    chart_picture,
    controllers,
    passive_curve,
)
from sd_friction_env.explorer.page import Page
from sd_friction_env.explorer.server import make_server, served_hosts


def follow(page):
    """Let a page do all that its widgets ask for."""
    page.tick()
    for work in (page.plant_work, page.basin_work, page.chart_work):
        while work.running is not None:
            futures.wait([work.running])
            page.tick()


class ByHand(futures.Executor):
    """An executor that queues its jobs until the test runs them."""

    def __init__(self):
        self.submitted = []

    def submit(self, work):
        self.submitted.append((work, futures.Future()))
        return self.submitted[-1][1]

    def finish(self):
        work, future = self.submitted[-1]
        future.set_result(work())

    def shutdown(self, **arguments):
        self.is_shut = True


def test_what_runs_is_the_environment_under_the_agent():
    live = Live("belt")
    live.choose_controller(AGENT)
    env = gym.make("SDFriction/BeltSpeed-v0")
    agent = load_pretrained("SDFriction/BeltSpeed-v0")
    x, v = live.loop.info["x"], live.loop.info["v"]
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
    before = (live.loop.info["x"], live.loop.info["v"])
    assert "optimum" in controllers()
    for controller in controllers():
        live.choose_controller(controller)
        assert (live.loop.info["x"], live.loop.info["v"]) == before  # not moved by the switch
        assert live.steps == 0
    assert set(live.missing) == ({FOLLOWER} if task == "force" else set())
    live.restart()
    for controller, good in (
        (OFF, False),
        (AGENT, True),
        (ROBUST, True),
        ("optimum", True),
        (FEEDBACK, task == "force"),
        (FOLLOWER, task == "belt"),
    ):
        live.restart()
        live.choose_controller(controller)
        live.advance(400)
        rows = live.advance(100)
        passive = limit_cycle(OscillatorParameters()).amplitude
        assert (0.5 * np.ptp(rows["x"]) < 0.05 * passive) == good, controller
        assert (live.score() > 0.9) == good, controller


def test_the_hand_drives_the_mass_and_is_compared_with_the_agent():
    live = Live("force")
    live.choose_controller(HAND)
    live.steer(0.75)
    assert live.advance(3)["action"] == [0.75] * 3
    live.steer(-7.0)
    assert live.advance(3)["action"] == [-1.0] * 3
    live.restart()
    live.advance(300)
    assert live.score() < 0.3  # a push that never changes does not help


def test_a_changed_plant_is_the_plant_that_is_shown():
    live = Live("belt")
    live.advance(20)
    before = live.loop.info["x"]
    live.change(alpha=0.7, belt_speed=0.3)
    plant = OscillatorParameters(alpha=0.7, belt_speed=0.3)
    assert live.loop.env.parameters == plant
    assert live.loop.info["x"] == before
    cycle = passive_motion(live.parameters)
    assert cycle is not None
    assert cycle.amplitude == limit_cycle(plant).amplitude
    curve = passive_curve(live.parameters)
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
    live.loop.start({"parameters": {"geometry": "cubic", "alpha": 0.9}, "x": 9.0, "v": 0.0})
    rows = live.advance(50)
    assert rows["t"] == []  # what came before is of the past
    assert abs(live.loop.info["x"]) < 3.0
    live.loop.info |= {"x": 11.0}  # on its way out: a changed plant must not start there
    live.change(beta=0.06)
    assert live.parameters.beta == live.loop.env.parameters.beta == 0.06


def test_an_agent_that_is_not_there_is_told(monkeypatch):
    def none(env_id):
        raise ValueError("none here")

    monkeypatch.setattr(model, "load_pretrained", none)
    live = Live("force")
    live.choose_controller(AGENT)
    assert live.missing[AGENT] == "trained agent is not available: none here"
    assert live.advance(5)["action"] == [0.0] * 5


def click(page, name):
    (button,) = (model for model in page.document.models if model.name == name)
    button._trigger_event(ButtonClick(button))


def test_the_page_follows_its_widgets():
    document = Document()
    page = Page(document)
    page.tick()
    before = page.drawing.curve.data["amplitude"].copy()
    page.controls.plant["alpha"].value = 0.6
    follow(page)
    assert not np.array_equal(before, page.drawing.curve.data["amplitude"])
    assert page.live.parameters.alpha == 0.6
    page.controls.plant["mu_m"].value = 0.3  # above mu_s: refused in words, and all goes on
    follow(page)
    assert "mu_m" in page.controls.message.text
    assert page.live.parameters.mu_m == 0.05
    page.controls.plant["mu_s"].value = 0.4  # now it fits
    follow(page)
    assert page.controls.message.text == ""
    assert (page.live.parameters.mu_m, page.live.parameters.mu_s) == (0.3, 0.4)
    page.controls.plant["mu_m"].value, page.controls.plant["mu_s"].value = 0.05, 0.2
    page.controls.plant["geometry"].value = "cubic"
    follow(page)
    assert page.live.parameters.geometry == "cubic"
    click(page, "nominal")
    follow(page)
    assert page.live.parameters == OscillatorParameters()
    assert page.controls.plant["alpha"].value == 0.8
    click(page, "basins button")
    follow(page)
    assert "of the starts" in page.controls.message.text
    click(page, "hand 1")
    page.tick()
    assert page.controls.controller.value == HAND
    page.tick()
    assert page.drawing.path.data["action"][-1] == 1.0
    page.controls.hand.value = -0.5
    page.tick()
    assert page.drawing.path.data["action"][-1] == -0.5
    page.controls.controller.value = OFF
    page.tick()
    assert page.drawing.path.data["action"][-1] == 0.0
    page.controls.hand.value = 0.25  # who moves the hand takes over
    page.tick()
    assert (page.controls.controller.value, page.drawing.path.data["action"][-1]) == (HAND, 0.25)
    page.controls.task.active = 0
    page.tick()
    assert page.live.task == "force"
    assert len(page.drawing.path.data["t"]) > 0


def test_the_page_goes_on_when_an_episode_ends(monkeypatch):
    monkeypatch.setattr(model, "_LONGEST", 8)
    page = Page(Document())
    for _ in range(12):
        page.tick()
        assert (np.diff(page.drawing.path.data["t"]) > 0.0).all()
        assert len(page.drawing.path.data["t"]) <= 8
    assert np.isfinite(page.drawing.point.data["amplitude"]).all()


def test_a_page_without_a_cycle_shows_no_nan():
    page = Page(Document())
    page.controls.plant["belt_speed"].value = 0.6
    follow(page)
    for _ in range(60):
        page.tick()
    assert "nan" not in page.drawing.readout.text


def test_another_friction_law_and_excitation_are_shown_and_the_curve_is_of_the_plant_without(monkeypatch):
    page = Page(Document())
    before = page.drawing.curve.data["amplitude"].copy()
    page.plant_work.executor = ByHand()
    monkeypatch.setattr(page_module, "_ANNOUNCED", 0.0)
    monkeypatch.setattr(page_module, "is_loaded", lambda plant: plant.friction == "stribeck")
    page.controls.plant["friction"].value = "hyperbolic"
    for _ in range(20):
        page.tick()  # all goes on meanwhile
    assert page.live.loop.env.parameters.friction == "stribeck"
    assert "Compiling (exact spring, hyperbolic friction): about" in page.controls.message.text
    assert len(page.plant_work.executor.submitted) == 1
    assert np.array_equal(before, page.drawing.curve.data["amplitude"])
    page.plant_work.executor.finish()
    page.tick()
    assert page.controls.message.text == ""
    assert page.live.loop.env.parameters.friction == "hyperbolic"
    plant = OscillatorParameters(friction="hyperbolic")
    curve = page.drawing.curve.data
    amplitudes = amplitude_curve(plant, curve["belt_speed"])["amplitude"]
    assert np.array_equal(curve["amplitude"], amplitudes, equal_nan=True)
    page.controls.plant["force_amplitude"].value = 0.2
    page.controls.plant["ripple_amplitude"].value = 0.05
    page.plant_work.executor = futures.ThreadPoolExecutor(1)
    follow(page)
    assert page.live.loop.env.parameters.excited
    cycle = passive_motion(page.live.parameters)
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

    monkeypatch.setattr(model, "plugins", Failing)
    live = Live("force")
    live.choose_controller("broken")
    assert "anything" in live.missing["broken"]
    assert live.advance(2)["action"] == [0.0, 0.0]
    live.choose_controller(AGENT)
    assert AGENT not in live.missing


def test_the_state_is_named_by_word_shape_and_colour():
    live = Live("belt")
    passive = limit_cycle(OscillatorParameters()).amplitude
    seen = []
    for controller, intervals in ((OFF, 150), (AGENT, 600)):
        live.choose_controller(controller)
        for _ in range(intervals):
            live.advance(1)
            seen.append(live.regime(passive))
    assert [sign for i, sign in enumerate(seen) if sign not in seen[:i]][:2] == [model.MEASURED, model.STICK_SLIP]
    assert seen[-1] == model.AT_REST
    assert live.mode == model.SLIPS  # which is no alarm
    live.loop.info["stick_fraction"] = 1.0
    assert live.mode == model.STICKS
    signs = (model.STICK_SLIP, model.REDUCED, model.AT_REST)
    assert all(len({getattr(sign, part) for sign in signs}) == 3 for part in ("words", "symbol", "marker", "color"))


def test_only_sliders_that_the_chosen_laws_use_are_shown():
    page = Page(Document())

    def shown():
        return {name for name, widget in page.controls.plant.items() if widget.visible}

    assert {"alpha", "mu_m", "g1", "ripple_frequency"} <= shown()
    assert not {"kappa", "mu_k", "delta"} & shown()
    page.controls.plant["geometry"].value = "duffing"
    page.controls.plant["friction"].value = "coulomb"
    page.tick()
    assert {"kappa", "linear_stiffness", "mu_k", "mu_s"} <= shown()
    assert not {"alpha", "mu_m", "v_m"} & shown()
    titles = [widget.title for widget in page.controls.plant.values()]
    assert len(set(titles)) == len(titles)


def test_new_laws_are_compiled_by_another_process_once(monkeypatch):
    commands = []
    monkeypatch.setattr(model.subprocess, "run", lambda command, **options: commands.append(command))
    monkeypatch.setattr(model, "_loaded", set())
    for alpha in (0.5, 0.6):
        PlantPicture.after_compilation(OscillatorParameters(alpha=alpha))
    assert [command[1:3] for command in commands] == [["-m", "sd_friction_env.explorer.model"]]
    assert OscillatorParameters(**json.loads(commands[0][3])) == OscillatorParameters(alpha=0.5)


def test_the_amplitude_is_of_whole_cycles():
    page = Page(Document())
    passive = limit_cycle(OscillatorParameters()).amplitude
    shown = []
    for _ in range(60):
        page.tick()
        shown += list(page.drawing.point.data["amplitude"])
    assert len(shown) > 20
    assert shown == pytest.approx([passive] * len(shown), rel=0.01)
    click(page, "restart")
    for _ in range(4):
        page.tick()
    assert len(page.drawing.point.data["amplitude"]) == 0  # a few points are no cycle, however close together


# Of many requests the latest counts -----------------------------------------------------------------------------------


def test_of_many_moves_of_a_slider_the_last_one_counts():
    page = Page(Document())
    by_hand = page.plant_work.executor = ByHand()
    for value in np.linspace(0.3, 0.7, 400):
        page.controls.plant["alpha"].value = value
    page.tick()
    assert len(by_hand.submitted) == 1
    for value in np.linspace(0.7, 0.5, 400):  # while that is computed
        page.controls.plant["alpha"].value = value
        page.tick()
    assert len(by_hand.submitted) == 1
    by_hand.finish()
    page.tick()
    assert page.live.parameters.alpha == 0.7
    by_hand.finish()
    page.tick()
    assert page.live.parameters.alpha == 0.5
    page.tick()
    assert len(by_hand.submitted) == 2
    assert page.plant_work.running is None


def test_many_clicks_are_one_piece_of_work_and_a_changed_plant_forgets_it():
    page = Page(Document())
    by_hand = page.basin_work.executor = ByHand()
    for _ in range(100):
        click(page, "basins button")
        page.tick()
    assert len(by_hand.submitted) == 1
    page.controls.plant["alpha"].value = 0.2
    follow_plant = page.plant_work
    page.tick()
    futures.wait([follow_plant.running])
    by_hand.finish()
    page.tick()
    assert page.live.parameters.alpha == 0.2
    assert len(page.drawing.basins.data["image"]) == 0  # they were of another plant
    assert len(by_hand.submitted) == 2  # the last click's, of the plant as it was
    by_hand.finish()
    page.tick()
    assert len(page.drawing.basins.data["image"]) == 0
    click(page, "basins button")
    page.tick()
    by_hand.finish()
    page.tick()
    image, words = basin_picture(OscillatorParameters(alpha=0.2))
    assert np.array_equal(page.drawing.basins.data["image"][0], image, equal_nan=True)
    assert page.controls.message.text == words


def test_the_chart_is_computed_on_demand_and_marks_the_plant_while_it_lies_in_it():
    page = Page(Document())
    by_hand = page.chart_work.executor = ByHand()
    assert page.controls.over.options == ["alpha", "g1", "beta", "mu_s", "mu_m", "v_m"]
    page.controls.over.value = "beta"
    click(page, "chart button")
    page.tick()
    assert "Computing where it squeals" in page.controls.message.text
    page.tick()  # the animation goes on meanwhile
    assert len(page.drawing.path.data["t"]) > 0
    by_hand.finish()
    page.tick()
    chart = stability_chart(OscillatorParameters(), ("beta", 0.0, 0.15), points=30)
    borders = page.drawing.borders.data
    assert borders["curve"] == ["v_b0", "v_b1"]
    assert np.array_equal(borders["y"][0], chart["belt_speed"][(chart["curve"] == "v_b0") & (chart["branch"] == 0)])
    assert set(page.drawing.regions.data["kind"]) == {"stick-slip", "pure slip", "steady slip"}
    assert (page.drawing.own.data["x"], page.drawing.own.data["y"]) == ([0.05], [0.2])
    page.controls.plant["beta"].value, page.controls.plant["belt_speed"].value = 0.1, 0.3
    follow(page)
    assert (page.drawing.own.data["x"], page.drawing.own.data["y"]) == ([0.1], [0.3])
    page.controls.plant["mu_s"].value = 0.3  # now it is another chart
    follow(page)
    assert page.drawing.own.data["x"] == page.drawing.borders.data["x"] == []


def test_a_chart_without_curves_says_why():
    picture = chart_picture(OscillatorParameters(friction="coulomb", geometry="linear", beta=0.0), ("g1", 0.5, 1.0))
    assert "persists up to the greatest belt speed" in picture.words
    assert picture.borders["x"] == []


def test_clicks_and_switches_between_two_frames_are_done_once(monkeypatch):
    page = Page(Document())
    done = []
    for name in ("choose_task", "choose_controller", "restart"):
        real = getattr(page.live, name)
        monkeypatch.setattr(page.live, name, lambda *a, real=real, name=name, **k: (done.append(name), real(*a, **k)))
    for i in range(101):
        page.controls.controller.value = (FEEDBACK, AGENT)[i % 2]
        page.controls.task.active = (1, 0)[i % 2]
        click(page, "restart")
    page.tick()
    assert done.count("choose_controller") == 1
    assert done.count("choose_task") == 0  # it is again what it was
    assert done.count("restart") == 2  # one by the controller, which goes on from where the mass is
    assert page.live.controller == FEEDBACK


def test_a_page_whose_browser_has_gone_stops_its_work():
    page = Page(Document())
    by_hand = page.plant_work.executor = page.basin_work.executor = ByHand()
    page.controls.plant["alpha"].value = 0.5
    click(page, "basins button")
    page.tick()
    page.controls.plant["alpha"].value = 0.6
    page.tick()
    assert len(by_hand.submitted) == 2
    for callback in page.document.session_destroyed_callbacks:
        callback(None)
    assert by_hand.is_shut
    steps, curve = page.live.steps, page.drawing.curve.data
    by_hand.finish()
    page.tick()
    assert len(by_hand.submitted) == 2
    assert page.live.steps == steps
    assert page.drawing.curve.data is curve


def test_a_page_that_nobody_touches_ends(monkeypatch):
    monkeypatch.setattr(page_module, "_IDLE_TICKS", 10)
    ended = []
    page = Page(Document(), on_idle=lambda: ended.append(True))
    for i in range(30):
        page.tick()
        if i % 5 == 4:
            click(page, "restart")
    assert not page.ended
    page.controls.plant["alpha"].value = 0.5
    while not page.ended:
        page.tick()
    assert page.ticks < 60
    assert ended == []  # the message first
    page.tick()
    assert ended == [True]
    assert "reload" in page.controls.message.text


def test_a_widget_set_to_nonsense_is_refused_in_words_and_all_goes_on():
    page = Page(Document())
    for change in (
        lambda: setattr(page.controls.hand, "value", float("nan")),
        lambda: setattr(page.controls.plant["friction"], "value", "<script>"),
        lambda: setattr(page.controls.plant["alpha"], "value", -7.0),
        lambda: setattr(page.controls.task, "active", None),
        lambda: setattr(page.controls.controller, "value", "nobody"),
    ):
        change()
        steps = page.live.steps
        follow(page)
        assert "<script>" not in page.controls.message.text
        follow(page)
        assert np.isfinite(page.live.loop.info["x"])
    assert page.live.parameters == OscillatorParameters()
    assert page.live.steps > steps


def test_latest_runs_one_and_keeps_one():
    shown = []
    work = Latest(lambda future: shown.append(future.result()), lambda: None, ByHand())
    for i in range(5):
        work.ask(lambda i=i: i)
        work.poll()
    assert len(work.executor.submitted) == 1
    work.executor.finish()
    work.poll()
    work.executor.finish()
    work.poll()
    assert shown == [0, 4]


# Who may ask ----------------------------------------------------------------------------------------------------------


async def request(port, *headers, path="/static/js/bokeh.min.js", version="1.1"):
    """Return status and body of an answer to exactly these headers."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write("\r\n".join([f"GET {path} HTTP/{version}", *headers, "Connection: close", "", ""]).encode())
    head, _, body = (await reader.read()).decode(errors="replace").partition("\r\n\r\n")
    writer.close()
    return int(head.split()[1]), body


def token_in(page):
    return page.split('"token":"')[1].split('"')[0]


async def closed(connection):
    connection.close()
    while await connection.read_message() is not None:
        pass


async def connect(port, token, host=None, **headers):
    """Open the websocket of a page as its browser does."""
    wanted = tornado.httpclient.HTTPRequest(
        f"ws://127.0.0.1:{port}/ws", headers={"Host": host or f"localhost:{port}", **headers}
    )
    return await tornado.websocket.websocket_connect(wanted, subprotocols=["bokeh", token])


def serving(test, allowed=(), sessions=8):
    """Run a coroutine function with the server, its port and its application."""

    async def run():
        server, address = make_server("127.0.0.1", 0, allowed, sessions)
        server.start()
        try:
            await asyncio.wait_for(test(server, int(address.split(":")[2].strip("/"))), 120)
        finally:
            server.stop()
            await server._http.close_all_connections()

    asyncio.run(run())


def test_only_hosts_it_was_started_for_are_answered():
    async def test(server, port):
        for path in (
            "/",
            "/static/js/bokeh.min.js",
            "/autoload.js?bokeh-autoload-element=1",
            "/metadata",
            "/ws",
            "/no",
        ):
            for host in (f"evil.com:{port}", "evil.com", f"127.0.0.1.evil.com:{port}", f"localhost:{port + 1}"):
                status, body = await request(port, f"Host: {host}", path=path)
                assert (status, "Refused" in body, "evil" in body) == (403, True, False), (path, host)
        for host in (f"localhost:{port}", f"LocalHost:{port}", f"127.0.0.1:{port}", f"[::1]:{port}"):
            assert (await request(port, f"Host: {host}"))[0] == 200, host
        for host in ("proxy.example", "PROXY.example:443", f"lan-name:{port}"):
            assert (await request(port, f"Host: {host}"))[0] == 200, host
        for host in (
            f"localhost.:{port}",
            "localhost",
            f"[::2]:{port}",
            f"127.1:{port}",
            f"0.0.0.0:{port}",
            "lan-name",
        ):
            assert (await request(port, f"Host: {host}"))[0] == 403, host
        good = f"Host: localhost:{port}"
        for headers in (
            (f"X-Forwarded-Host: localhost:{port}", "Host: evil.com"),
            (good, f"Origin: http://evil.com:{port}"),
            (good, "Origin: null"),
            (good, f"Origin: file://localhost:{port}"),
            (good, f"Sec-WebSocket-Origin: http://evil.com:{port}"),
        ):
            assert (await request(port, *headers))[0] == 403, headers
        assert (await request(port, good, f"Origin: http://127.0.0.1:{port}"))[0] == 200
        assert (await request(port, good, "Origin: https://proxy.example"))[0] == 200
        for version, status in (("1.0", 403), ("1.1", 400)):  # no Host at all
            assert (await request(port, "Accept: */*", version=version))[0] == status
        assert (await request(port, good, "Host: evil.com"))[0] == 400
        assert server.get_sessions("/") == []

    serving(test, allowed=["proxy.example:443", "lan-name"])


def test_a_websocket_opens_for_its_own_page_alone():
    async def test(server, port):
        status, body = await request(port, f"Host: localhost:{port}", path="/")
        assert status == 200
        token = token_in(body)
        for headers in (
            {"host": f"evil.com:{port}"},
            {"Origin": f"http://evil.com:{port}"},
            {"host": f"evil.com:{port}", "Origin": f"http://evil.com:{port}"},
        ):
            with pytest.raises(tornado.httpclient.HTTPClientError, match="403"):
                await connect(port, token, **headers)
        opened = await connect(port, token, Origin=f"http://localhost:{port}")
        assert "ACK" in await opened.read_message()
        await closed(opened)

    serving(test)


def test_pages_are_limited_in_number_and_make_room_when_they_are_left():
    async def test(server, port):
        good = f"Host: localhost:{port}"
        answers = await asyncio.gather(*(request(port, good, path="/") for _ in range(6)))
        assert sorted(status for status, _ in answers) == [200, 200, 503, 503, 503, 503]
        assert all(
            "the 2 pages that this explorer serves at a time are open" in body for s, body in answers if s == 503
        )
        assert len(server.get_sessions("/")) == 2
        stranger = await connect(port, bokeh_token())  # with a token of its own
        assert await stranger.read_message() is None  # closed again
        stranger.close()
        assert len(server.get_sessions("/")) == 2
        token = next(token_in(body) for status, body in answers if status == 200)
        opened = await connect(port, token)  # a page that is there goes on
        assert "ACK" in await opened.read_message()
        pages = list(server._tornado._pages)
        for session in server.get_sessions("/"):
            session._last_unsubscribe_time -= 60_000  # nobody has been connected for so long
        assert (await request(port, good, path="/"))[0] == 200
        assert sum(page.ended for page in pages) == 1  # the other one has its browser
        assert len(server.get_sessions("/")) == 2
        await closed(opened)

    serving(test, sessions=2)


def bokeh_token():
    from bokeh.util.token import generate_jwt_token, generate_session_id

    return generate_jwt_token(generate_session_id())


def test_a_page_that_nobody_touches_is_hung_up(monkeypatch):
    async def test(server, port):
        _, body = await request(port, f"Host: localhost:{port}", path="/")
        opened = await connect(port, token_in(body))
        (page,) = server._tornado._pages
        page.idle_ticks = page_module._IDLE_TICKS
        while await opened.read_message() is not None:
            pass
        assert page.ended
        assert "Ended" in page.controls.message.text
        assert opened.close_reason == "idle"
        opened.close()
        while any(session.connection_count for session in server.get_sessions("/")):
            await asyncio.sleep(0.01)

    serving(test)


def test_400_slider_events_over_the_socket_are_two_pieces_of_work_at_most():
    async def test(server, port):
        _, body = await request(port, f"Host: localhost:{port}", path="/")
        opened = await connect(port, token_in(body))
        assert "ACK" in await opened.read_message()
        (page,) = server._tornado._pages
        by_hand = page.plant_work.executor = ByHand()
        slider = page.controls.plant["alpha"]
        values = np.linspace(0.3, 0.7, 400).tolist()
        for i, value in enumerate(values):
            change = {"kind": "ModelChanged", "model": {"id": slider.id}, "attr": "value", "new": value}
            for part in (f'{{"msgid":"{i}","msgtype":"PATCH-DOC"}}', "{}", json.dumps({"events": [change]})):
                await opened.write_message(part)
        while slider.value != values[-1] or page.plant_work.running is None:
            await asyncio.sleep(0.01)
        while page.live.parameters.alpha != values[-1]:
            if not by_hand.submitted[-1][1].done():
                by_hand.finish()
            await asyncio.sleep(0.01)
        assert len(by_hand.submitted) <= 2
        await closed(opened)

    serving(test)


def test_what_is_served_follows_from_what_it_was_started_for():
    assert served_hosts("127.0.0.1", 5006) == {"localhost:5006", "127.0.0.1:5006", "[::1]:5006"}
    assert "localhost" in served_hosts("127.0.0.1", 80)
    assert "192.168.1.7:5006" in served_hosts("192.168.1.7", 5006)
    everywhere = served_hosts("0.0.0.0", 5006, ["Name.example"])
    assert {f"{socket.gethostname().lower()}:5006", "name.example:5006"} <= everywhere
    assert "0.0.0.0:5006" not in everywhere
    for wrong in ("*", "*.example", "http://a.example", "a.example/", "", "a b", "a:b", "a:1:2"):
        with pytest.raises(ValueError, match=r"a host must be a name or an address"):
            served_hosts("127.0.0.1", 5006, [wrong])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--allow-host *", "a host must be a name or an address, with or without a port, got '*'"),
        ("--sessions 0", "--sessions must be in [1, 1000], got 0"),
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


@pytest.mark.slow
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
    page.get_by_role("button", name="reset to nominal").click()
    page.wait_for_function("Bokeh.documents[0].get_model_by_name('alpha').value === 0.8")


@pytest.mark.slow
def test_in_a_browser_the_agent_suppresses_and_a_picture_is_made(page, tmp_path):
    page.get_by_text("squeal again").click()
    page.wait_for_function("Bokeh.documents[0].get_model_by_name('point').data.amplitude[0] > 0.35", timeout=60_000)
    page.locator("select").first.select_option(AGENT)
    page.wait_for_function("Bokeh.documents[0].get_model_by_name('point').data.amplitude[0] < 0.02", timeout=60_000)
    picture = tmp_path / "explorer.png"
    page.screenshot(path=str(picture))
    assert picture.stat().st_size > 40_000
    readout = page.evaluate("Bokeh.documents[0].get_model_by_name('readout').text")
    assert "without control 0.393" in readout
    assert "● At rest on the sliding belt" in readout


@pytest.mark.parametrize("width", [800, 1330, 1920])
@pytest.mark.slow
def test_in_a_browser_all_controls_fit_on_the_screen(page, width):
    page.set_viewport_size({"width": width, "height": 900})
    for tab in ("friction", "excitation", "oscillator"):
        page.locator(".bk-tab", has_text=tab).click()
        for element in (*page.locator("button:visible").all(), *page.locator(".noUi-base:visible").all()):
            box = element.bounding_box()
            assert 0 <= box["x"] <= box["x"] + box["width"] <= width
            assert 0 <= box["y"] <= box["y"] + box["height"] <= 900
    scrolled = page.evaluate("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
    assert scrolled == [width, 900]


@pytest.mark.slow
def test_in_a_browser_one_takes_over_by_hand(page):
    page.get_by_text("+1 ▶").click()
    page.wait_for_function("Bokeh.documents[0].get_model_by_name('controller').value === 'by hand'")
    page.wait_for_function("Array.from(Bokeh.documents[0].get_model_by_name('path').data.action).at(-1) === 1")
    page.get_by_text("push the mass (force)").click()
    page.wait_for_function("Array.from(Bokeh.documents[0].get_model_by_name('path').data.v_belt).at(-1) === 0.2")
    page.get_by_text("basins of attraction").click()
    page.wait_for_function("Bokeh.documents[0].get_model_by_name('message').text.includes('of the starts')")
