"""SuperSuit's way from PettingZoo to Stable-Baselines3: it trains, and what it does not do.

See docs/supersuit.md for when to use ``SharedPolicyVecEnv`` instead. The tests of the limits are
there to fail when SuperSuit lifts one, so that the document can be changed.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv
from supersuit import concat_vec_envs_v1, pettingzoo_env_to_vec_env_v1

from mbn_marl import parallel_env

pytestmark = pytest.mark.slow
WORLDS, ROBOTS, LIMIT = 2, 3, 20


def make_env(**settings: object) -> VecEnv:
    env = parallel_env("field_03", max_steps=LIMIT, **settings)
    return concat_vec_envs_v1(
        pettingzoo_env_to_vec_env_v1(env), WORLDS, num_cpus=0, base_class="stable_baselines3"
    )


def make_model(env: VecEnv, seed: int | None = None) -> PPO:
    return PPO("MlpPolicy", env, seed=seed, n_steps=32, batch_size=64, n_epochs=1, device="cpu")


def test_ppo_trains() -> None:
    torch.manual_seed(0)
    env = make_env()
    assert env.num_envs == WORLDS * ROBOTS
    model = make_model(env)
    before = [weight.clone() for weight in model.policy.parameters()]
    model.learn(2 * 32 * env.num_envs)
    assert model.num_timesteps == 384
    after = list(model.policy.parameters())
    assert any((old != new).any() for old, new in zip(before, after, strict=True))
    assert all(torch.isfinite(weight).all() for weight in after)


def test_rows_are_the_robots_of_each_world() -> None:
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


def test_limit_it_cannot_be_seeded() -> None:
    env = make_env(random_starts=True)
    with pytest.raises(AttributeError):
        env.seed(0)
    with pytest.raises(AttributeError):
        make_model(env, seed=0)


def test_limit_worlds_are_copies_that_do_the_same() -> None:
    """Unseeded, each copy of the environment draws the same random starts."""
    rows = make_env(random_starts=True).reset()
    np.testing.assert_array_equal(rows[:ROBOTS], rows[ROBOTS:])


def test_limit_time_limits_look_like_ends() -> None:
    """``terminal_observation`` is there, ``TimeLimit.truncated`` is not: no bootstrapping."""
    env = make_env()
    env.reset()
    for _ in range(LIMIT):
        _, _, dones, infos = env.step(np.zeros((env.num_envs, 2), np.float32))
    assert dones.all()
    for info in infos:
        assert info["success"] == info["collision"] == 0.0
        assert info["terminal_observation"].shape == env.observation_space.shape
        assert "TimeLimit.truncated" not in info
        assert "episode" not in info
