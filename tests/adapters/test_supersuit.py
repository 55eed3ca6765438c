"""SuperSuit's way from PettingZoo to Stable-Baselines3: it trains, and its limits."""

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv
from supersuit import concat_vec_envs_v1, pettingzoo_env_to_vec_env_v1

from mbn_marl import parallel_env

pytestmark = pytest.mark.slow
WORLDS, ROBOTS, LIMIT = 2, 3, 20


def make_env(seed: int | None = None, **settings: object) -> VecEnv:
    env = parallel_env("field_03", max_steps=LIMIT, **settings)
    if seed is not None:
        env.reset(seed=seed)
    return concat_vec_envs_v1(
        pettingzoo_env_to_vec_env_v1(env), WORLDS, num_cpus=0, base_class="stable_baselines3"
    )


def test_rows_are_the_robots_of_each_world():
    env, world = make_env(), parallel_env("field_03", max_steps=LIMIT)
    observations, _ = world.reset()
    rows = env.reset()
    for t in range(LIMIT - 1):
        np.testing.assert_array_equal(rows, np.tile(np.stack([*observations.values()]), (2, 1)))
        force = np.full((ROBOTS, 2), 0.1 * (-1) ** t, np.float32)
        observations, rewards, *_ = world.step(dict(zip(world.agents, force, strict=True)))
        rows, given, dones, _ = env.step(np.tile(force, (2, 1)))
        np.testing.assert_array_equal(given, np.tile(np.array([*rewards.values()]), 2))
        assert not dones.any()


def test_its_limits():
    """Of each limit that docs/supersuit.md tells: if one is lifted, change the page."""
    env = make_env(random_starts=True, seed=0)
    for call in (lambda: env.seed(0), lambda: PPO("MlpPolicy", env, seed=0)):
        with pytest.raises(AttributeError):
            call()
    rows = env.reset()  # copies of a seeded environment draw the same starts
    np.testing.assert_array_equal(rows[:ROBOTS], rows[ROBOTS:])
    rows = make_env(random_starts=True).reset()
    assert (rows[:ROBOTS] != rows[ROBOTS:]).any()
    env = make_env()
    env.reset()
    for _ in range(LIMIT):
        _, _, dones, infos = env.step(np.zeros((env.num_envs, 2), np.float32))
    assert dones.all()
    for info in infos:  # time limits look like ends
        assert info["terminal_observation"].shape == env.observation_space.shape
        assert "TimeLimit.truncated" not in info and "episode" not in info
