"""Learning curves, comparisons and studies: what their figures show, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mbn_marl.errors import MbnError
from mbn_marl.render import style

pytest.importorskip("matplotlib", reason="needs the extra [render]")

from matplotlib.figure import Figure

from mbn_marl.render import curves, estimates


def labels_of(figure: Figure) -> list[str]:
    """The labels of the figure's legend."""
    return [text.get_text() for text in figure.legends[0].get_texts()]


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
    figure = curves.learning_curves({"ours": several, "theirs": [run([0, 10], [5, 7])]})
    axes = figure.axes[0]
    assert [line.get_ydata().tolist() for line in axes.lines] == [[25.0, 110.0], [5.0, 7.0]]
    first, second = axes.lines
    assert first.get_color() != second.get_color()
    assert first.get_linestyle() != second.get_linestyle()
    assert first.get_marker() != second.get_marker()
    assert len(axes.collections) == 1
    assert labels_of(figure) == ["ours (2 seeds)", "theirs (1 seed)"]


def test_a_look_is_the_algorithms_own() -> None:
    both = {"ours": [run([0, 10], [0, 9])], "theirs": [run([0, 10], [5, 7])]}
    axes = curves.learning_curves(both, looks={"theirs": 0, "ours": 3}).axes[0]
    assert [line.get_color() for line in axes.lines] == [style.series(k).colour for k in (3, 0)]


def test_threshold_and_optimum_are_lines_with_their_numbers() -> None:
    axes = curves.learning_curves({"a": [run([0, 1], [0, 9])]}, 5.0, 159_490.0).axes[0]
    assert [set(line.get_ydata()) for line in axes.lines[1:]] == [{5.0}, {159_490.0}]
    shown = [text.get_text() for text in axes.texts]
    assert shown == ["threshold 5", "optimum 159,490"]


@pytest.mark.parametrize(("worst", "scale"), [(-300_000.0, "linear"), (-4e6, "symlog")])
def test_very_bad_returns_do_not_flatten_the_good_ones(worst: float, scale: str) -> None:
    seeds = [run([0, 1, 2], [worst, 0.0, 150_000.0])]
    axes = curves.learning_curves({"a": seeds}, None, 159_490.0).axes[0]
    assert axes.get_yscale() == scale
    assert ("logarithmic below \N{MINUS SIGN}159 k" in axes.get_ylabel()) == (scale == "symlog")
    bottom, top = axes.get_ylim()
    assert bottom < worst and top > 159_490.0
    low, zero, high = axes.transAxes.inverted().transform(
        axes.transData.transform([(0, bottom), (0, 0.0), (0, 159_490.0)])
    )[:, 1]
    assert high - zero > 0.25 * (high - low)


def test_returns_that_are_all_far_below_zero_are_told_apart() -> None:
    seeds = [run([0, 1, 2], [-30e6, -1e6, -2e5])]
    axes = curves.learning_curves({"a": seeds}).axes[0]
    assert axes.get_yscale() == "symlog"
    heights = axes.transAxes.inverted().transform(
        axes.transData.transform([(0, value) for value in (-30e6, -1e6, -2e5)])
    )[:, 1]
    assert 0.0 < heights[0] < heights[1] - 0.2 < heights[2] - 0.4 < 0.6
    ticks = axes.get_yticks().tolist()
    assert ticks == pytest.approx([-3e5, -1e6, -3e6, -1e7, -3e7])


def test_returns_up_to_zero_are_drawn() -> None:
    axes = curves.learning_curves({"a": [run([0, 1], [-5e6, 0.0])]}).axes[0]
    assert axes.get_yscale() == "symlog" and axes.get_ylim()[1] > 0.0


def test_curves_that_cannot_be_drawn_are_refused() -> None:
    cases: list[tuple[Any, str]] = [
        ({}, "no algorithm"),
        ({"a": []}, "a: "),
        ({"a": [run([0, 1], [0, 1]), run([0, 1], [0])]}, "a, seed 1: "),
        ({"a": [run([], [])]}, "a, seed 0: "),
        ({"a": [run([0, 1], [0, np.nan])]}, "a, seed 0: "),
        ({"a": [run([0, 0], [0, 1])]}, "a, seed 0: "),
        ({"a": [run([0, 1], [0, 1]), run([2, 3], [0, 1])]}, "a: "),
    ]
    for wrong, place in cases:
        with pytest.raises(MbnError, match=place):
            curves.learning_curves(wrong)
    for call in (
        lambda: curves.learning_curve_panels({"one": curves.Panel({}, None)}, {}, 10.0),
        lambda: curves.pairs({"ppo": {"here": curves.Pair(None, None)}}, ("A", "B"), 5.0),
        lambda: estimates.intervals_figure({"mean": {}}),
        lambda: estimates.profiles_figure({}, np.array([0.0, 1.0]), "score", {}),
    ):
        with pytest.raises(MbnError):
            call()


def test_panels_have_common_axes_and_one_legend() -> None:
    panels = {
        "one": curves.Panel({"b": [run([0, 10], [0, 9])]}, 20.0),
        "two": curves.Panel({"a": [run([0, 30], [0, 5]), run([0, 30], [5, 5])]}, None),
        "three": curves.Panel({"b": [run([0, 10], [0, 9])]}, None),
    }
    figure = curves.learning_curve_panels(panels, {"a": 3, "b": 5, "c": 7}, 10.0)
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert len({(axes.get_xlim(), axes.get_ylim()) for axes in shown}) == 1
    first, second, third = shown
    assert first.lines[0].get_color() == third.lines[0].get_color() != second.lines[0].get_color()
    assert [len(axes.collections) for axes in shown] == [0, 1, 0], "a band for two seeds"
    assert [len(axes.lines) for axes in shown] == [3, 2, 2], "curve, threshold, optimum"
    assert labels_of(figure) == ["a", "b", "threshold 10", "proved optimum"]


def test_pairs_are_joined_and_missing_ones_say_so() -> None:
    panels = {
        "ppo": {"here": curves.Pair(1.0, 4.0), "there": curves.Pair(None, 2.0)},
        "ars": {"there": curves.Pair(3.0, 3.5)},
    }
    figure = curves.pairs(panels, ("A", "B"), 5.0)
    ppo, ars = figure.axes
    drawn = [line.get_xydata().tolist() for line in ppo.lines[:-1]]
    assert drawn == [[[1, 0], [4, 0]], [[1, 0]], [[4, 0]], [[2, 1]]]
    assert [text.get_text() for text in ppo.texts + ars.texts] == ["missing"]
    assert ars.texts[0].xy[1] == 0
    assert labels_of(figure) == ["A", "B", "threshold 5"]


def test_estimates_are_marked_within_their_intervals() -> None:
    panels = {
        "mean": {"ppo": (0.5, 0.25, 0.75), "mappo": (0.9, None, None)},
        "gap": {"ppo": (0.1, 0.0, 0.2), "mappo": (0.2, 0.1, 0.3)},
    }
    figure = estimates.intervals_figure(panels)
    mean, gap = figure.axes
    assert [label.get_text() for label in mean.get_yticklabels()] == ["ppo", "mappo"]
    assert [line.get_xydata().tolist() for line in mean.lines] == [[[0.5, 0]], [[0.9, 1]]]
    (interval,) = mean.collections
    assert interval.get_segments()[0].tolist() == [[0.25, 0], [0.75, 0]]
    assert len(gap.collections) == 2


def test_the_axis_of_a_probability_spans_all_of_it_with_a_line_at_one_half() -> None:
    chances = {"ppo > mappo": (0.52, 0.51, 0.53), "ppo > ippo": (0.5, None, None)}
    (axes,) = estimates.chances_figure(chances, "probability").axes
    assert axes.get_xlim() == (0.0, 1.0)
    formatter = axes.xaxis.get_major_formatter()
    assert [formatter(tick) for tick in axes.get_xticks()] == ["0%", "25%", "50%", "75%", "100%"]
    (line,) = [line for line in axes.lines if len(line.get_xdata()) == 2]
    assert list(line.get_xdata()) == [0.5, 0.5]


def test_profiles_begin_where_the_first_falls() -> None:
    thresholds = np.array([0.0, 0.5, 0.9, 0.99, 1.0])
    share = np.array([1.0, 1.0, 0.5, 0.25, 0.0])
    profiles = {"ppo": (share, share - 0.1, share + 0.1), "mappo": (share, share, share)}
    looks = {"ppo": 4, "mappo": 1}
    figure = estimates.profiles_figure(profiles, thresholds, "score", looks)
    (axes,) = figure.axes
    np.testing.assert_allclose(axes.get_xlim(), (0.5, 0.01))
    labels = [text.get_text() for text in axes.get_xticklabels()]
    assert labels == ["50%", "80%", "90%", "95%", "98%", "99%"]
    for line, look in ((axes.lines[0], style.series(4)), (axes.lines[3], style.series(1))):
        np.testing.assert_allclose(line.get_xdata(), 1.0 - thresholds[:-1])
        assert list(line.get_ydata()) == list(share[:-1])
        assert (line.get_color(), line.get_linestyle()) == (look.colour, look.dash)
    assert len(axes.collections) == 2
    assert labels_of(figure) == ["ppo", "mappo"]
    nothing = dict.fromkeys(profiles, (np.zeros(5),) * 3)
    assert (
        estimates.profiles_figure(nothing, thresholds, "score", looks).axes[0].get_xlim()[0] == 1.0
    )
