"""Random numbers, gusts, and the features that a configuration leaves out."""

import math
from statistics import NormalDist

import numpy as np
import pytest

from mbn_marl import Failures, Field
from mbn_marl.config import make_config
from mbn_marl.errors import ConfigError
from mbn_marl.jit import functions, random_numbers
from mbn_marl.optimum import optimal_return
from mbn_marl.planning.problem import make_problem
from tests.support import disturbances as expected
from tests.support.problems import places_of

SQUARE = Field(
    vertices=[(0.0, 0.0), (400.0, 0.0), (400.0, 400.0), (0.0, 400.0)],
    rois=[(390.0, 390.0)],
    starts=[(200.0, 200.0), (200.0, 150.0)],
    optimal_makespan=20,
)


def test_random_numbers_are_those_of_the_page():
    for place in [(0, 0, 0), (2**63 - 1, 5, 7), (3, 2**40, 1)]:
        key = random_numbers.stream_key(*place, random_numbers.FOR_GUSTS)
        assert key == expected.key_of(*place, expected.GUSTS)
        for counter in (0, 1, 2**33):
            found = random_numbers.normal(np.uint64(key), counter)
            assert found == expected.normal(key, counter)


def test_normal_numbers_are_normal():
    key = expected.key_of(1, 2, 3, 4)
    found = np.sort([float(expected.normal(key, counter)) for counter in range(20_000)])
    assert abs(found.mean()) < 0.02 and abs(found.var() - 1.0) < 0.03
    share = np.arange(len(found)) / len(found)
    assert np.abs([NormalDist().cdf(x) for x in found] - share).max() < 0.011


def test_elementary_functions():
    for x in np.linspace(-40.0, 0.0, 1001).tolist():
        assert functions.exponential(x) == pytest.approx(math.exp(x), rel=3e-14)
    assert functions.exponential(0.0) == 1.0
    assert functions.exponential(-1e9) == functions.exponential(-40.0) < 1e-17
    angles = np.linspace(-math.pi, math.pi, 4001)
    for angle in angles.tolist():
        assert functions.sine(angle) == pytest.approx(math.sin(angle), abs=4e-16)
        assert functions.cosine(angle) == pytest.approx(math.cos(angle), abs=4e-16)
        assert -1.0 <= functions.sine(angle) <= 1.0
    for angle in angles[abs(angles) <= 1.5].tolist():
        assert functions.tangent(angle) == pytest.approx(math.tan(angle), rel=1e-14, abs=1e-15)
    assert (functions.sine(0.0), functions.cosine(0.0), functions.tangent(0.0)) == (0, 1, 0)


@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_headings_stay_in_half_a_turn_either_way(real):
    pi = real(math.pi)
    for heading, turn, found in [(3.0, 0.5, 3.5 - 2 * math.pi), (-3.0, -0.5, 2 * math.pi - 3.5)]:
        assert functions.turned(real(heading), real(turn), pi) == pytest.approx(found, abs=1e-6)
    assert functions.turned(pi, real(0.0), pi) == functions.turned(-pi, real(0.0), pi) == -pi
    below = np.nextafter(pi, real(0.0))
    assert functions.turned(below, real(0.0), pi) in (below, -pi)  # apart by a rounding of 2 pi
    for turn in (20.0, 1e30, -1e30, math.inf):
        assert -pi <= functions.turned(real(0.0), real(turn), pi) < pi


@pytest.mark.parametrize(
    "settings",
    [
        *({"dynamics": name} for name in ("holonomic", "unicycle", ("point_mass", "bicycle"))),
        {"failures": Failures()},
        {"gust": 0.15, "action_delay": 1},
    ],
)
def test_plan_and_optimum_are_for_undisturbed_point_masses(settings):
    assert optimal_return(SQUARE) is not None
    config = make_config(settings)
    assert optimal_return(SQUARE, config) is None
    assert {*places_of(ConfigError, make_problem, SQUARE, config)} == settings.keys()


def test_plan_takes_limits_of_each_robot_and_replanning_takes_gusts():
    problem = make_problem(SQUARE, make_config({"f_max": (1.0, 2.0), "v_clip": (3.0, 4.0)}))
    assert problem.forces.tolist() == [[1.0, 1.0], [2.0, 2.0]]
    assert [drive.top for drive in problem.drives] == [3.0, 4.0]
    assert make_problem(SQUARE, make_config({"gust": 0.15}), closed_loop=True).n == 2
