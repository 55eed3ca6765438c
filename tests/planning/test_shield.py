"""The braking test with numbers worked out by hand: the force changes a velocity by 0.5 a step."""

from itertools import product
from typing import Any

import numpy as np
import pytest

from mbn_marl import Field
from mbn_marl.config import Failures, make_config
from mbn_marl.planning.problem import make_problem
from mbn_marl.planning.shield import Shield

SQUARE = ((100, 100), (300, 100), (300, 300), (100, 300))
REST = np.zeros((2, 2))


def shield(robots: int, **settings: Any) -> Shield:
    """The shield of a team in a square."""
    starts = [(120 + 30 * robot, 150) for robot in range(robots)]
    field = Field(SQUARE, [(290, 290)], starts)
    return Shield(make_problem(field, make_config(settings), closed_loop=True))


def test_an_action_passes_if_the_robot_can_still_stop_at_the_wall():
    cases = (
        (0.0, 5.1, True),  # at 2 units a step, then 1.5, 1, 0.5, 0: 5 in all
        (0.0, 5.0005, False),  # which float32 might round to the other side
        (0.0, 4.9, False),
        (1.0, 7.6, True),  # 2.5, then 2, 1.5, 1, 0.5, 0: 7.5
        (7.0, 7.6, True),  # which counts as 1
        (1.0, 7.4, False),
        (-0.2, 5.1, True),
    )
    for (action, room, passes), dtype in product(cases, (np.float32, np.float64)):
        actions = np.array([[action, 0.3]], dtype)
        place, speed = np.array([[300.0 - room, 200.0]]), np.array([[2.0, 0.0]])
        taken = shield(1).act(actions, place, speed)
        assert taken.dtype == dtype
        assert np.array_equal(taken, actions) == passes, (action, room, dtype)
        velocity, stop = 2.0 + 0.5 * float(np.clip(taken[0, 0], -1, 1)), 0.0
        while velocity > 0.0:
            stop, velocity = stop + velocity, velocity - 0.5
        assert stop < room, (action, room, dtype)


def test_the_last_step_shows_the_wind():
    push = np.array([[1.0, 0.0]])
    for room, passes in ((7.1, True), (6.9, False)):  # 1.75, 1.5, 1.25 .. 0.25: 7 in all
        windy = shield(1)
        assert np.array_equal(windy.act(push, np.array([[200.0, 200.0]]), REST[:1] + 0.25), push)
        place, speed = np.array([[300.0 - room, 200.0]]), np.array([[1.0, 0.5]])  # 0.5 + 0.25 more
        assert np.array_equal(windy.act(push, place, speed), push) == passes


def test_a_limit_that_float32_rounds_down_shows_no_wind():
    top = np.float32(2.1)
    assert float(top) < 2.1
    calm = shield(1, v_clip=2.1)
    for speed in (0.0, top):  # the second step's push has no effect
        calm.act(np.array([[1.0, 0.0]]), np.array([[150.0, 200.0]]), np.array([[speed, 0.0]]))
    assert not calm.weather.push.any() and not calm.weather.gusty


def test_wind_that_an_axis_at_its_limit_hid_is_no_gust():
    windy = shield(1, v_clip=0.5)
    for x, y, action in ((0.0, 0.0, 1.0), (0.5, 0.1, -0.8), (0.2, 0.2, 0.0)):  # 0.1 a step
        windy.act(np.array([[action, 0.0]]), REST[:1] + 200.0, np.array([[x, y]]))
    assert windy.weather.push == pytest.approx([0.1, 0.1]) and not windy.weather.gusty


def test_robots_decide_in_index_order():
    """A full force brings a robot 0.5 nearer and no further; 10.1 have to stay between them.

    With 10.8, robot 1 finds 10.3 left: half the velocity leaves 10.05, a quarter 10.175.
    """
    for gap, one, other in ((11.2, 1.0, -1.0), (10.8, 1.0, -0.25), (10.5, 0.5, -0.25)):
        places = np.array([[200.0, 200.0], [200.0 + gap, 200.0]])
        found = shield(2).act(np.array([[1.0, 0.0], [-1.0, 0.0]]), places, REST)
        np.testing.assert_allclose(found, [[one, 0.0], [other, 0.0]], atol=1e-12)


def test_robots_that_have_failed_are_kept_away_from_and_left_alone():
    coasting = shield(2, failures=Failures(at={1: 5}, kind="coast"))
    places = np.array([[200.0, 200.0], [220.0, 200.0]])
    speeds, failed = np.array([[0.0, 0.0], [-1.0, 0.0]]), np.array([False, True])
    actions = np.array([[0.0, 0.0], [1.0, 1.0]])
    taken = coasting.act(actions, places, speeds, failed)
    assert np.array_equal(taken[1], actions[1])
    assert taken[0].any(), "to rest would be to be run over"
    gone = shield(2, failures=Failures(at={1: 5}, kind="vanish"))
    assert np.array_equal(gone.act(actions, places, REST, failed), actions)


def test_robots_are_foreseen_until_they_rest_or_the_episode_ends():
    guard = shield(1)
    guard.problem = guard.problem.in_wind(np.array([0.45, 0.0]))  # leaves 0.05 of 0.5 to brake with
    for start, room in ((140.0, np.inf), (145.0, -1.0)):  # it needs 158 of 160 or 155 units
        path = guard._coast(0, np.array([start, 150.0]), np.array([4.0, 0.0]))
        assert len(path) >= 80 and path[-1, 0] == pytest.approx(start + 0.05 * 79 * 80 / 2)
        assert guard._room(path, []) == room
        assert guard._room(path[:60], []) == np.inf, "it leaves the field later"
