"""Robots that fail, in each adapter: kept, or terminated and gone; masked; flagged."""

import numpy as np
import pytest
from supersuit import black_death_v3, pettingzoo_env_to_vec_env_v1
from torchrl.envs.utils import check_env_specs

from mbn_marl import FieldSampler, navigation_v0, parallel_env
from mbn_marl.adapters.sb3 import CentralizedVecEnv, SharedPolicyVecEnv
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.errors import ActionError
from tests.support.configurations import EVERYTHING

pytestmark = pytest.mark.slow
FAILING = EVERYTHING | {"failures": {"at": {1: 2}}}


def step_all(env, agents):
    return env.step(dict.fromkeys(agents, (0.5, 0.5)))


def test_they_are_kept_or_terminated_and_gone():
    env = parallel_env(**FAILING, failed_agents="terminate")
    kept = parallel_env(**FAILING)
    env.reset(), kept.reset()
    for step in range(1, 4):
        asked, working = list(env.agents), ["robot_0", "robot_2"]
        assert asked == (env.possible_agents if step < 3 else working)
        ours, theirs = step_all(env, asked), step_all(kept, kept.agents)
        assert kept.agents == kept.possible_agents and not any(theirs[2].values())
        failed = [info["failed"] for info in theirs[4].values()]
        assert failed == [0.0, float(step > 1), 0.0]
        for mine, full in zip(ours, theirs, strict=True):
            assert list(mine) == asked
            for agent in working:
                assert np.array_equal(mine[agent], full[agent])
        assert [agent for agent in asked if ours[2][agent]] == ["robot_1"] * (step == 2)
    assert theirs[1]["robot_1"] == 0.0
    with pytest.raises(ActionError, match="'robot_3': "):
        step_all(env, [*env.possible_agents, "robot_3"])
    step_all(env, env.possible_agents), step_all(kept, kept.agents)  # as TorchRL and skrl do
    assert np.array_equal(env.state(), kept.state())
    env.reset()
    assert env.agents == env.possible_agents


def test_the_episode_is_over_when_all_have_failed():
    failures = {"rate": 1.0, "most": 3}
    env = parallel_env(**EVERYTHING | {"failures": failures}, failed_agents="terminate")
    env.reset()
    assert all(step_all(env, env.agents)[2].values())
    assert env.agents == [] and env.step({}) == ({}, {}, {}, {}, {})


def test_one_after_the_other():
    env = navigation_v0.env(**FAILING, failed_agents="terminate")
    env.reset()
    acted = []
    for agent in env.agent_iter(10):
        dead = env.terminations[agent]
        acted.append((agent, dead))
        env.step(None if dead else np.zeros(2))
    first, _, third = alive = [(name, False) for name in env.possible_agents]
    assert acted == [*alive, *alive, ("robot_1", True), first, third, first]


def test_black_death_keeps_the_agents_and_its_limits():
    env = black_death_v3(parallel_env(max_steps=4, **FAILING, failed_agents="terminate"))
    env.reset()
    for step in range(1, 6):
        observations, rewards, terminated, truncated, _ = step_all(env, env.possible_agents)
        assert all(terminated.values()) == all(truncated.values()) == (step == 5), "now lifted"
        if step == 3:
            assert [observations[one].any() for one in env.possible_agents] == [True, False, True]
            assert rewards["robot_1"] == 0
    assert not any(observation.any() for observation in observations.values())
    varying = black_death_v3(parallel_env(FieldSampler(robots=(2, 3)), max_steps=1))
    rows = pettingzoo_env_to_vec_env_v1(varying)
    rows.reset(seed=0)
    with pytest.raises(AssertionError):
        for _ in range(40):
            rows.step(np.zeros((3, 2)))


def test_torchrl_masks_them():
    env = NavigationEnv("field_03", 2, **FAILING, max_steps=4)
    check_env_specs(env)
    data = env.rollout(6, break_when_any_done=False)
    working = [[True] * 3, [True, False, True]]
    expected = [working[k] for k in (0, 0, 1, 1, 0, 0)]
    assert data["robots", "mask"].tolist() == [expected] * 2
    assert data["next", "robots", "mask"][0].tolist() == [working[k] for k in (0, 1, 1, 1, 0, 1)]
    rewards = data["next", "robots", "reward"][0, :, :, 0]
    assert (rewards[[1, 2, 3], 1] == 0).all() and (rewards[:, [0, 2]] != 0).all()
    assert NavigationEnv("field_03", 2).reset()["robots"].get("mask", None) is None


@pytest.mark.parametrize("make", [SharedPolicyVecEnv, CentralizedVecEnv])
def test_stable_baselines3_flags_them(make):
    env = make("field_03", 2, **FAILING, max_steps=3)
    env.reset()
    shape = (env.num_envs, *env.action_space.shape)
    for step in range(1, 5):
        _, rewards, _, infos = env.step(np.full(shape, 0.5, np.float32))
        failed = step in (2, 3)
        flags = [info["failed"] for info in infos]
        assert flags == ([failed] * 2 if make is CentralizedVecEnv else [False, failed, False] * 2)
        if make is SharedPolicyVecEnv:
            assert (rewards[1] == 0) == failed
    plain = make("field_03", 2)
    plain.reset()
    assert "failed" not in plain.step(np.zeros(shape, np.float32))[3][0]
