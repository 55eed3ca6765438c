"""The statistics of comparisons, by hand."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from baselines.compare import curves
from baselines.compare import summary as stratified


def test_the_interquartile_mean_cuts_a_quarter_at_both_ends():
    # Eight runs: two go at each end, and 1, 2, 3, 4 stay. Of five runs one goes at each end.
    scores = np.array([[0.0, 100.0, 3.0, 9.0], [1.0, 4.0, 2.0, -50.0]])
    assert stratified.interquartile_mean(scores).mean == np.mean([1.0, 2.0, 3.0, 4.0])
    assert stratified.interquartile_mean(np.array([[9.0, 1.0, 2.0, 3.0, 70.0]])).mean == 14.0 / 3.0


def test_the_worst_tenth_is_of_one_run_at_least():
    scores = np.arange(30.0)
    assert stratified.worst_tenth(scores.reshape(3, 10)) == 1.0
    assert stratified.worst_tenth(scores[:9].reshape(3, 3)) == 0.0


@pytest.mark.parametrize(
    "scores, value, low, high",
    [
        # Fields far apart, their runs equal: a resample stays within each field.
        ([[0.0] * 3, [1.0] * 3], 0.5, 0.5, 0.5),
        # One field with runs 0 and 1: the mean is 0, 0.5 or 1 with probability 1/4, 1/2, 1/4.
        ([[0.0, 1.0]], 0.5, 0.0, 1.0),
        # Two: 0 and 1 with 1/16 each, more than 2.5 %. Three: less, and 1/6 or less with 7/64.
        ([[0.0, 1.0]] * 2, 0.5, 0.0, 1.0),
        ([[0.0, 1.0]] * 3, 0.5, 1 / 6, 5 / 6),
        ([[0.25]], 0.25, None, None),
    ],
)
def test_an_interval_by_hand(scores, value, low, high):
    ours = np.array(scores)
    found = stratified.difference(ours, np.zeros_like(ours))
    assert found == (value, *(end if end is None else pytest.approx(end) for end in (low, high)))


@pytest.mark.parametrize(
    "ours, theirs, p_value",
    [
        ([[0.0, 0.0]], [[1.0, 1.0]], 2 / 6),  # two of the six ways to share four runs
        ([[0.0], [10.0]], [[1.0], [11.0]], 2 / 4),  # exchanged within fields only
        ([[1.0, 2.0]], [[2.0, 1.0]], 1.0),
    ],
)
def test_labels_are_permuted_within_fields(ours, theirs, p_value):
    found = stratified.permutation_test(np.array(ours), np.array(theirs))
    assert found == pytest.approx(p_value, abs=0.02)


def test_corrections_and_power_by_hand():
    assert stratified.holm([0.01, 0.04, 0.03, 0.9]) == pytest.approx([0.04, 0.09, 0.09, 0.9])
    # The variance of 0, 1 and 2 is 1, that of their mean 1/3, of the mean of two such fields 1/6.
    some = np.array([[0.0, 1.0, 2.0]] * 2)
    # Quantiles of Student's t with 8 degrees of freedom: of 97.5, 99.5 and 80 %.
    for family, quantile in ((1, 2.306), (5, 3.355)):
        shown = stratified.detectable(some, np.zeros((2, 3)), family)
        assert shown == pytest.approx((quantile + 0.889) * np.sqrt(1 / 6), abs=1e-3)
    # The least p-value of two fields is 2/400 with three seeds, 2/36 with two, 2/4 with one.
    assert stratified.detectable(some, np.zeros((2, 3)), family=10) is None
    for seeds in (1, 2):
        assert stratified.detectable(some[:, :seeds], np.zeros((2, seeds))) is None


def run(steps: Any, returns: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.array(steps, np.float64), np.array(returns, np.float64)


def test_mean_and_band_by_hand():
    # The bootstrap means of two seeds are low, half, high with odds 1/4, 1/2, 1/4.
    seeds = [run([0, 10, 20], [0, 10, 0]), run([5, 15, 30], [20, 30, 30])]
    steps, mean, low, high = curves.mean_and_band(seeds)
    assert steps.tolist() == [5.0, 10.0, 15.0, 20.0]
    assert mean.tolist() == [12.5, 17.5, 17.5, 15.0]
    assert low.tolist() == [5.0, 10.0, 5.0, 0.0]
    assert high.tolist() == [20.0, 25.0, 30.0, 30.0]
    apart = curves.mean_and_band([run([0, 1], [0, 4]), run([2, 3], [2, 1])])
    assert [end.tolist() for end in apart] == [[2.0], [3.0], [2.0], [4.0]]
