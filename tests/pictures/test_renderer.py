"""Frames: what they show, at which sizes, and that they need no display."""

import copy
import dataclasses
import importlib.util
import math
import os
import pickle
import subprocess
import sys
import time

import numpy as np
import pytest

from sd_friction_env.pictures.renderer import Renderer
from sd_friction_env.pictures.scene import Scene

if importlib.util.find_spec("pygame") is None:
    pytest.skip("needs pygame-ce", allow_module_level=True)

SLIPPING = Scene(
    time=3.0,
    x=0.6,
    v=-0.2,
    v_belt=0.2,
    mode=-1,
    belt_travel=0.0,
    force=0.0,
    force_limit=0.05,
    belt_speed_nominal=0.2,
    belt_speed_limits=(0.2, 0.2),
    alpha=0.8,
    geometry="exact",
    stick_interval=(-0.93, 0.9),
    amplitude=0.393,
    stick_fraction=0.25,
)
STICKING = dataclasses.replace(SLIPPING, v=0.2, mode=0)
BLUE = (0, 114, 178)


def frame(scene=SLIPPING, width=960, height=540, **changes):
    return Renderer("rgb_array", width, height).draw(dataclasses.replace(scene, **changes))


def changed(first, second):
    """Return the rows and columns of the pixels that differ."""
    return np.nonzero((first != second).any(axis=2))


def mass_column(picture):
    """Return the centre of a sticking mass: the solid blue between the ceiling and the belt, left of the portrait."""
    return np.nonzero((picture[230:300, :560] == BLUE).all(axis=2))[1].mean()


def motion(steps=40):
    for k in range(steps):
        phase = k / 6
        x, v = 0.6 + 0.3 * math.cos(phase), -0.25 * math.sin(phase)
        yield dataclasses.replace(SLIPPING, time=0.1 * k, x=x, v=min(v, 0.2), mode=0 if v >= 0.2 else -1)


def in_a_process(code, **environment):
    kept = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")}
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(
        command, env={**kept, **environment}, check=True, timeout=120, capture_output=True, text=True
    ).stdout


SCENE_CODE = (
    "import os, sys; from sd_friction_env.pictures.renderer import Renderer, Scene;"
    "scene = Scene(time=0.0, x=0.6, v=0.2, v_belt=0.2, mode=0, belt_travel=0.0, force=0.0, force_limit=0.05,"
    " belt_speed_nominal=0.2, belt_speed_limits=(0.2, 0.2), alpha=0.8, geometry='exact', stick_interval=None,"
    " amplitude=float('nan'), stick_fraction=0.0);"
)


@pytest.mark.parametrize("size", [(240, 135), (320, 180), (960, 540), (1920, 1080), (500, 900), (1600, 400)])
def test_a_frame_has_the_size_asked_for_and_something_on_it(size):
    picture = frame(width=size[0], height=size[1])
    assert picture.shape == (size[1], size[0], 3)
    assert picture.dtype == np.uint8
    assert picture.flags.writeable
    assert picture.std() > 10


def test_frames_handed_out_are_not_overwritten_by_later_ones():
    renderer = Renderer("rgb_array")
    first = renderer.draw(SLIPPING)
    before = first.copy()
    renderer.draw(dataclasses.replace(STICKING, time=3.1, x=0.9))
    assert np.array_equal(first, before)


def test_no_display_is_touched_and_nothing_is_printed():
    code = SCENE_CODE + (
        "f = Renderer('rgb_array').draw(scene); import pygame;"
        "assert f.std() > 10 and not pygame.display.get_init();"
        "assert not any(name.startswith('SDL') for name in os.environ)"
    )
    assert in_a_process(code) == ""


def test_an_environment_loads_no_pygame_before_it_draws():
    in_a_process("import sys, sd_friction_env; sd_friction_env.SDFrictionEnv; assert 'pygame' not in sys.modules")


def test_the_mass_moves_to_scale_and_by_less_than_a_pixel_too():
    columns = [mass_column(frame(STICKING, x=x)) for x in (0.2, 0.5, 0.8)]
    assert columns[1] - columns[0] == pytest.approx(columns[2] - columns[1], abs=0.6)
    assert columns[1] - columns[0] > 50
    assert len(changed(frame(x=0.5), frame(x=0.5005))[0]) > 0


def test_the_belts_marks_move_as_far_as_the_belt():
    scale = (mass_column(frame(STICKING, x=0.9)) - mass_column(frame(STICKING, x=0.3))) / 0.6
    shift = 10
    there, later = (frame(belt_travel=travel) for travel in (0.0, shift / scale))
    rows, columns = changed(there, later)
    assert columns.max() < 570  # nothing but the belt
    assert rows.min() > 300
    assert rows.max() < 400
    top_run = slice(rows.min() + 3, rows.min() + 6)
    before, after = there[top_run, 100:220].astype(int), later[top_run, 100 + shift : 220 + shift].astype(int)
    assert np.ptp(before) > 100  # there are marks
    assert np.abs(before - after).max() < 40
    bottom_run = slice(rows.max() - 5, rows.max() - 2)
    before, after = there[bottom_run, 120:220].astype(int), later[bottom_run, 120 - shift : 220 - shift].astype(int)
    assert np.ptp(before) > 100
    assert np.abs(before - after).max() < 40


def test_stick_and_slip_are_told_apart_even_without_colour():
    stick, slip = frame(STICKING), frame(STICKING, mode=-1)
    column = round(mass_column(stick))
    patches = [picture[270:276, column - 18 : column + 18].mean() for picture in (stick, slip)]
    assert patches[1] - patches[0] > 60
    assert len(changed(slip, frame(STICKING, mode=1))[0]) > 50


@pytest.mark.parametrize(
    "change",
    [
        {"force": 0.04},
        {"force": -0.04},
        {"v": -0.25},
        {"v_belt": 0.1},
        {"alpha": 0.6},
        {"geometry": "linear"},
        {"stick_interval": None},
        {"stick_interval": (0.1, 0.4)},
        {"amplitude": 0.1},
        {"amplitude": math.nan},
        {"stick_fraction": 0.5},
        {"time": 7.0},
        {"title": "velocity feedback"},
        {"force_limit": 0.0},
        {"belt_speed_limits": (0.1, 0.3)},
    ],
)
def test_everything_told_is_shown(change):
    assert len(changed(frame(), frame(**change))[0]) > 5
    # ... also when only this changed since the last frame: what is kept between frames may not be stale.
    renderer = Renderer("rgb_array")
    renderer.draw(SLIPPING)
    renderer.clear_trail()
    changed_scene = dataclasses.replace(SLIPPING, **change)
    fresh = Renderer("rgb_array").draw(changed_scene)
    assert np.array_equal(renderer.draw(changed_scene), fresh)


@pytest.mark.parametrize(
    "extreme",
    [
        {"x": 9.5, "v": -8.0},
        {"x": -9.5},
        {"alpha": 0.001},
        {"alpha": 10.0},
        {"alpha": 10.0, "x": 0.0},
        {"alpha": 0.001, "x": 0.0},
        {"geometry": "linear", "x": -3.0},
        {"geometry": "cubic", "x": -0.4},
        {"v_belt": 0.0, "belt_speed_nominal": 0.0, "belt_speed_limits": (0.0, 0.0)},
        {"belt_travel": 1e6},
        {"belt_speed_limits": (0.1, 0.3)},
        {"stick_interval": (5.0, 6.0)},
    ],
)
@pytest.mark.parametrize("width", [320, 960])
def test_extremes_are_drawn(extreme, width):
    assert frame(width=width, height=width * 9 // 16, **extreme).std() > 10


def test_the_same_scenes_give_the_same_pixels():
    renderers = [Renderer("rgb_array", 480, 270) for _ in range(2)]
    for scene in motion():
        first, second = (renderer.draw(scene) for renderer in renderers)
        assert np.array_equal(first, second)


def test_the_portrait_keeps_a_trail_until_told_to_forget_it():
    renderer = Renderer("rgb_array")
    scenes = list(motion())
    for scene in scenes:
        last = renderer.draw(scene)
    alone = Renderer("rgb_array").draw(scenes[-1])
    columns = changed(last, alone)[1]
    assert len(columns) > 200
    assert columns.min() > 570
    renderer.clear_trail()
    assert np.array_equal(renderer.draw(scenes[-1]), alone)


def test_a_scene_drawn_twice_counts_once_and_going_back_in_time_starts_a_new_trail():
    renderer = Renderer("rgb_array")
    scenes = list(motion(10))
    for scene in scenes:
        once = renderer.draw(scene)
    assert np.array_equal(renderer.draw(scenes[-1]), once)
    assert np.array_equal(renderer.draw(scenes[0]), Renderer("rgb_array").draw(scenes[0]))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda renderer: pickle.loads(pickle.dumps(renderer))])
def test_copies_go_on_where_the_original_was(copied):
    renderer = Renderer("rgb_array", 480, 270)
    scenes = list(motion())
    for scene in scenes[:-1]:
        renderer.draw(scene)
    assert np.array_equal(copied(renderer).draw(scenes[-1]), renderer.draw(scenes[-1]))


def test_closing_twice_is_fine_and_drawing_afterwards_too():
    renderer = Renderer("rgb_array")
    renderer.close()
    first = renderer.draw(SLIPPING)
    renderer.close()
    renderer.close()
    assert np.array_equal(renderer.draw(SLIPPING), first)


def test_a_frame_leaves_time_for_sixty_a_second():
    renderer = Renderer("rgb_array")
    spent = []
    for scene in motion(60):
        start = time.process_time()
        renderer.draw(scene)
        spent.append(time.process_time() - start)
    assert np.median(spent) < 1 / 60, f"{1e3 * np.median(spent):.1f} ms a frame"


def test_the_window_is_drawn_resized_and_closed_by_its_user():
    code = SCENE_CODE + (
        "import pygame; r = Renderer('human', fps=200);"
        "assert r.draw(scene) is None and pygame.display.get_surface().get_size() == (960, 540);"
        "copy = __import__('pickle').loads(__import__('pickle').dumps(r)); copy.close();"
        "pygame.display.set_mode((700, 400), pygame.RESIZABLE); assert r.draw(scene) is None;"
        "assert len(set(pygame.image.tobytes(pygame.display.get_surface(), 'RGB'))) > 10;"
        "pygame.event.post(pygame.event.Event(pygame.QUIT));"
        "assert r.draw(scene) is None and r.dismissed and not pygame.display.get_init();"
        "assert r.draw(scene) is None and not pygame.display.get_init(); r.close(); r.close()"
    )
    in_a_process(code, SDL_VIDEODRIVER="dummy")


def test_a_missing_display_is_said():
    code = SCENE_CODE + "\ntry:\n    Renderer('human').draw(scene)\nexcept RuntimeError as error:\n    print(error)"
    said = in_a_process(code, SDL_VIDEODRIVER="no such driver")
    assert "needs a display" in said
    assert "rgb_array" in said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"render_mode": "ansi"}, r"render_mode must be one of 'human', 'rgb_array', got 'ansi'"),
        ({"render_mode": None}, r"render_mode .* got None"),
        ({"width": 0}, r"width must be a whole number in \[240, 7680\], got 0"),
        ({"width": 960.5}, r"width .* got 960\.5"),
        ({"width": True}, r"width .* got True"),
        ({"height": -5}, r"height must be a whole number in \[135, 4320\], got -5"),
        ({"height": "540"}, r"height .* got '540'"),
        ({"fps": 0}, r"fps must be a whole number in \[1, 1000\], got 0"),
        ({"fps": math.nan}, r"fps .* got nan"),
    ],
)
def test_bad_arguments_are_refused_by_name(arguments, said):
    with pytest.raises(ValueError, match=said):
        Renderer(**{"render_mode": "rgb_array", **arguments})


@pytest.mark.parametrize("name", ["time", "x", "v", "v_belt", "belt_travel"])
def test_a_state_that_is_not_finite_is_refused_by_name(name):
    with pytest.raises(ValueError, match=rf"scene\.{name} must be a finite number, got nan"):
        frame(**{name: math.nan})
