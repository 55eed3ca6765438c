"""What the figures of comparisons show."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from baselines.compare import curves
from baselines.compare.curves import Pair, Panel
from baselines.compare.summary import Estimate, Profile
from mbn_marl.errors import MbnError
from mbn_marl.render import style


def labels_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def run(steps: Any, returns: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The curve of one seed."""
    return np.array(steps, np.float64), np.array(returns, np.float64)


def drawn(seeds: Any, optimum: float | None = None) -> Any:
    """The axes of a figure of one label."""
    return curves.learning_curves({"x": Panel({"a": seeds}, optimum)}, {"a": 0}, "return", 5.0)


def test_mean_and_band_by_hand() -> None:
    # The bootstrap means of two seeds are low, half, high with odds 1/4, 1/2, 1/4.
    seeds = [run([0, 10, 20], [0, 10, 0]), run([5, 15, 30], [20, 30, 30])]
    steps, mean, low, high = curves.mean_and_band("a", seeds)
    assert steps.tolist() == [5.0, 10.0, 15.0, 20.0]
    assert mean.tolist() == [12.5, 17.5, 17.5, 15.0]
    assert low.tolist() == [5.0, 10.0, 5.0, 0.0]
    assert high.tolist() == [20.0, 25.0, 30.0, 30.0]
    with pytest.raises(MbnError, match="a: "):
        curves.mean_and_band("a", [run([0, 1], [0, 1]), run([2, 3], [0, 1])])


def test_band_is_the_bootstrap_of_scipy() -> None:
    values = np.array([100.0, 130.0, 90.0, 250.0, 120.0])
    _, _, low, high = curves.mean_and_band("a", [run([0], [value]) for value in values])
    expected = stats.bootstrap(
        (values,), np.mean, n_resamples=10_000, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    assert (low[0], high[0]) == pytest.approx((expected.low, expected.high))


@pytest.mark.parametrize(
    ("returns", "scale"), [([-3e5, 0.0, 150_000.0], "linear"), ([-4e6, 0.0, 150_000.0], "symlog")]
)
def test_very_bad_returns_do_not_flatten_the_good_ones(returns: list[float], scale: str) -> None:
    figure = drawn([run([0, 1, 2], returns)], 159_490.0)
    (axes,) = figure.axes
    assert axes.get_yscale() == scale
    note = "logarithmic below \N{MINUS SIGN}159 k" in figure.get_supylabel()
    assert note == (scale == "symlog")
    bottom, top = axes.get_ylim()
    assert bottom < returns[0] and top > 159_490.0
    low, zero, high = axes.transAxes.inverted().transform(
        axes.transData.transform([(0, bottom), (0, 0.0), (0, 159_490.0)])
    )[:, 1]
    assert high - zero > 0.25 * (high - low)


def test_panels_have_common_axes_and_one_legend() -> None:
    panels = {
        "one": Panel({"b": [run([0, 10], [0, 9])]}, 20.0),
        "two": Panel({"a": [run([0, 30], [0, 5]), run([0, 30], [5, 5])]}, None),
        "three": Panel({"b": [run([0, 10], [0, 9])]}, None),
    }
    figure = curves.learning_curves(panels, {"a": 3, "b": 5, "c": 7}, "return", 10.0)
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert len({(axes.get_xlim(), axes.get_ylim()) for axes in shown}) == 1
    first, second, third = shown
    assert first.lines[0].get_color() == third.lines[0].get_color() == style.series(5).colour
    assert second.lines[0].get_color() == style.series(3).colour
    assert [len(axes.collections) for axes in shown] == [0, 1, 0], "a band for two seeds"
    assert [len(axes.lines) for axes in shown] == [3, 2, 2], "curve, threshold, optimum"
    assert second.lines[0].get_ydata().tolist() == [2.5, 5.0]
    assert labels_of(figure) == ["a", "b", "threshold 10", "proved optimum"]


def test_pairs_are_joined_and_missing_ones_say_so() -> None:
    panels = {
        "ppo": {"here": Pair(1.0, 4.0), "there": Pair(None, 2.0)},
        "ars": {"there": Pair(3.0, 3.5)},
    }
    figure = curves.pairs(panels, ("A", "B"), 5.0)
    ppo, ars = figure.axes
    points = [line.get_xydata().tolist() for line in ppo.lines[:-1]]
    assert points == [[[1, 0], [4, 0]], [[1, 0]], [[4, 0]], [[2, 1]]]
    assert [text.get_text() for text in ppo.texts + ars.texts] == ["missing"]
    assert ars.texts[0].xy[1] == 0
    assert labels_of(figure) == ["A", "B", "threshold 5"]


def test_estimates_are_marked_within_their_intervals() -> None:
    panels = {
        "mean": {"ppo": Estimate(0.5, 0.25, 0.75), "mappo": Estimate(0.9, None, None)},
        "gap": {"ppo": Estimate(0.1, 0.0, 0.2), "mappo": Estimate(0.2, 0.1, 0.3)},
    }
    mean, gap = curves.intervals_figure(panels).axes
    assert [label.get_text() for label in mean.get_yticklabels()] == ["ppo", "mappo"]
    assert [line.get_xydata().tolist() for line in mean.lines] == [[[0.5, 0]], [[0.9, 1]]]
    (interval,) = mean.collections
    assert interval.get_segments()[0].tolist() == [[0.25, 0], [0.75, 0]]
    assert len(gap.collections) == 2


def test_profiles_begin_where_the_first_falls() -> None:
    thresholds = np.array([0.0, 0.5, 0.9, 0.99, 1.0])
    share = np.array([1.0, 1.0, 0.5, 0.25, 0.0])
    profiles = {
        "ppo": Profile(share, share - 0.1, share + 0.1),
        "mappo": Profile(share, share, share),
    }
    looks = {"ppo": 4, "mappo": 1}
    figure = curves.profiles_figure(profiles, thresholds, looks)
    (axes,) = figure.axes
    np.testing.assert_allclose(axes.get_xlim(), (0.5, 0.01))
    labels = [text.get_text() for text in axes.get_xticklabels()]
    assert labels == ["50%", "80%", "90%", "95%", "98%", "99%"]
    for line, look in ((axes.lines[0], style.series(4)), (axes.lines[3], style.series(1))):
        np.testing.assert_allclose(line.get_xdata(), 1.0 - thresholds[:-1])
        assert list(line.get_ydata()) == list(share[:-1])
        assert (line.get_color(), line.get_linestyle()) == (look.colour, look.dash)
    nothing = Profile(*[np.zeros(5)] * 3)
    figure = curves.profiles_figure(dict.fromkeys(looks, nothing), thresholds, looks)
    assert figure.axes[0].get_xlim()[0] == 1.0
