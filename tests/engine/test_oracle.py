"""The oracle on golden episodes, and its ties by hand, before anything is compared with it."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.golden import FIELDS, load_episodes
from tests.support.field_cases import HOLE, SQUARE
from tests.support.oracle import Oracle

STILL = (0.0, 0.0)


def make_field(starts, rois=((90.0, 90.0),), vertices=SQUARE, holes=()):
    values = {"vertices": vertices, "rois": rois, "starts": starts, "holes": holes}
    return SimpleNamespace(**values, arena=(1000.0, 1000.0), roi_kinds=())


def test_golden_episodes():
    episodes = load_episodes()
    for episode in episodes:
        field = make_field(**FIELDS[episode.field])
        oracle = Oracle(field, n_robots=episode.n_robots, wind=episode.wind)
        steps, states = [], []
        for action in episode.actions.tolist():
            steps.append(oracle.step(action))
            states.append(oracle.state())
        n, found = episode.n_robots, np.array(states)
        motion = np.concatenate([episode.positions, episode.velocities], axis=1)[1:]
        assert_allclose(found[:, :-1], motion.reshape(-1, 4 * n), 0, 1e-9, err_msg=episode.id)
        assert_array_equal(found[:, -1], episode.codes[1:], episode.id)
        assert [step.team_reward for step in steps] == episode.rewards.tolist(), episode.id
        assert [step.terminated for step in steps] == episode.terminated.tolist(), episode.id
        assert oracle.episode_return == episode.episode_return, episode.id
    assert len(episodes) == 107
    assert sum(len(episode.rewards) for episode in episodes) == 16_886


@pytest.mark.parametrize(("start", "holes"), [(99.5, ()), (39.5, (HOLE,))])
def test_boundary_is_inside_and_robots_stay_and_pay_beyond_it(start, holes):
    oracle = Oracle(make_field(starts=[(start, 50.0)], holes=holes))
    assert oracle.step([(1.0, 0.0)]).wall == [False]
    step = oracle.step([(-1.0, 0.0)])  # the velocity is back to 0: it stays, on known ground
    assert (step.wall, step.team_reward) == ([False], -100.0)
    step = oracle.step([(1.0, 0.0)])
    assert (step.wall, step.team_reward) == ([True], -10_100.0)
    assert oracle.state()[:4] == (start + 0.5, 50.0, 0.0, 0.0)


def test_ground_of_an_earlier_robot_is_known_in_the_same_step():
    field = make_field(starts=[(20.0, 20.0), (20.0, 20.0)])
    step = Oracle(field, safety_distance=0.0).step([STILL, STILL])
    assert step.revisit == [False, True]
    assert step.team_reward == -110.0


def test_roi_at_exactly_the_radius_is_visited_by_the_lowest_index():
    field = make_field(starts=[(80.0, 90.0), (100.0, 90.0)], rois=[(90.0, 90.0), (10.0, 10.0)])
    oracle = Oracle(field)
    step = oracle.step([STILL, STILL])
    assert step.reached == [1, 0]
    assert oracle.visit_code == 2  # the first ROI is the most significant of two bits
    assert step.team_reward == 10_000.0 - 20.0


def test_exactly_the_safety_distance_is_no_collision_and_closer_is():
    apart = Oracle(make_field(starts=[(20.0, 20.0), (30.0, 20.0)]))
    assert not apart.step([STILL, STILL]).terminated
    step = apart.step([(1.0, 0.0), STILL])
    assert step.terminated
    assert step.team_reward == -100_000.0
    assert step.rewards == [-50_000.0, -50_000.0]


def test_collision_wins_over_success():
    starts = [(90.0, 90.0), (92.0, 90.0)]
    released = Oracle(make_field(starts))
    assert released.step([STILL, STILL]).team_reward == -100_000.0
    assert (released.success, released.collision) == (False, True)
    formal = Oracle(make_field(starts), reward="formal")
    assert formal.step([STILL, STILL]).team_reward == -100_000.0 + 100_000.0 - 10.0 + 10.0


def test_formal_reward_by_hand():
    field = make_field(starts=[(20.0, 20.0), (0.0, 60.0)])
    oracle = Oracle(field, reward="formal")
    assert oracle.step([STILL, STILL]).team_reward == -10.0 - 100.0  # the state of the reset
    assert oracle.step([(1.0, 0.0), STILL]).team_reward == -10.0 + 10.0  # clean and new
    step = oracle.step([(1.0, 0.0), (-1.0, 0.0)])  # one outside: no charge for a clean step
    assert step.team_reward == -10_000.0 + 10.0
    assert step.terms[0] == dict(step.terms[0], step=5.0, wall=0.0)
    assert step.terms[1] == dict(step.terms[1], step=5.0, wall=-10_000.0)


def test_metrics_by_hand():
    oracle = Oracle(make_field(starts=[(0.0, 50.0)], rois=[(0.0, 50.0), (90.0, 90.0)]))
    oracle.step([(1.0, 0.0)])  # to x = 0.5
    oracle.step([(-1.0, 0.0)])  # velocity 0: stays
    oracle.step([(-1.0, 0.0)])  # back to x = 0
    oracle.step([(-1.0, 0.0)])  # into the wall
    assert oracle.metrics() == {
        "success": False,
        "collision": False,
        "rois_visited": 1,
        "steps": 4,
        "episode_return": 10_000.0 - 10.0 - 100.0 - 10.0 - 100.0 - 10_000.0,
        "wall_hits": [1],
        "path_length": [1.0],
        "impulse": [1.0],  # |0.5 - 0.5 - 0.5 - 0.5|
        "failed": [False],
        "return_": [-220.0],
    }
