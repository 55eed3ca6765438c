"""The viewer and the GIF writer: what is drawn, where, and without a display."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mbn_marl.engine import BatchEngine
from mbn_marl.engine.snapshot import Snapshot
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field
from mbn_marl.render import Viewer, style, write_gif
from mbn_marl.render.viewport import Viewport

pygame = pytest.importorskip("pygame", reason="needs the extra [render]")

SQUARE = [(100.0, 100.0), (300.0, 100.0), (300.0, 300.0), (100.0, 300.0)]
HOLE = [(190.0, 190.0), (210.0, 190.0), (210.0, 210.0), (190.0, 210.0)]
FIELD = Field(SQUARE, rois=[(150.0, 150.0), (250.0, 250.0)], starts=[(120.0, 200.0)])

Frame = NDArray[np.uint8]


def snapshot(trail: Any = ((120.0, 200.0),), **changes: Any) -> Snapshot:
    """A moment of one robot (or, with a (t + 1, n, 2) trail, of more) in the square field."""
    path = np.asarray(trail, np.float64)
    path = path[:, None] if path.ndim == 2 else path
    values: dict[str, Any] = {
        "field": FIELD,
        "positions": path[-1],
        "velocities": np.zeros_like(path[-1]),
        "visited": np.zeros(2, bool),
        "trail": path,
        "step": len(path) - 1,
        "team_return": -10.0 * (len(path) - 1),
        "wind": (0.0, 0.0),
        "roi_radius": 10.0,
        "safety_distance": 10.0,
        "success": False,
        "collision": False,
    }
    return Snapshot(**(values | changes))


def draw(moment: Snapshot, viewer: Viewer | None = None) -> Frame:
    """The frame of a viewer in rgb_array mode, a new one unless given."""
    frame = (viewer or Viewer("rgb_array")).draw(moment)
    assert frame is not None
    return frame


def where(frame: Frame, colour: str) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the pixels of exactly that colour."""
    rows, columns = np.nonzero((frame == style.rgb(colour)).all(axis=2))
    return rows, columns


def wander(steps: int, robots: int, seed: int = 0) -> NDArray[np.float64]:
    """A random (steps + 1, robots, 2) walk inside the square field."""
    walk = np.random.default_rng(seed).normal(0.0, 3.0, (steps + 1, robots, 2)).cumsum(axis=0)
    return np.clip(200.0 + walk, 105.0, 295.0)


def run_python(code: str, **environment: str) -> None:
    """Run ``code`` in a fresh interpreter that knows of no display."""
    hidden = ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY")
    variables = {key: value for key, value in os.environ.items() if key not in hidden}
    result = subprocess.run(
        [sys.executable, "-c", code],
        env=variables | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr


# ---------------------------------------------------------------- arrays


def test_a_frame_is_a_new_array_of_height_width_and_three_channels() -> None:
    viewer = Viewer("rgb_array", size=(300, 220))
    first = draw(snapshot(), viewer)
    kept = first.copy()
    second = draw(snapshot([(120.0, 200.0), (280.0, 280.0)]), viewer)
    assert first.shape == (220, 300, 3)
    assert first.dtype == np.uint8
    assert first.flags.c_contiguous and first.flags.writeable
    assert np.array_equal(first, kept)
    assert not np.array_equal(first, second)


def test_an_array_needs_no_display_and_opens_none() -> None:
    run_python(
        "import pygame\n"
        "from mbn_marl.engine import BatchEngine\n"
        "from mbn_marl.render import Viewer\n"
        "engine = BatchEngine('field_03', num_worlds=1, autoreset=False, threads=1)\n"
        "engine.reset()\n"
        "frame = Viewer('rgb_array').draw(engine.snapshot())\n"
        "assert frame.std() > 0\n"
        "assert not pygame.display.get_init()\n"
    )


def test_importing_the_package_loads_no_drawing_library() -> None:
    run_python(
        "import sys, mbn_marl.render\n"
        "loaded = {'pygame', 'matplotlib', 'PIL', 'numba'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
    )


def test_without_pygame_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    for module in ("scene", "sprites"):
        monkeypatch.delitem(sys.modules, f"mbn_marl.render.{module}", raising=False)
    with pytest.raises(ImportError, match=r'pip install "mbn_marl\[render\]"'):
        Viewer("rgb_array").draw(snapshot())


def test_every_wrong_argument_is_listed() -> None:
    with pytest.raises(ConfigError) as caught:
        Viewer("ansi", size=(400, 40), frame_rate=0.0)
    problems = "\n".join(caught.value.problems)
    assert len(caught.value.problems) == 3
    for expected in ("'human' or 'rgb_array', not 'ansi'", "(400, 40)", "frame_rate: above 0"):
        assert expected in problems


# ---------------------------------------------------------------- what is where


def test_viewport_fits_the_box_and_turns_y_up() -> None:
    points = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 5.0)])
    view = Viewport.fit(points, (20.0, 30.0, 100.0, 100.0))
    assert view.scale == 10.0
    assert view.to_pixels(points).tolist() == [[20.0, 105.0], [120.0, 105.0], [120.0, 55.0]]


@pytest.mark.parametrize("position", [(200.0, 290.0), (200.0, 110.0), (285.0, 240.0)])
def test_a_robot_is_drawn_where_it_is_with_y_up(position: tuple[float, float]) -> None:
    frame = draw(snapshot([position], roi_radius=0.0))
    ground_rows, ground_columns = where(frame, style.GROUND)
    rows, columns = where(frame, style.robot_colour(0))
    left, right = ground_columns.min(), ground_columns.max()
    top, bottom = ground_rows.min(), ground_rows.max()
    share = (np.array(position) - 100.0) / 200.0
    assert np.median(columns) == pytest.approx(left + share[0] * (right - left), abs=3.0)
    assert np.median(rows) == pytest.approx(bottom - share[1] * (bottom - top), abs=3.0)


def test_the_field_fills_the_picture_below_the_header() -> None:
    rows, columns = where(draw(snapshot()), style.GROUND)
    assert 40 < rows.min() < 60 and 370 < rows.max() < 400
    assert rows.max() - rows.min() == pytest.approx(columns.max() - columns.min(), abs=2)


def test_a_hole_is_drawn_as_an_obstacle() -> None:
    field = Field(SQUARE, rois=FIELD.rois, starts=FIELD.starts, holes=[HOLE])
    solid, pierced = draw(snapshot()), draw(snapshot(field=field))
    rows, columns = where(solid, style.GROUND)
    middle = (rows.min() + rows.max()) // 2, (columns.min() + columns.max()) // 2
    assert tuple(solid[middle]) == style.rgb(style.GROUND)
    assert tuple(pierced[middle]) == style.rgb(style.OBSTACLE)


def test_a_visited_roi_is_filled_and_an_open_one_hollow() -> None:
    none, first = (draw(snapshot(visited=np.array(seen))) for seen in ([0, 0], [1, 0]))
    assert not where(none, style.ROI_VISITED)[0].size
    rows, columns = where(first, style.ROI_VISITED)
    assert rows.size > 50
    assert rows.min() > 250 and columns.max() < 150, "the first ROI is at the lower left"
    # It differs without its colour, too: an open marker is bright inside.
    box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    assert none[box].mean() - first[box].mean() > 40.0


def test_circles_to_scale_appear_where_there_is_room() -> None:
    assert not np.array_equal(draw(snapshot(roi_radius=10.0)), draw(snapshot(roi_radius=20.0)))
    near, far = snapshot(safety_distance=20.0), snapshot(safety_distance=40.0)
    assert not np.array_equal(draw(near), draw(far))


@pytest.mark.parametrize(
    ("wind", "towards"),
    [
        ((0.3, 0.0), (0, 1)),
        ((-0.3, 0.0), (0, -1)),
        ((0.0, 0.3), (-1, 0)),
        ((0.0, -0.3), (1, 0)),
    ],
)
def test_the_wind_arrow_points_the_way_the_wind_blows(
    wind: tuple[float, float], towards: tuple[int, int]
) -> None:
    corner = draw(snapshot(wind=wind))[:44, -42:]
    mass = 255.0 - corner[:, :, 0]
    mass[(corner == style.rgb(style.OBSTACLE)).all(axis=2)] = 0.0
    rows, columns = np.indices(mass.shape)
    middle = np.array([22.5, 18.5])
    inside = np.hypot(rows - middle[0], columns - middle[1]) < 15.0
    weight = mass[inside] / mass[inside].sum()
    offset = np.array([rows[inside] @ weight, columns[inside] @ weight]) - middle
    assert offset @ towards > 1.5, "the head of the arrow is its heavy end"
    assert abs(offset @ towards[::-1]) < 0.5


def test_without_wind_there_is_no_arrow() -> None:
    corner = draw(snapshot(wind=(1e-17, 0.0)))[:44, -150:]
    assert (corner == style.rgb(style.OBSTACLE)).all()


@pytest.mark.parametrize(
    ("ending", "colour"), [("success", style.SUCCESS), ("collision", style.COLLISION)]
)
def test_the_end_of_an_episode_is_announced(ending: str, colour: str) -> None:
    running, over = draw(snapshot()), draw(snapshot(**{ending: True}))
    assert not where(running[:44], colour)[0].size
    assert where(over[:44], colour)[0].size > 100


def test_the_header_tells_step_and_return() -> None:
    one, two = snapshot(step=1), snapshot(step=2)
    assert not np.array_equal(draw(one)[:44, :90], draw(two)[:44, :90])
    poor, rich = snapshot(team_return=-0.5), snapshot(team_return=158_800.0)
    assert not np.array_equal(draw(poor)[:24, 90:], draw(rich)[:24, 90:])


def test_robots_that_share_a_colour_differ_in_their_number() -> None:
    assert style.robot_colour(0) == style.robot_colour(6)
    spots = [(110.0 + 25.0 * index, 200.0) for index in range(7)]
    rows, columns = where(draw(snapshot([spots])), style.robot_colour(0))
    shapes = [
        set(zip(rows[side] - rows[side].min(), columns[side] - columns[side].min(), strict=True))
        for side in (columns < 200, columns > 200)
    ]
    assert shapes[0] != shapes[1]


# ---------------------------------------------------------------- from frame to frame


def test_a_trail_drawn_bit_by_bit_is_the_trail_drawn_at_once() -> None:
    trail, viewer = wander(40, 3), Viewer("rgb_array")
    frames = [draw(snapshot(trail[: step + 1]), viewer) for step in range(41)]
    assert np.array_equal(frames[-1], draw(snapshot(trail)))
    assert not np.array_equal(frames[-1], draw(snapshot(trail[-1:], step=40, team_return=-400.0)))


@pytest.mark.parametrize(
    "other",
    [
        snapshot(wander(5, 3, seed=1)),
        snapshot(wander(30, 3, seed=1)),
        snapshot(wander(20, 2)),
        snapshot(wander(20, 3), wind=(0.1, 0.0)),
        snapshot(
            wander(20, 3),
            field=Field([(90, 90), (320, 90), (270, 320)], rois=FIELD.rois, starts=[(120, 100)]),
        ),
    ],
    ids=["a shorter episode", "a longer episode", "another team", "wind", "another field"],
)
def test_nothing_of_the_last_frame_stays(other: Snapshot) -> None:
    viewer = Viewer("rgb_array")
    draw(snapshot(wander(20, 3)), viewer)
    assert np.array_equal(draw(other, viewer), draw(other))


def test_what_stays_the_same_is_not_drawn_again() -> None:
    trail, viewer = wander(300, 3), Viewer("rgb_array")

    def fastest(draw_one: Any) -> float:
        spans = []
        for step in range(250, 270):
            start = time.process_time()
            draw_one(snapshot(trail[: step + 1]))
            spans.append(time.process_time() - start)
        return min(spans)

    draw(snapshot(trail[:250]), viewer)
    assert 4.0 * fastest(viewer.draw) < fastest(draw)


def test_the_snapshot_of_an_engine_can_be_drawn() -> None:
    engine = BatchEngine("field_03", num_worlds=2, autoreset=False, threads=1)
    engine.reset()
    viewer = Viewer("rgb_array")
    before = draw(engine.snapshot(1), viewer)
    engine.step(np.ones((2, engine.n_robots, 2)))
    assert engine.snapshot(1).trail.shape == (2, engine.n_robots, 2)
    assert not np.array_equal(before, draw(engine.snapshot(1), viewer))


# ---------------------------------------------------------------- windows


@pytest.fixture
def no_screen(monkeypatch: pytest.MonkeyPatch) -> Any:
    """SDL's driver that shows nothing; the display is closed afterwards."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


@pytest.mark.usefixtures("no_screen")
def test_the_window_shows_the_frame() -> None:
    viewer = Viewer("human", frame_rate=1000.0)
    assert viewer.draw(snapshot()) is None
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown, draw(snapshot()))
    viewer.close()
    viewer.close()
    assert not pygame.display.get_init()


@pytest.mark.usefixtures("no_screen")
@pytest.mark.parametrize(
    "event",
    [pygame.event.Event(pygame.QUIT), pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE)],
    ids=["close button", "escape"],
)
def test_a_person_can_close_the_window(event: Any) -> None:
    viewer = Viewer("human", frame_rate=1000.0)
    viewer.draw(snapshot())
    assert not viewer.closed
    pygame.event.post(event)
    viewer.draw(snapshot())
    assert viewer.closed
    assert viewer.draw(snapshot()) is None
    assert not pygame.display.get_init(), "a closed window stays closed"


@pytest.mark.usefixtures("no_screen")
def test_the_window_keeps_to_the_frame_rate() -> None:
    viewer = Viewer("human", frame_rate=50.0)
    viewer.draw(snapshot())
    start = time.perf_counter()
    for _ in range(5):
        viewer.draw(snapshot())
    assert time.perf_counter() - start > 0.08


def test_a_window_without_a_display_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "no_such_driver")
    with pytest.raises(RuntimeError, match=r"needs a display .* render_mode='rgb_array'"):
        Viewer("human").draw(snapshot())


# ---------------------------------------------------------------- GIF


def test_a_gif_holds_the_frames_and_is_small(tmp_path: Path) -> None:
    from PIL import Image

    trail, viewer = wander(30, 3), Viewer("rgb_array")
    frames = [draw(snapshot(trail[: step + 1]), viewer) for step in range(31)]
    path = write_gif(frames, tmp_path / "new" / "episode.gif", fps=25.0)
    with Image.open(path) as gif:
        assert gif.n_frames == 31
        assert gif.info["duration"] == 40
        assert gif.info["loop"] == 0
        gif.seek(30)
        shown = np.asarray(gif.convert("RGB"), np.int64)
    error = np.abs(shown - frames[-1])
    assert error.mean() < 2.0 and error.max() < 32, "the colours of the last frame are kept"
    assert path.stat().st_size < 31 * 4000
    assert list(path.parent.iterdir()) == [path], "no temporary file is left"
