"""Figures: what they show is in the right place, and what cannot be shown is refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mbn_marl.errors import MbnError
from mbn_marl.field import Field
from mbn_marl.render import style

matplotlib = pytest.importorskip("matplotlib", reason="needs the extra [render]")

from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: E402  (after the skip)
from matplotlib.colors import to_rgb  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from mbn_marl.render import figures  # noqa: E402
from tests.support.pictures import snapshot  # noqa: E402

SQUARE = [(100.0, 100.0), (300.0, 100.0), (300.0, 300.0), (100.0, 300.0)]
HOLE = [(180.0, 180.0), (220.0, 180.0), (220.0, 220.0), (180.0, 220.0)]
ROIS = [(150.0, 150.0), (250.0, 250.0)]
STARTS = [(120.0, 200.0), (280.0, 200.0)]
FIELD = Field(SQUARE, ROIS, STARTS)
TRAILS = np.array([[[120, 200], [280, 200]], [[125, 205], [270, 200]], [[135, 215], [255, 205]]])


def colour_at(figure: Figure, point: tuple[float, float]) -> tuple[int, ...]:
    """The colour, 0 to 255, that ``figure`` shows at a point given in units."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())
    x, y = figure.axes[0].transData.transform(point)
    return tuple(int(value) for value in picture[picture.shape[0] - 1 - round(y), round(x), :3])


def lines_of(figure: Figure, colour: str) -> list[NDArray[np.float64]]:
    """The (k, 2) data of every line of that colour."""
    lines = figure.axes[0].lines
    return [line.get_xydata() for line in lines if to_rgb(line.get_color()) == to_rgb(colour)]


def labels_of(figure: Figure) -> list[str]:
    """The labels of the figure's legend."""
    return [text.get_text() for text in figure.legends[0].get_texts()]


# ---------------------------------------------------------------- fields


def test_the_axes_hold_the_field_to_scale_and_y_up() -> None:
    axes = figures.field_figure(FIELD).axes[0]
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    assert left < 100.0 < 300.0 < right
    assert bottom < 100.0 < 300.0 < top
    assert axes.get_aspect() == 1.0


@pytest.mark.parametrize(("outline", "hole"), [(SQUARE, HOLE[::-1]), (SQUARE[::-1], HOLE[::-1])])
def test_a_hole_looks_like_the_outside(outline: Any, hole: Any) -> None:
    figure = figures.field_figure(Field(outline, ROIS, STARTS, holes=[hole]))
    assert colour_at(figure, (200.0, 200.0)) == style.rgb(style.OBSTACLE)
    assert colour_at(figure, (95.0, 200.0)) == style.rgb(style.OBSTACLE)
    assert colour_at(figure, (200.0, 240.0)) == style.rgb(style.GROUND)


def test_a_field_shows_its_rois_to_scale_and_its_starts() -> None:
    figure = figures.field_figure(FIELD)
    circles = [patch for patch in figure.axes[0].patches if hasattr(patch, "radius")]
    assert [circle.center for circle in circles] == ROIS
    assert {circle.radius for circle in circles} == {10.0}
    starts = [lines_of(figure, style.robot_colour(index)) for index in (0, 1)]
    assert np.array_equal(starts, [[[STARTS[0]]], [[STARTS[1]]]])
    assert labels_of(figure) == ["ROI", "start of robot i"]


# ---------------------------------------------------------------- trajectories


def test_each_robot_has_its_path_from_start_to_end() -> None:
    figure = figures.trajectory_figure(FIELD, TRAILS)
    for index in (0, 1):
        drawn = lines_of(figure, style.robot_colour(index))
        assert np.array_equal(drawn[0], TRAILS[:, index])
        assert np.array_equal(drawn[-2], TRAILS[:1, index]), "the start"
        assert np.array_equal(lines_of(figure, style.robot_colour(index))[-1], TRAILS[-1:, index])
    assert labels_of(figure) == ["ROI", "start", "end of robot i"]


def test_a_point_shows_where_a_robot_faces() -> None:
    figure = figures.trajectory_figure(FIELD, TRAILS, headings=np.array([np.nan, 0.5]))
    noses = [line for line in figure.axes[0].lines if not isinstance(line.get_marker(), str)]
    (nose,) = noses
    assert nose.get_color() == style.robot_colour(1)
    assert nose.get_xydata().tolist() == TRAILS[-1:, 1].tolist()
    tip = nose._marker.get_transform().transform((1.0, 0.0))
    assert np.arctan2(*tip[::-1]) == pytest.approx(0.5)


def test_a_cross_marks_a_robot_that_has_failed() -> None:
    crosses = []
    for failed in (np.zeros(2, bool), np.array([False, True])):
        figure = figures.trajectory_figure(FIELD, TRAILS, failed=failed)
        lines = [line for line in figure.axes[0].lines if line.get_marker() == "x"]
        crosses.append([line.get_xydata().tolist() for line in lines])
        assert ("failed" in labels_of(figure)) == failed.any()
    assert crosses == [[], [TRAILS[-1:, 1].tolist()]]


def test_paths_over_each_other_have_points_and_crosses_too() -> None:
    turned = {"headings": np.array([0.5, np.nan]), "failed": np.array([False, True])}
    pair = snapshot(TRAILS), snapshot(TRAILS, **turned)
    (axes,) = figures.overlay_panels({"one": pair}, ("plane", "mujoco")).axes
    title = axes.get_title(loc="left").split("\n")[1]
    assert title.startswith("plane: ") and ", mujoco: " in title
    crosses = [line for line in axes.lines if line.get_marker() == "x"]
    assert [line.get_xydata().tolist() for line in crosses] == [TRAILS[-1:, 1].tolist()]
    noses = [line for line in axes.lines if not isinstance(line.get_marker(), str)]
    assert [line.get_xydata().tolist() for line in noses] == [TRAILS[-1:, 0].tolist()]


def test_visited_rois_differ_in_colour_and_in_shape() -> None:
    figure = figures.trajectory_figure(FIELD, TRAILS, visited=np.array([True, False]))
    markers = {
        tuple(line.get_xydata()[0]): line.get_marker()
        for line in figure.axes[0].lines
        if tuple(line.get_xydata()[0]) in ROIS
    }
    assert markers == {ROIS[0]: "$\\checkmark$", ROIS[1]: "o"}
    assert np.array_equal(lines_of(figure, style.ROI_VISITED), [[ROIS[0]]])
    assert "ROI, visited" in labels_of(figure)


def test_a_collision_is_marked_between_the_closest_robots() -> None:
    trails = np.array([[[120.0, 200.0], [280.0, 200.0], [288.0, 206.0]]])
    figure = figures.trajectory_figure(FIELD, trails, collision=True)
    squares = [line for line in figure.axes[0].lines if line.get_marker() == "s"]
    assert [line.get_xydata().tolist() for line in squares] == [[[284.0, 203.0]]]
    assert "collision" in labels_of(figure)


def test_a_collision_is_not_one_of_a_robot_that_has_vanished() -> None:
    trail = np.array([[[120.0, 200.0], [288.0, 206.0], [280.0, 200.0], [289.0, 206.0]]])
    gone = np.array([False, False, False, True])
    moment = snapshot(trail, failed=gone, gone=gone, collision=True)
    drawn = figures.trajectory_figure(FIELD, trail, collision=True, gone=gone)
    for figure in (drawn, figures.trajectory_panels({"one": moment})):
        squares = [line for line in figure.axes[0].lines if line.get_marker() == "s"]
        assert [line.get_xydata().tolist() for line in squares] == [[[284.0, 203.0]]]


@pytest.mark.parametrize("wind", [(0.3, 0.0), (-0.1, 0.2), (0.0, -0.5)])
def test_the_wind_arrow_points_the_way_the_wind_blows(wind: tuple[float, float]) -> None:
    figure = figures.trajectory_figure(FIELD, TRAILS, wind=wind)
    FigureCanvasAgg(figure).draw()
    (arrow,) = [text for text in figure.axes[0].texts if text.arrow_patch is not None]
    path = arrow.arrow_patch.get_path().vertices
    tail, tip = path[0], path[2]
    direction = (tip - tail) / np.linalg.norm(tip - tail)
    assert direction == pytest.approx(np.array(wind) / np.hypot(*wind), abs=1e-3)
    shown = [text.get_text() for text in figure.axes[0].texts]
    assert f"wind {np.hypot(*wind):.3g}" in shown


def test_the_wind_of_a_panel_stands_above_the_outcome() -> None:
    last = snapshot(TRAILS, winds=np.array([(0.3, 0.0)]))
    (axes,) = figures.trajectory_panels({"wind 0.3": last}).axes
    assert not any("wind" in text.get_text() for text in axes.texts)  # the title says so
    figure = figures.trajectory_panels({"one": last})
    FigureCanvasAgg(figure).draw()
    (axes,) = figure.axes
    (label,) = (text for text in axes.texts if text.get_text() == "wind 0.3")
    title: Any = axes._left_title
    assert title.get_text().count("\n") == 1
    two_lines = title.get_window_extent()
    assert label.get_window_extent().y0 >= (two_lines.y0 + two_lines.y1) / 2


def test_gusts_are_a_line_for_each_direction() -> None:
    winds = [(0.3, 0.0), (-0.1, 0.0), (0.0, 0.2), (0.3, 0.0), (0.2, 0.01), (-0.09, 0.02)]
    figure = figures.trajectory_figure(FIELD, TRAILS, wind=winds)
    FigureCanvasAgg(figure).draw()
    (axes,) = figure.axes
    assert not any(text.arrow_patch for text in axes.texts)
    assert "wind \u2264 0.3" in [text.get_text() for text in axes.texts]
    (gusts,) = (line for line in axes.lines if not line.get_clip_on())
    ends = gusts.get_transform().transform(gusts.get_xydata()).reshape(-1, 3, 2)
    arms = (ends[:, 1] - ends[:, 0]) / figure.dpi * 72.0 / 9.0 * 0.3
    assert arms == pytest.approx(np.array([(0.3, 0.0), (0.0, 0.2), (-0.1, 0.0)]), abs=1e-6)


def test_one_wind_in_all_steps_is_an_arrow() -> None:
    figure = figures.trajectory_figure(FIELD, TRAILS, wind=[(0.3, 0.0)] * 3)
    assert "wind 0.3" in [text.get_text() for text in figure.axes[0].texts]
    assert any(text.arrow_patch for text in figure.axes[0].texts)


def test_without_wind_there_is_no_arrow() -> None:
    texts = figures.trajectory_figure(FIELD, TRAILS, wind=(0.0, 1e-17)).axes[0].texts
    assert not any("wind" in text.get_text() or text.arrow_patch for text in texts)


def test_arguments_of_another_shape_are_refused() -> None:
    for shape in ((3, 2), (0, 2, 2), (3, 0, 2), (3, 2, 3)):
        with pytest.raises(MbnError, match="trails: "):
            figures.trajectory_figure(FIELD, np.zeros(shape))
    with pytest.raises(MbnError, match="visited: "):
        figures.trajectory_figure(FIELD, TRAILS, visited=np.ones(3, bool))
    with pytest.raises(MbnError):
        figures.fields_figure([])


def test_many_fields_are_drawn_whole_each_with_its_bar() -> None:
    small = Field([(0, 0), (40, 0), (40, 40), (0, 40)], [(20, 20)], [(5, 5)])
    figure = figures.fields_figure([FIELD, small])
    for axes, field, bar in zip(figure.axes, (FIELD, small), (50.0, 10.0), strict=True):
        (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        assert right - left == pytest.approx(top - bottom)
        for x, y in field.vertices:
            assert left < x < right and bottom < y < top
        (line,) = [line for line in axes.lines if len(line.get_xdata()) == 2]
        assert np.ptp(line.get_xdata()) == pytest.approx(bar)
        lowest = axes.transAxes.transform((0.0, 0.0))[1]
        assert (line.get_transform().transform(line.get_xydata())[:, 1] < lowest).all()
        rois = [line for line in axes.lines if line.get_marker() == "o" and line.get_path_effects()]
        discs = [line for line in axes.lines if line.get_markersize() > 7]
        assert len(rois) == len(field.rois)
        assert min(roi.zorder for roi in rois) > max(disc.zorder for disc in discs)
        assert axes.texts[-1].get_text() == f"{bar:g} units"


# ---------------------------------------------------------------- files and the look


def test_a_figure_is_saved_in_the_format_of_its_name(tmp_path: Path) -> None:
    for name, start in (("a.png", b"\x89PNG"), ("a.PDF", b"%PDF"), ("a.svg", b"<?xml")):
        path = tmp_path / name / name
        assert figures.save(figures.field_figure(FIELD), path) == path
        assert path.read_bytes().startswith(start)
        assert list(path.parent.iterdir()) == [path], "no temporary file is left"
    with pytest.raises(MbnError, match=r"a\.bmp: "):
        figures.save(figures.field_figure(FIELD), tmp_path / "a.bmp")


def test_a_failed_save_leaves_the_old_file(tmp_path: Path) -> None:
    class Broken(Figure):
        def savefig(self, fname: Any, **_: Any) -> None:  # type: ignore[override]
            Path(fname).write_bytes(b"half")
            raise RuntimeError("out of ink")

    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="out of ink"):
        figures.save(Broken(), path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
def test_figures_leave_matplotlib_as_it_was() -> None:
    code = (
        "import sys, matplotlib\n"
        "before = matplotlib.rcParams.copy()\n"
        "from mbn_marl.field import load_field\n"
        "from mbn_marl.render import figures\n"
        "figures.field_figure(load_field('field_03'))\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
        "assert matplotlib.rcParams.copy() == before\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr


def test_ink_on_a_colour_is_what_contrasts_more() -> None:
    # Contrast of white and of black (WCAG 2.1): blue 5.2 and 4.0; orange 2.2 and 9.4.
    assert style.ink_on(style.BLUE) == style.WHITE
    assert style.ink_on(style.ORANGE) == style.BLACK
    assert style.ink_on(style.WHITE) == style.BLACK
    assert style.rgb("#0072B2") == (0, 114, 178)


def test_series_in_a_row_differ_in_colour_dash_and_marker() -> None:
    looks = [style.series(index) for index in range(30)]
    for index in range(28):
        for aspect in zip(*looks[index : index + 3], strict=True):
            assert len(set(aspect)) == 3
    assert len({(look.dash, look.marker) for look in looks}) == 30  # so in grey print too
