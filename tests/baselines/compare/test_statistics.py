"""The statistics of comparisons, by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray

from baselines.compare import curves
from baselines.compare import summary as stratified
from baselines.compare.curves import Panel
from baselines.compare.summary import Estimate
from mbn_marl.errors import MbnError
from mbn_marl.render import style


def test_the_interquartile_mean_cuts_a_quarter_at_both_ends() -> None:
    # Eight runs: two go at each end, and 1, 2, 3, 4 stay. Of five runs one goes at each end.
    scores = np.array([[0.0, 100.0, 3.0, 9.0], [1.0, 4.0, 2.0, -50.0]])
    assert stratified.interquartile_mean(scores).value == np.mean([1.0, 2.0, 3.0, 4.0])
    assert stratified.interquartile_mean(np.array([[9.0, 1.0, 2.0, 3.0, 70.0]])).value == 14.0 / 3.0


def test_a_resample_stays_within_each_field() -> None:
    # Fields far apart, their runs equal: whatever is drawn, the mean is the same. Runs drawn
    # across fields would give means from 0 to 1.
    scores = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    assert stratified.optimality_gap(scores) == Estimate(0.5, 0.5, 0.5)


def test_an_interval_by_hand() -> None:
    # One field with runs 0 and 1: a resample's gap is 1, 0.5 or 0 with probability 1/4, 1/2, 1/4.
    assert stratified.optimality_gap(np.array([[0.0, 1.0]])) == Estimate(0.5, 0.0, 1.0)
    # Two such fields: the mean of two, 0 and 1 with 1/16 each, more than 2.5 %.
    assert stratified.optimality_gap(np.array([[0.0, 1.0]] * 2)) == Estimate(0.5, 0.0, 1.0)
    # Three: 0 and 1 with 1/64 each, less than 2.5 %; 1/6 and less with 1/64 + 6/64.
    low, high = stratified.optimality_gap(np.array([[0.0, 1.0]] * 3))[1:]
    assert (low, high) == pytest.approx((1 / 6, 5 / 6))


def test_one_seed_has_no_interval() -> None:
    scores = np.array([[0.2], [0.4]])
    assert stratified.interquartile_mean(scores) == pytest.approx((0.3, None, None))
    assert stratified.probability_of_improvement(scores, scores) == Estimate(0.5, None, None)
    assert stratified.performance_profile(scores, np.array([0.3])).share.tolist() == [0.5]


def test_the_probability_of_improvement_compares_within_each_field() -> None:
    # Field 0: ours win 3 of 4 pairs and tie the other; field 1: they lose all.
    ours, theirs = np.array([[2.0, 5.0], [10.0, 10.0]]), np.array([[1.0, 2.0], [99.0, 99.0]])
    value, low, high = stratified.probability_of_improvement(ours, theirs)
    assert value == (3.5 / 4 + 0.0) / 2
    # The most that can be drawn is a win of all pairs of field 0: 1/2. The least is (2, 2)
    # against (2, 2), probability 1/16, which ties: 1/4.
    assert (low, high) == (0.25, 0.5)
    back = stratified.probability_of_improvement(theirs, ours)
    assert back.value == 1.0 - value


def test_the_performance_profile_counts_runs_above() -> None:
    scores = np.array([[0.0, 0.5], [0.5, 1.0]])
    profile = stratified.performance_profile(scores, np.array([-1.0, 0.0, 0.5, 0.9, 1.0]))
    assert profile.share.tolist() == [1.0, 0.75, 0.25, 0.25, 0.0]
    # Above 0.9: the second field's runs are drawn 0.5 twice, once, or never, 1/4, 1/2, 1/4.
    assert (profile.low[3], profile.high[3]) == (0.0, 0.5)
    assert (profile.low[0], profile.high[0]) == (1.0, 1.0)


def labels_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def run(steps: Any, returns: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.array(steps, np.float64), np.array(returns, np.float64)


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
