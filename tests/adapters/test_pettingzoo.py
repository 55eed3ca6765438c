"""The decentralised form: PettingZoo's checks, numbers worked out by hand, and bad input."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from pettingzoo.test import (
    api_test,
    max_cycles_test,
    parallel_api_test,
    parallel_seed_test,
    render_test,
    seed_test,
)
from pettingzoo.test.state_test import state_test

from mbn_marl import navigation_v0, parallel_env
from mbn_marl.adapters.infos import GAP
from mbn_marl.errors import ActionError, ConfigError, FieldError, MbnError, StepError
from tests.support.configurations import STORM_OF_THREE
from tests.support.forms import INFO_KEYS, NOTHING
from tests.support.problems import places_of

TEAM = {"field": "field_01", "n_robots": 2, "reward": "formal", "reward_sharing": "team"}
CONFIGURATIONS = {
    "default": {},
    "team, short": TEAM | {"observation": "local", "max_steps": 30, "random_starts": True},
    "float64": {"dtype": "float64", "field": "field_09", "observation": "state", "wind": (0.05, 9)},
    "storm": STORM_OF_THREE,
}
every_configuration = pytest.mark.parametrize(
    "settings", CONFIGURATIONS.values(), ids=list(CONFIGURATIONS)
)


def random_actions(env, rng):
    return {agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.agents}


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@every_configuration
def test_pettingzoos_checkers_pass(settings):
    if "condition" in settings:
        settings = settings | {"failed_agents": "terminate"}
    parallel_api_test(navigation_v0.parallel_env(**settings), num_cycles=300)
    api_test(navigation_v0.env(**settings), num_cycles=60)
    seed_test(lambda: navigation_v0.env(**settings), num_cycles=30)
    parallel_seed_test(lambda: navigation_v0.parallel_env(**settings), num_cycles=30)
    state_test(navigation_v0.env(**settings), navigation_v0.parallel_env(**settings))


@pytest.mark.slow
def test_the_checkers_of_raw_env_pictures_and_max_cycles_pass():
    api_test(navigation_v0.raw_env(), num_cycles=50)
    render_test(navigation_v0.env)
    max_cycles_test(navigation_v0)


def test_standing_still_visits_the_two_rois_in_reach_then_pays_for_known_ground():
    env = parallel_env("field_03")
    env.reset()
    still = {agent: [0.0, 0.0] for agent in env.agents}
    _, rewards, terminated, truncated, infos = env.step(still)
    # (200, 240) is 10 from robot_0, (240, 300) is 10 from robot_2: the second and sixth ROI.
    assert rewards == {"robot_0": 9990.0, "robot_1": -10.0, "robot_2": 9990.0}
    assert env.state()[-1] == 0b010001
    assert set(terminated.values()) == set(truncated.values()) == {False}
    assert [info["rois_visited"] for info in infos.values()] == [2.0, 2.0, 2.0]
    assert infos["robot_0"]["reward/roi"] == 10_000.0
    _, rewards, _, _, infos = env.step(still)
    assert rewards == {"robot_0": -100.0, "robot_1": -100.0, "robot_2": -100.0}


@pytest.mark.slow
@every_configuration
def test_spaces_terms_and_keys(settings):
    env = parallel_env(**settings)
    rng = np.random.default_rng(5)
    drawn = {f"drawn/{name}" for name in env.engine.config.drawn}
    env.reset(seed=3)
    for _ in range(200):
        asked = env.agents or env.possible_agents
        if not env.agents:
            observations, infos = env.reset()
            assert NOTHING.items() <= infos["robot_0"].items()
        else:
            observations, rewards, terminated, _, infos = env.step(random_actions(env, rng))
            assert all(type(reward) is float for reward in rewards.values())
            assert all(type(flag) is bool for flag in terminated.values())
        assert env.state_space.contains(env.state())
        assert list(observations) == list(infos) == asked
        for agent, observation in observations.items():
            assert env.observation_space(agent).contains(observation)
            assert tuple(infos[agent])[: len(INFO_KEYS)] == INFO_KEYS
            assert infos[agent].keys() - set(INFO_KEYS) == drawn
            assert all(isinstance(value, float) for value in infos[agent].values())
            known = not env.agents and env.optimal_return is not None
            assert math.isnan(infos[agent][GAP]) != known


def test_what_was_returned_stays_as_it_was():
    env = parallel_env()
    rng = np.random.default_rng(0)
    kept = [env.reset(seed=0)]
    kept += [env.step(random_actions(env, rng)) for _ in range(3)]
    before = copy.deepcopy(kept)
    env.step(random_actions(env, rng))
    env.reset()
    np.testing.assert_equal(kept, before)


def test_a_copy_goes_on_as_the_original_would_and_leaves_it_alone():
    for copied in (copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))):
        env = parallel_env(render_mode="rgb_array")
        rng = np.random.default_rng(2)
        env.reset(seed=3)
        env.render()
        for _ in range(5):
            env.step(random_actions(env, rng))
        twin, before = copied(env), env.state()
        actions = random_actions(env, rng)
        theirs = twin.step(actions)
        assert np.array_equal(env.state(), before)
        assert env.step(actions)[1:] == theirs[1:]
        assert np.array_equal(env.state(), twin.state())
        assert not np.array_equal(env.state(), before)


def test_the_aec_form_is_the_parallel_one():
    aec, parallel = navigation_v0.env(), parallel_env()
    rng = np.random.default_rng(1)
    aec.reset(seed=1)
    parallel.reset(seed=1)
    buffer = np.zeros(2, np.float32)  # used again for each robot
    for _ in range(50):
        actions = random_actions(parallel, rng)
        result = parallel.step(actions)
        for agent in actions:
            assert aec.agent_selection == agent
            buffer[:] = actions[agent]
            aec.step(buffer)
        assert aec.rewards == result[1]
        assert aec.infos == result[4]
        assert np.array_equal(aec.state(), parallel.state())


def test_a_wrong_action_is_refused_at_once_and_can_be_given_again():
    env = navigation_v0.env()
    env.reset(seed=0)
    for bad in ([np.inf, 0.0], [0.0], None, [None, None], "north", [10**400, 0], ("1", "0")):
        with pytest.raises(ActionError, match="robot_0: "):
            env.step(bad)
        assert env.agent_selection == "robot_0", bad
    for _ in env.possible_agents:
        env.step(np.zeros(2))
    assert env.rewards == {"robot_0": 9990.0, "robot_1": -10.0, "robot_2": 9990.0}
    large = navigation_v0.env()
    for one, force in ((env, 1.0), (large, 1e39)):  # above the range of float32: clipped
        one.reset(seed=0)
        for _ in one.possible_agents:
            one.step([force, 0.0])
    assert np.array_equal(env.state(), large.state())


def test_the_order_of_calls_one_after_the_other():
    env = navigation_v0.raw_env(max_steps=1)
    with pytest.raises(StepError):
        env.step(np.zeros(2))
    env.reset()
    for _ in range(3):
        env.step(np.zeros(2))
    with pytest.raises(ActionError, match="robot_0: "):
        env.step(np.zeros(2))
    for _ in range(3):
        env.step(None)
    assert env.agents == []
    with pytest.raises(StepError):
        env.step(None)


def test_wrong_actions_name_the_robots_and_move_nothing():
    env, twin = parallel_env(), parallel_env()
    for one in (env, twin):
        one.reset(seed=0)
        one.step({agent: [0.5, 0.5] for agent in one.agents})
    state, still = env.state(), {agent: [0.0, 0.0] for agent in env.agents}
    for wrong, named in (
        (still | {"robot_1": [np.nan, 0.0]}, ["robot_1"]),
        (still | {"robot_0": np.zeros((2, 1))}, ["robot_0"]),
        (still | {"robot_1": "north"}, ["robot_1"]),
        (still | {"robot_2": ("0.5", "1")}, ["robot_2"]),
        (still | {"robot_0": [1j, 0.0], "robot_1": (True, False)}, ["robot_0", "robot_1"]),
        ({agent: [0.0] * 3 for agent in env.agents}, ["robot_0", "robot_1", "robot_2"]),
        ({"robot_0": [0, 0], "robot_2": [0, 0], "robot_7": [0, 0]}, ["robot_1", "robot_7"]),
        ([[0, 0]] * 3, []),
    ):
        with pytest.raises(ActionError) as caught:
            env.step(wrong)
        problems = str(caught.value).partition("allowed")[0]
        assert [one for one in (*env.agents, "robot_7") if one in problems] == named
        assert np.array_equal(env.state(), state) and env.agents == env.possible_agents
    good = {agent: [0.25, -0.5] for agent in env.agents}
    tensor = torch.tensor([0.25, -0.5], dtype=torch.bfloat16, requires_grad=True)
    assert env.step(good)[1:] == twin.step(dict.fromkeys(good, tensor))[1:]


def test_the_order_of_calls():
    env = parallel_env(max_steps=1)
    for call in (lambda: env.step({}), lambda: env.step({"robot_0": [0, 0]}), env.state):
        with pytest.raises(StepError):
            call()
    env.reset()
    actions = {agent: [0, 0] for agent in env.agents}
    env.step(actions)
    state = env.state()
    with pytest.raises(StepError):
        env.step(actions)
    assert env.step({}) == ({}, {}, {}, {}, {})
    assert np.array_equal(env.state(), state)
    env.reset()
    assert len(env.step(actions)[0]) == 3


def test_wrong_settings_and_names_are_named():
    wrong = {"render_mode": "x", "failed_agents": "x", "render_size": (1, 1), "colour": "red"}
    places = ["failed_agents", "render_size", "render_mode", "colour"]
    assert places_of(ConfigError, parallel_env, **wrong) == places
    env = parallel_env()
    for call, error, place in (
        (lambda: parallel_env(starts=1), ConfigError, "starts: "),
        (lambda: parallel_env(max_cycles=4, max_steps=5), ConfigError, "max_cycles: "),
        (lambda: parallel_env("field_99"), FieldError, "field_99"),
        (lambda: env.observation_space("robot_3"), MbnError, "robot_3"),
        (lambda: env.action_space("robot_3"), MbnError, "robot_3"),
    ):
        with pytest.raises(error, match=place):
            call()
