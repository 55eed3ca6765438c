"""Plans: verified in the engine, proved or with an honest interval."""

import itertools
from functools import cache

import numpy as np
import pytest
import shapely

from mbn_marl import BatchEngine, parallel_env
from mbn_marl.config import make_config
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, catalogue_names, load_field
from mbn_marl.optimum import optimal_return
from mbn_marl.planning import Plan, UnsolvableError, plan
from mbn_marl.planning.problem import make_problem
from mbn_marl.planning.replay import Player
from tests.field.test_field_files import OPTIMAL_MAKESPANS
from tests.support.planning_cases import SQUARE, U_SHAPE, star_field

pytestmark = pytest.mark.slow
planned = cache(plan)


def replayed(found: Plan, dtype: str, **settings: object) -> tuple[bool, int, float]:
    """Success, length and return of the plan's actions in the public environment."""
    env = parallel_env(found.field, dtype=dtype, **settings)
    env.reset(seed=0)
    total, infos = 0.0, {}
    for step, actions in enumerate(found.actions):
        assert env.agents, f"ended after {step} steps"
        _, rewards, _, _, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        total += sum(rewards.values())
    success = infos["robot_0"]["success"] == 1.0
    return success and not env.agents, len(found.actions), total


@pytest.mark.parametrize(
    ("name", "makespan"), zip(catalogue_names(), OPTIMAL_MAKESPANS, strict=True)
)
def test_the_ten_fields_are_proved_optimal(name, makespan):
    found = planned(name)
    assert (found.makespan, found.makespan_lower_bound, found.optimal) == (makespan, makespan, True)
    assert load_field(name).optimal_makespan == makespan
    assert found.return_ == 160_000 - 30 * makespan == optimal_return(found.field)
    assert found.actions.shape == (makespan, 3, 2)
    assert np.abs(found.actions).max() <= 1.0
    assert sorted(itertools.chain(*found.assignment)) == list(range(6))
    for dtype in ("float32", "float64"):
        success, steps, total = replayed(found, dtype)
        assert (success, steps) == (True, makespan)
        assert total == pytest.approx(160_000 - 30 * makespan, rel=1e-6)


def test_ties_are_polished_to_exact_motions():
    # The ROI comes within exactly 10 units in the last step, at full force all the way.
    lane = [(0, 0), (900, 0), (900, 300), (0, 300)]
    for reach in (7.5, 7.5 + 10.0, 27.5 + 5.0 * 20):
        found = plan(Field(lane, [(110.0 + reach, 200)], [(100, 200)]))
        assert found.optimal, reach
        assert abs(found.trail[-1, 0, 0] - found.field.rois[0, 0]) <= 10.0, reach
    at_once = plan(Field(SQUARE, [(150, 150)], [(150, 150)]))
    assert (at_once.makespan, at_once.optimal, at_once.return_) == (1, True, 109_990.0)


def test_wind_is_part_of_the_plan():
    field = Field(SQUARE, [(120, 120), (200, 200)], [(280, 280)])
    calm, against = plan(field), plan(field, wind=(0.4, 30.0))
    assert against.optimal and against.makespan > calm.makespan_lower_bound
    assert replayed(against, "float32", wind=(0.4, 30.0))[:2] == (True, against.makespan)


@pytest.mark.parametrize("field", [U_SHAPE, star_field(0), star_field(1)])
def test_fields_that_are_not_convex_have_verified_plans(field):
    found = plan(field, work_limit=1000)
    assert found.makespan_lower_bound <= found.makespan
    assert (found.makespan - found.makespan_lower_bound) / found.makespan <= 0.15
    assert shapely.intersects_xy(field.polygon, found.trail.reshape(-1, 2)).all()
    assert replayed(found, "float32")[:2] == (True, found.makespan)


TWO_ROOMS = [
    *((0, 0), (80, 0), (80, 37), (120, 37), (120, 0), (200, 0)),
    *((200, 80), (120, 80), (120, 43), (80, 43), (80, 80), (0, 80)),
]


@pytest.mark.parametrize(
    ("starts", "rois", "kinds", "most"),
    [
        ([(30, 40), (170, 20)], [(170, 60), (30, 60)], [0, 1], 45),  # one after the other
        ([(20, 20), (20, 40), (20, 60)], [(180, 20), (180, 40), (180, 60)], None, 40),  # a queue
    ],
)
def test_robots_wait_for_each_other_at_a_door(starts, rois, kinds, most):
    own = {"roi_kinds": kinds, "start_kinds": kinds} if kinds else {}
    field = Field(TWO_ROOMS, rois, starts, **own)
    found = plan(field, work_limit=1000, time_limit=1e-6)
    assert found.makespan_lower_bound < found.makespan <= most
    assert replayed(found, "float32")[:2] == (True, found.makespan)
    again = plan(field, work_limit=1000)
    assert np.array_equal(again.actions, found.actions)


def test_many_rois_have_a_plan_and_a_bound():
    rois = np.random.default_rng(0).uniform(110.0, 290.0, (16, 2))
    found = plan(Field(SQUARE, rois, [(120, 120), (280, 280)]), time_limit=10.0)
    assert 20 < found.makespan_lower_bound <= found.makespan
    assert sorted(itertools.chain(*found.assignment)) == list(range(16))


def test_an_unreachable_roi_is_reported_at_once():
    near = Field(SQUARE, [(120, 120)], [(280, 280)])
    for field, settings, place in (
        (U_SHAPE, {"max_steps": 90}, r"rois\[0\]"),  # 48 steps away, but for the wall
        (near, {"wind": (0.8, 30.0)}, r"rois\[0\]"),
        ("field_03", {"max_steps": 16}, "max_steps"),
    ):
        with pytest.raises(UnsolvableError, match=place):
            plan(field, **settings)


def test_out_of_time_the_interval_is_marked():
    found = plan("field_06", time_limit=1e-6)
    assert not found.optimal
    assert found.makespan_lower_bound <= 39
    assert found.makespan is None or found.makespan > 39


def test_the_time_limit_holds_where_greed_gets_nowhere():
    # Blown into a wall for good, the greedy controller continues until the end of the episode.
    found = plan("field_01", wind=(0.55, 0.0), max_steps=4000, time_limit=1.0)
    assert found.makespan is None
    assert found.makespan_lower_bound > 30
    assert found.seconds < 8.0


def test_plans_do_not_compile_what_robots_would_see():
    config = make_config({"observation": "lidar", "one_hot": True, "reward_sharing": "team"})
    player = Player(make_problem(load_field("field_03"), config))
    assert player._engine.config.observation == "relative"
    assert plan("field_03", observation="lidar", one_hot=True, sensing_radius=50.0).optimal


@pytest.mark.parametrize(("name", "steps"), [("field_03", 8), ("field_06", 31)])
def test_the_rest_of_a_shortest_plan_is_a_shortest_plan(name, steps):
    whole = planned(name)
    engine = BatchEngine(name, 1, autoreset="disabled", threads=1)
    engine.reset()
    for actions in whole.actions[:steps]:
        engine.step(actions[None])
    seen, field = engine.snapshot(), whole.field
    assert 0 < seen.visited.sum() < 6
    rest = Field(field.vertices, field.rois, seen.positions, arena=field.arena)
    visited = np.flatnonzero(seen.visited).tolist()
    found = plan(rest, velocities=seen.velocities, visited=visited)
    left = whole.makespan - steps
    assert (found.makespan, found.makespan_lower_bound) == (left, left)
    assert sorted([*visited, *itertools.chain(*found.assignment)]) == list(range(6))
    for actions in found.actions:
        _, _, ended, _ = engine.step(actions[None])
    assert ended[0] and engine.snapshot().success


def test_bad_input_is_named():
    still = [(0.0, 0.0)]
    for settings, place in (
        ({"time_limit": 0.0}, "time_limit"),
        ({"n_robots": 4}, "n_robots"),
        ({"random_starts": True}, "random_starts"),
        ({"mass": (1.0, 2.0)}, "mass"),
        ({"velocities": [(1.0, 0.0)]}, "velocities: "),
        ({"velocities": [*still, *still, (0.0, np.nan)]}, r"velocities\[2\]: "),
        ({"velocities": [(1.0, 0.0), (1.0,), (0.0, 0.0)]}, "velocities: "),
        *(({"velocities": velocities}, "velocities: ") for velocities in ("fast", object())),
        *(({"visited": v}, "visited: ") for v in ([6], [-1], range(6), 3, [[1]], [1.0], [True])),
        ({"work_limit": -5}, "work_limit: "),
        ({"time_limit": "5"}, "time_limit: "),
        (
            {"time_limit": -1, "visited": [9], "max_steps": 0},
            "time_limit: (.|\n)*visited: (.|\n)*max_steps: ",
        ),
        ({"visited": [9], "velocities": [1]}, "visited: (.|\n)*velocities: "),
    ):
        with pytest.raises(ConfigError, match=place):
            plan("field_03", **settings)


def test_a_start_on_an_roi_keeps_the_bound_below_the_plan():
    hole = [(90, 60), (110, 60), (110, 140), (90, 140)]
    square = [(0, 0), (200, 0), (200, 200), (0, 200)]
    for rois in ([(20, 20), (30, 150)], [(20, 20)]):
        found = plan(Field(square, rois, [(20, 20)], [hole]))
        assert found.optimal
        assert (found.makespan == 1) == (len(rois) == 1)
