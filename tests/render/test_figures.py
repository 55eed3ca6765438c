"""Figures: what they show is in the right place, and what cannot be shown is refused."""

from __future__ import annotations

import re
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

from mbn_marl.render import curves, figures  # noqa: E402

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


@pytest.mark.parametrize("outline", [SQUARE, SQUARE[::-1]], ids=["outline ccw", "outline cw"])
@pytest.mark.parametrize("hole", [HOLE, HOLE[::-1]], ids=["hole ccw", "hole cw"])
def test_a_hole_looks_like_the_outside(outline: Any, hole: Any) -> None:
    figure = figures.field_figure(Field(outline, ROIS, STARTS, holes=[hole]))
    assert colour_at(figure, (200.0, 200.0)) == style.rgb(style.OBSTACLE)
    assert colour_at(figure, (95.0, 200.0)) == style.rgb(style.OBSTACLE)
    assert colour_at(figure, (200.0, 240.0)) == style.rgb(style.GROUND)


def test_a_field_shows_its_rois_to_scale_and_its_starts() -> None:
    figure = figures.field_figure(FIELD, roi_radius=12.5)
    circles = [patch for patch in figure.axes[0].patches if hasattr(patch, "radius")]
    assert [circle.center for circle in circles] == ROIS
    assert {circle.radius for circle in circles} == {12.5}
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


def test_without_wind_there_is_no_arrow() -> None:
    texts = figures.trajectory_figure(FIELD, TRAILS, wind=(0.0, 1e-17)).axes[0].texts
    assert not any("wind" in text.get_text() or text.arrow_patch for text in texts)


@pytest.mark.parametrize("shape", [(3, 2), (0, 2, 2), (3, 0, 2), (3, 2, 3)])
def test_trails_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(MbnError, match=rf"trails: .*not {re.escape(str(shape))}"):
        figures.trajectory_figure(FIELD, np.zeros(shape))


def test_visits_of_another_shape_are_refused() -> None:
    with pytest.raises(MbnError, match=r"visited: the shape has to be \(2,\), not \(3,\)"):
        figures.trajectory_figure(FIELD, TRAILS, visited=np.ones(3, bool))


# ---------------------------------------------------------------- learning curves


def run(steps: Any, returns: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The curve of one seed."""
    return np.array(steps, np.float64), np.array(returns, np.float64)


def test_mean_and_band_by_hand() -> None:
    # The bootstrap means of two seeds are low, half, high with odds 1/4, 1/2, 1/4.
    seeds = [run([0, 10, 20], [0, 10, 0]), run([5, 15, 30], [20, 30, 30])]
    steps, mean, low, high = curves.mean_and_band("a", seeds)
    assert steps.tolist() == [5.0, 10.0, 15.0, 20.0]
    assert mean.tolist() == [12.5, 17.5, 17.5, 15.0]
    assert low.tolist() == [5.0, 10.0, 5.0, 0.0]
    assert high.tolist() == [20.0, 25.0, 30.0, 30.0]


def test_the_band_is_the_bootstrap_of_scipy() -> None:
    stats = pytest.importorskip("scipy.stats")
    values = np.array([100.0, 130.0, 90.0, 250.0, 120.0])
    _, _, low, high = curves.mean_and_band("a", [run([0], [value]) for value in values])
    expected = stats.bootstrap(
        (values,), np.mean, n_resamples=10_000, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    assert (low[0], high[0]) == pytest.approx((expected.low, expected.high))


def test_a_line_for_each_algorithm_and_a_band_for_more_than_one_seed() -> None:
    several = [run([0, 10], [0, 100]), run([0, 10], [50, 120])]
    figure = figures.learning_curves({"ours": several, "theirs": [run([0, 10], [5, 7])]})
    axes = figure.axes[0]
    assert [line.get_ydata().tolist() for line in axes.lines] == [[25.0, 110.0], [5.0, 7.0]]
    first, second = axes.lines
    assert first.get_color() != second.get_color()
    assert first.get_linestyle() != second.get_linestyle()
    assert first.get_marker() != second.get_marker()
    assert len(axes.collections) == 1
    assert labels_of(figure) == ["ours (2 seeds)", "theirs (1 seed)"]


def test_threshold_and_optimum_are_lines_with_their_numbers() -> None:
    axes = figures.learning_curves({"a": [run([0, 1], [0, 9])]}, 5.0, 159_490.0).axes[0]
    assert [set(line.get_ydata()) for line in axes.lines[1:]] == [{5.0}, {159_490.0}]
    shown = [text.get_text() for text in axes.texts]
    assert shown == ["threshold 5", "optimum 159,490"]


@pytest.mark.parametrize(("worst", "scale"), [(-300_000.0, "linear"), (-4e6, "symlog")])
def test_very_bad_returns_do_not_flatten_the_good_ones(worst: float, scale: str) -> None:
    seeds = [run([0, 1, 2], [worst, 0.0, 150_000.0])]
    axes = figures.learning_curves({"a": seeds}, None, 159_490.0).axes[0]
    assert axes.get_yscale() == scale
    bottom, top = axes.get_ylim()
    assert bottom < worst and top > 159_490.0
    low, zero, high = axes.transAxes.inverted().transform(
        axes.transData.transform([(0, bottom), (0, 0.0), (0, 159_490.0)])
    )[:, 1]
    assert high - zero > 0.25 * (high - low)


def test_returns_that_are_all_far_below_zero_are_told_apart() -> None:
    seeds = [run([0, 1, 2], [-30e6, -1e6, -2e5])]
    axes = figures.learning_curves({"a": seeds}).axes[0]
    assert axes.get_yscale() == "symlog"
    heights = axes.transAxes.inverted().transform(
        axes.transData.transform([(0, value) for value in (-30e6, -1e6, -2e5)])
    )[:, 1]
    assert 0.0 < heights[0] < heights[1] - 0.2 < heights[2] - 0.4 < 0.6
    ticks = axes.get_yticks().tolist()
    assert ticks == pytest.approx([-3e5, -1e6, -3e6, -1e7, -3e7])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({}, "no algorithm"),
        ({"a": []}, "a: there is no seed"),
        ({"a": [run([0, 1], [0, 1]), run([0, 1], [0])]}, r"a, seed 1: .*\(2,\) and \(1,\)"),
        ({"a": [run([], [])]}, r"a, seed 0: .*\(0,\)"),
        ({"a": [run([0, 1], [0, np.nan])]}, "a, seed 0: .*finite"),
        ({"a": [run([0, 0], [0, 1])]}, "a, seed 0: the steps have to increase"),
        ({"a": [run([0, 1], [0, 1]), run([2, 3], [0, 1])]}, "a: the seeds have no range"),
    ],
)
def test_curves_that_cannot_be_drawn_are_refused(wrong: Any, message: str) -> None:
    with pytest.raises(MbnError, match=message):
        figures.learning_curves(wrong)


# ---------------------------------------------------------------- comparisons and studies


def test_panels_have_common_axes_and_one_legend() -> None:
    panels = {
        "one": figures.Panel({"b": [run([0, 10], [0, 9])]}, 20.0),
        "two": figures.Panel({"a": [run([0, 30], [0, 5]), run([0, 30], [5, 5])]}, None),
        "three": figures.Panel({"b": [run([0, 10], [0, 9])]}, None),
    }
    figure = figures.learning_curve_panels(panels, ["a", "b", "c"], 10.0)
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert len({(axes.get_xlim(), axes.get_ylim()) for axes in shown}) == 1
    first, second, third = shown
    assert first.lines[0].get_color() == third.lines[0].get_color() != second.lines[0].get_color()
    assert [len(axes.collections) for axes in shown] == [0, 1, 0], "a band for two seeds"
    assert [len(axes.lines) for axes in shown] == [3, 2, 2], "curve, threshold, optimum"
    assert labels_of(figure) == ["a", "b", "threshold 10", "proved optimum"]
    with pytest.raises(MbnError, match="no curve"):
        figures.learning_curve_panels({"one": figures.Panel({}, None)}, [], 10.0)


def test_pairs_are_joined_and_missing_ones_say_so() -> None:
    panels = {
        "ppo": {"here": figures.Pair(1.0, 4.0), "there": figures.Pair(None, 2.0)},
        "ars": {"there": figures.Pair(3.0, 3.5)},
    }
    figure = figures.pairs(panels, ("A", "B"), 5.0)
    ppo, ars = figure.axes
    drawn = [line.get_xydata().tolist() for line in ppo.lines[:-1]]
    assert drawn == [[[1, 0], [4, 0]], [[1, 0]], [[4, 0]], [[2, 1]]]
    assert [text.get_text() for text in ppo.texts + ars.texts] == ["missing"]
    assert ars.texts[0].xy[1] == 0
    assert labels_of(figure) == ["A", "B", "threshold 5"]
    with pytest.raises(MbnError, match="no return"):
        figures.pairs({"ppo": {"here": figures.Pair(None, None)}}, ("A", "B"), 5.0)


def test_many_fields_are_drawn_whole_each_with_its_bar() -> None:
    small = Field([(0, 0), (40, 0), (40, 40), (0, 40)], [(20, 20)], [(5, 5)])
    figure = figures.fields_figure([FIELD, small])
    for axes, field, bar in zip(figure.axes, (FIELD, small), (50.0, 10.0), strict=True):
        (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        assert right - left == pytest.approx(top - bottom)
        for x, y in field.vertices:
            assert left < x < right and bottom < y < top
        lengths = [np.ptp(line.get_xdata()) for line in axes.lines if len(line.get_xdata()) == 2]
        assert lengths == pytest.approx([bar])
        assert axes.texts[-1].get_text() == f"{bar:g} units"
    with pytest.raises(MbnError, match="none to draw"):
        figures.fields_figure([])


def test_a_study_shows_its_best_so_far_and_what_was_pruned() -> None:
    values = [(0, 1.0, False), (1, 9.0, True), (2, 3.0, False), (3, 2.0, False)]
    trials = [figures.StudyTrial(*value) for value in values]
    figure = figures.study_figure(trials, {"gamma": 0.75, "learning_rate": 0.25}, "ppo")
    history, bars = figure.axes
    best, finished, pruned = (line.get_xydata().tolist() for line in history.lines)
    assert best == [[0, 1], [2, 3], [3, 3]]
    assert finished == [[0, 1], [2, 3], [3, 2]]
    assert pruned == [[1, 9]]
    assert [bar.get_width() for bar in bars.patches] == [0.75, 0.25]
    unknown = figures.study_figure(trials, {}, "ppo").axes[1]
    assert "too few" in unknown.texts[0].get_text()
    with pytest.raises(MbnError, match="no trial"):
        figures.study_figure([], {}, "ppo")


def test_estimates_are_marked_within_their_intervals() -> None:
    panels = {
        "mean": {"ppo": (0.5, 0.25, 0.75), "mappo": (0.9, None, None)},
        "gap": {"ppo": (0.1, 0.0, 0.2), "mappo": (0.2, 0.1, 0.3)},
    }
    figure = figures.intervals_figure(panels, rule=0.5)
    mean, gap = figure.axes
    assert [label.get_text() for label in mean.get_yticklabels()] == ["ppo", "mappo"]
    rule, *values = (line.get_xydata().tolist() for line in mean.lines)
    assert [x for x, _ in rule] == [0.5, 0.5]
    assert values == [[[0.5, 0]], [[0.9, 1]]]
    (interval,) = mean.collections
    assert interval.get_segments()[0].tolist() == [[0.25, 0], [0.75, 0]]
    assert len(gap.collections) == 2
    with pytest.raises(MbnError, match="nothing to draw"):
        figures.intervals_figure({"mean": {}})


def test_profiles_are_drawn_whole_and_near_the_end() -> None:
    thresholds = np.array([0.0, 0.5, 0.95, 1.0])
    share = np.array([1.0, 0.5, 0.25, 0.0])
    profiles = {"ppo": (share, share - 0.1, share + 0.1), "mappo": (share, share, share)}
    figure = figures.profiles_figure(profiles, thresholds, "score")
    whole, end = figure.axes
    assert (whole.get_xlim(), end.get_xlim()) == ((0.0, 1.0), (0.9, 1.0))
    for axes in (whole, end):
        assert axes.lines[0].get_xydata().tolist() == list(
            map(list, zip(thresholds, share, strict=True))
        )
        assert len(axes.collections) == 2
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["ppo", "mappo"]
    with pytest.raises(MbnError, match="nothing to draw"):
        figures.profiles_figure({}, thresholds, "score")


# ---------------------------------------------------------------- files and the look


@pytest.mark.parametrize(
    ("name", "start"), [("a.png", b"\x89PNG"), ("a.PDF", b"%PDF"), ("a.svg", b"<?xml")]
)
def test_a_figure_is_saved_in_the_format_of_its_name(
    name: str, start: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "new" / name
    assert figures.save(figures.field_figure(FIELD), path) == path
    assert path.read_bytes().startswith(start)
    assert list(path.parent.iterdir()) == [path], "no temporary file is left"


def test_learning_curves_are_saved_where_asked(tmp_path: Path) -> None:
    path = tmp_path / "curves.png"
    figures.learning_curves({"a": [run([0, 1], [0, 9])]}, path=path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_an_unknown_format_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(MbnError, match=r"a\.bmp: .*\.png, \.pdf, \.svg"):
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


def test_colours_are_named_in_one_place() -> None:
    folder = Path(style.__file__).parent
    named = re.compile(r"#[0-9A-Fa-f]{6}\b")
    with_colours = {file.name for file in folder.glob("*.py") if named.search(file.read_text())}
    assert with_colours == {"style.py"}


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
    assert len(set(looks[:24])) == 24
