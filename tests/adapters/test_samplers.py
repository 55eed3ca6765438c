"""Every form takes a sampler of fields, and a field for one episode."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test
from torchrl.envs.utils import check_env_specs

from mbn_marl import FieldSampler, centralized_env, load_field, parallel_env, raw_env
from mbn_marl.adapters.sb3 import CentralizedVecEnv, SharedPolicyVecEnv
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.episode import EpisodeRecorder
from mbn_marl.errors import ConfigError, FieldError

pytestmark = pytest.mark.slow
SAMPLER = FieldSampler(("convex", "farm"), robots=(1, 3), rois=(2, 5), size=(110, 200), seed=4)


def test_pettingzoo_has_the_agents_of_each_episode():
    env = parallel_env(SAMPLER, max_steps=4)
    assert env.possible_agents == ["robot_0", "robot_1", "robot_2"]
    teams = []
    for episode in range(12):
        observations, infos = env.reset(seed=1 if episode == 0 else None)
        field = SAMPLER.field(0, episode)
        assert len(env.agents) == len(field.starts)
        assert list(observations) == list(infos) == env.agents
        teams.append(len(env.agents))
        while env.agents:
            agents = list(env.agents)
            _, rewards, _, _, infos = env.step(dict.fromkeys(agents, (0.0, 0.0)))
            assert list(rewards) == list(infos) == agents
            assert sum(rewards.values()) == pytest.approx(float(env.engine.team_rewards[0]))
    assert set(teams) == {1, 2, 3}


def test_the_checkers_pass():
    parallel_api_test(parallel_env(SAMPLER, max_steps=9), num_cycles=60)
    api_test(raw_env(SAMPLER, max_steps=9), num_cycles=60)
    check_env(centralized_env(SAMPLER, max_steps=9), skip_render_check=True)
    envs = gymnasium.make_vec("mbn/field_03-v0", 5, field=SAMPLER, max_steps=3)
    assert envs.observation_space.contains(envs.reset(seed=1)[0])
    check_env_specs(NavigationEnv(SAMPLER, 6, max_steps=3), check_dtype=True)


def test_torchrl_masks_absent_robots():
    env = NavigationEnv(SAMPLER, 7, max_steps=3)
    rollout = env.rollout(10, break_when_any_done=False)
    mask = rollout["robots", "mask"]
    for world in range(7):
        for t in range(10):
            count = len(SAMPLER.field(world, t // 3).starts)
            assert mask[world, t].tolist() == [i < count for i in range(3)]
    assert not rollout["robots", "observation"][~mask].any()
    assert not rollout["next", "robots", "reward"][~mask].any()
    shares = rollout["next", "robots", "reward"].sum((-2, -1))
    torch.testing.assert_close(shares, rollout["next", "team_reward"].squeeze(-1))


def test_sb3_says_which_rows_are_there():
    shared, central = (
        make(SAMPLER, 6, max_steps=3) for make in (SharedPolicyVecEnv, CentralizedVecEnv)
    )
    for env in (shared, central):
        env.seed(1)
        env.reset()
    counts = np.array([len(SAMPLER.field(world).starts) for world in range(6)])
    observations, rewards, _, infos = shared.step(np.zeros((18, 2), np.float32))
    there = np.array([info["present"] for info in infos])
    assert there.reshape(6, 3).sum(axis=1).tolist() == counts.tolist()
    assert not observations[~there].any()
    assert not rewards[~there].any()
    *_, infos = central.step(np.zeros((6, 3, 2), np.float32))
    assert [info["present"] for info in infos] == counts.tolist()


@pytest.mark.parametrize("make", [parallel_env, centralized_env])
def test_a_reset_takes_a_field_for_one_episode(make):
    other, own = load_field("field_05"), load_field("field_03")
    starts = np.add(other.starts[::-1], 0.5)
    for env, given, options, later in (
        (make(SAMPLER, n_robots=3), SAMPLER.field(50), {}, SAMPLER.field(0, 2)),
        (make(own), other, {"starts": starts}, own),
    ):
        env.reset(seed=3)
        env.reset(options={"field": given, **options})
        shot = env.engine.snapshot()
        assert np.array_equal(shot.field.rois, given.rois)
        assert not options or np.array_equal(shot.positions, starts)
        env.reset()
        assert np.array_equal(env.engine.snapshot().field.rois, later.rois)
    before = env.state()
    with pytest.raises(ConfigError, match="seed: "):
        env.reset(seed=-1, options={"field": "field_05"})
    with pytest.raises(FieldError):
        env.reset(options={"field": "field_77"})
    with pytest.raises(ConfigError, match="starts"):
        env.reset(options={"starts": np.zeros((3, 2))})
    assert np.array_equal(env.state(), before)
    with pytest.raises(ConfigError, match="starts"):
        make(SAMPLER).reset(options={"starts": np.zeros((3, 2))})


def test_the_gap_is_that_of_the_field_of_the_episode():
    env, gaps = parallel_env("field_03"), []
    given = {"starts": load_field("field_03").starts + 0.5}  # of which no optimum is proved
    for options in ({}, {"field": "field_05"}, given, {}):
        env.reset(seed=1, options=options)
        assert (env.optimal_return is None) == (options is given)
        while env.agents:
            *_, infos = env.step(dict.fromkeys(env.agents, (0.0, 0.0)))
        gaps.append(infos["robot_0"]["optimality_gap"])
    assert gaps[0] == gaps[3] != gaps[1] and np.isnan(gaps[2])


def test_a_recorder_keeps_the_field_and_the_team_of_each_episode():
    env = parallel_env(SAMPLER, max_steps=6, mass=(1.0, 1.5, 2.0))
    with EpisodeRecorder(env) as recorder:
        for episode in range(5):
            env.reset(seed=2 if episode == 0 else None)
            while env.agents:
                env.step(dict.fromkeys(env.agents, (0.1, 0.2)))
    for number, episode in enumerate(recorder.episodes):
        expected = SAMPLER.field(0, number)
        assert np.array_equal(episode.field.rois, expected.rois)
        assert episode.positions.shape == (7, len(expected.starts), 2)
    assert len({episode.config.n_robots for episode in recorder.episodes}) > 1
    env = parallel_env("field_03", n_robots=5, random_starts=True, max_steps=5)
    with EpisodeRecorder(env) as recorder:  # a team larger than the field's starts
        env.reset(seed=1)
        while env.agents:
            env.step(dict.fromkeys(env.agents, (0.1, 0.2)))
    assert recorder.episodes[0].positions.shape[1:] == (5, 2)
