"""The foresight of controllers, and plans round robots in the way."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from mbn_marl import BatchEngine, Uniform
from mbn_marl.config import Failures, NavigationConfig, make_config
from mbn_marl.field import Field, load_field
from mbn_marl.planning.problem import make_problem
from mbn_marl.planning.replanning import search
from mbn_marl.planning.roadmap import make_roadmap
from mbn_marl.planning.shield import Weather, ways_of_failed
from tests.support.planning_cases import SQUARE

ALL = np.ones(3, bool)
STILL = np.zeros((3, 2))


def test_a_controller_counts_on_the_middle_of_what_is_drawn():
    drawn = make_config({"mass": Uniform(1.0, 3.0), "tau": Uniform(0.5, 1.5)})
    known = make_config({"mass": 2.0, "tau": 1.0})
    field = load_field("field_03")
    forces = make_problem(field, drawn, closed_loop=True).forces
    np.testing.assert_array_equal(forces, make_problem(field, known).forces)


def test_weather_by_hand():
    problem = make_problem(load_field("field_03"), NavigationConfig())
    before = np.array([[0.0, 0.0], [1.0, -1.0], [4.9, 2.0]])
    actions = np.array([[1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])
    # Half a unit for a full action, and a push of (0.2, -0.1); robot 2 is at the limit along x.
    now = np.array([[0.7, -0.1], [1.2, -1.6], [5.0, 1.9]])
    windy = Weather(np.zeros(2)).after(problem, before, actions, now, ALL)
    np.testing.assert_allclose(windy.push, [0.2, -0.1])
    assert not windy.gusty, "it may always have been so"
    same = windy.after(problem, STILL, STILL, STILL + windy.push, ALL)
    assert not same.gusty
    # A wall has stopped robot 0, robot 1 has failed: robot 2 alone shows a push.
    before, now = (
        np.array([[3.0, 3.0], [1.0, 1.0], [2.0, 1.0]]),
        np.array([[0, 0], [1, 0], [2.3, 1]]),
    )
    gusty = same.after(problem, before, STILL, now, np.array([True, False, True]))
    np.testing.assert_allclose(gusty.push, [0.3, 0.0], atol=1e-12)
    assert gusty.gusty
    # Planned for are the mean, (0.2 + 0.2 + 0.3) / (3 + 10) along x, and six tenths of the force.
    careful = gusty.problem(problem)
    np.testing.assert_allclose(careful.wind[0], 0.6 * 0.7 / 13.0)
    np.testing.assert_allclose(careful.forces, 0.3)
    # Robots that are pushed differently are disturbed otherwise.
    apart = gusty.after(problem, STILL, STILL, np.array([[0.5, 0.1], [0.1, 0.1], [0.3, 0.1]]), ALL)
    np.testing.assert_allclose(apart.push, [0.3, 0.1], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["brake", "coast"])
def test_the_ways_of_failed_robots_are_foreseen(kind):
    settings = {"failures": Failures(at={0: 9, 1: 7}, kind=kind), "wind": (0.1, 200.0)}
    engine = BatchEngine("field_03", 1, autoreset="disabled", threads=1, **settings)
    engine.reset()
    for step in range(9):
        if step == 8:
            seen = engine.snapshot()
        engine.step(np.array([[[0.9, 0.3], [-0.5, 0.2], [0.0, 0.0]]]))
    problem = make_problem(load_field("field_03"), make_config(settings), closed_loop=True)
    push = np.array(engine.config.wind_increment())
    state = seen.positions.astype(float), seen.velocities.astype(float)
    ways = ways_of_failed(problem, *state, np.array([False, False, True]), push)
    assert set(ways) == {0, 1}
    for k in range(30):
        now = engine.snapshot().positions[:2]
        foreseen = [way[min(k, len(way) - 1)] for way in ways.values()]
        np.testing.assert_allclose(foreseen, now, atol=1e-3)
        if not engine.running[0]:
            break
        engine.step(np.zeros((1, 3, 2)))
    assert k > 8
    assert (kind == "coast") == (len(ways[1]) == 60)
    assert kind == "coast" or np.array_equal(ways[1][-2], ways[1][-1])


def test_a_heavy_robot_that_brakes_is_foreseen_until_it_rests():
    """It loses 0.05 of 5 units a step: 99 steps at 4.95 to 0.05, 0.05 * 99 * 100 / 2 units."""
    field = Field([(0, 0), (400, 0), (400, 60), (0, 60)], [(390, 30)], [(20, 30), (50, 30)])
    settings = make_config({"mass": 10.0, "failures": Failures(at={0: 1})})
    problem = make_problem(field, settings, closed_loop=True)
    state = problem.starts, np.array([[5.0, 0.0], [0.0, 0.0]]), np.array([False, True])
    (way,) = ways_of_failed(problem, *state, np.zeros(2)).values()
    assert way[98] == pytest.approx([267.5, 30.0]) and way[59, 0] < 230.0
    assert np.array_equal(way[-1], way[-2])
    # A wall stops it: 17 steps bring it to 20 + 85 - 7.65, 18 to 20 + 90 - 8.55.
    short = replace(problem, area=shapely.box(0, 0, 100, 60))
    (way,) = ways_of_failed(short, *state, np.zeros(2)).values()
    assert way[-1] == pytest.approx([97.35, 30.0])


def test_plans_lead_round_robots_in_the_way():
    # One rests on the straight line to the ROI; one flies across it, to be met halfway.
    field = Field(SQUARE, [(280, 200)], [(120, 200)])
    problem = make_problem(field, NavigationConfig())
    straight = search(problem, 0.0)
    assert np.abs(straight[0, :, 1] - 200.0).max() < 10.0
    halfway = straight.shape[1] // 2
    steps = np.arange(1, 61)
    standing = np.tile((200.0, 203.0), (60, 1))
    x, y = straight[0, halfway]
    flying = np.stack([np.full(60, x), y + 3.0 * (steps - halfway - 1)], axis=1)
    for others in ([standing], [flying]):
        paths = search(replace(problem, others=np.array(others)), 0.0)
        count = paths.shape[1]
        apart = np.hypot(*(paths[0] - others[0][:count]).T)
        assert 10.0 <= apart.min() < 20.0
        assert count <= 1.2 * straight.shape[1] + 1
        assert np.hypot(*(straight[0] - others[0][: straight.shape[1]]).T).min() < 10.0


def test_a_corner_that_is_reached_is_passed():
    area = shapely.box(0, 0, 100, 100) - shapely.box(40, 40, 60, 60)
    roadmap = make_roadmap(area, np.array([(10.0, 45.0), (90.0, 45.0)]))
    assert roadmap.toward(np.array([10.0, 45.0]), 1).tolist() == [40.0, 40.0]
    for place in ((40.0, 40.0), (40.003, 40.003), (39.95, 40.0), (40.05, 40.0)):
        assert roadmap.toward(np.array(place), 1).tolist() == [60.0, 40.0]
