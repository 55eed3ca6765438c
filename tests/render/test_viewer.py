"""The viewer: arrays without a display, windows, sizes, and what is refused."""

import os
import subprocess
import sys

import numpy as np
import pygame
import pytest

from mbn_marl import centralized_env, parallel_env
from mbn_marl import env as aec_env
from mbn_marl.adapters.gymnasium import CentralizedVectorEnv
from mbn_marl.errors import ConfigError
from mbn_marl.render import Viewer
from tests.support.pictures import SIZE, draw, snapshot


def test_frame_is_a_new_array_of_height_width_and_three_channels():
    viewer = Viewer("rgb_array", size=(300, 220))
    first = draw(snapshot(), viewer)
    kept = first.copy()
    draw(snapshot([(120.0, 200.0), (280.0, 280.0)]), viewer)
    assert (first.shape, first.dtype) == ((220, 300, 3), np.uint8)
    assert first.flags.c_contiguous and first.flags.writeable
    assert np.array_equal(first, kept)


def test_circles_to_scale_may_be_larger_than_the_picture():
    settings = {"n_robots": 1, "roi_radius": 1e12, "safety_distance": 1e12}
    with pytest.warns(UserWarning, match="smaller than an ROI"):
        env = parallel_env("field_03", render_mode="rgb_array", **settings)
    env.reset(seed=0)
    assert env.render().std() > 1


@pytest.mark.slow
def test_array_needs_no_display_and_opens_none():
    code = (
        "import pygame\n"
        "from mbn_marl.engine import BatchEngine\n"
        "from mbn_marl.render import Viewer\n"
        "engine = BatchEngine('field_03', num_worlds=1, autoreset=False, threads=1)\n"
        "engine.reset()\n"
        "frame = Viewer('rgb_array').draw(engine.snapshot())\n"
        "assert frame.std() > 0\n"
        "assert not pygame.display.get_init()\n"
    )
    hidden = ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY")
    variables = {key: value for key, value in os.environ.items() if key not in hidden}
    subprocess.run([sys.executable, "-c", code], env=variables, check=True)


def test_without_pygame_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    monkeypatch.delitem(sys.modules, "mbn_marl.render.scene", raising=False)
    with pytest.raises(ImportError, match=r"\.\[render\]"):
        Viewer("rgb_array").draw(snapshot())


def test_every_wrong_argument_is_listed():
    with pytest.raises(ConfigError, match=r"render_mode: (.|\n)* size: (.|\n)* frame_rate: "):
        Viewer("ansi", size=(400, 40), frame_rate=0.0)
    for size in ((400, 40), (400.0, 400), (400,), 400, "big"):
        for make in (parallel_env, aec_env, centralized_env, CentralizedVectorEnv):
            with pytest.raises(ConfigError, match=r"render_size: (.|\n)* render_mode: "):
                make(field="field_03", render_mode="ansi", render_size=size)


@pytest.mark.parametrize("render_mode", ["human", "rgb_array"])
@pytest.mark.parametrize("make", [parallel_env, centralized_env])
@pytest.mark.parametrize("size", [{}, {"render_size": (500, 300)}])
def test_size_of_an_environments_pictures_is_an_argument(make, render_mode, size):
    env = make("field_03", render_mode=render_mode, **size)
    env.reset(seed=0)
    frame = env.render()
    shown = pygame.display.get_window_size() if frame is None else frame.shape[1::-1]
    env.close()
    assert tuple(shown) == size.get("render_size", (800, 800))


@pytest.fixture(autouse=True)
def closed_display():
    yield
    pygame.display.quit()


def test_window_shows_the_frame():
    viewer = Viewer("human", SIZE, frame_rate=1000.0)
    assert viewer.draw(snapshot()) is None
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown, draw(snapshot()))
    viewer.close()
    viewer.close()
    assert not pygame.display.get_init()


def test_another_window_outlives_a_closed_one():
    one, other = (Viewer("human", SIZE, frame_rate=1000.0) for _ in range(2))
    one.draw(snapshot())
    other.draw(snapshot())
    one.close()
    assert other.draw(snapshot()) is None
    assert pygame.display.get_init() and not other.closed


def test_person_can_close_the_window():
    viewer = Viewer("human", SIZE, frame_rate=1000.0)
    viewer.draw(snapshot())
    assert not viewer.closed
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE))
    viewer.draw(snapshot())
    assert viewer.closed
    assert viewer.draw(snapshot()) is None
    assert not pygame.display.get_init(), "a closed window stays closed"


def test_window_without_a_display_says_what_to_do(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "no_such_driver")
    with pytest.raises(RuntimeError, match="display"):
        Viewer("human").draw(snapshot())
