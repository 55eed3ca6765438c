"""The Stable-Baselines3 environments: equality with the engine, its conventions, and training."""

import warnings
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from mbn_marl.adapters.sb3 import CentralizedVecEnv, NavigationVecEnv, SharedPolicyVecEnv
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ActionError, ConfigError, MbnError, StepError

WORLDS, ROBOTS, STEPS = 5, 3, 60
LIVELY = {"max_steps": 25, "safety_distance": 50.0, "random_starts": True}
BOTH = pytest.mark.parametrize("kind", [CentralizedVecEnv, SharedPolicyVecEnv])


def forces(env: NavigationVecEnv, steps: int = STEPS) -> np.ndarray:
    """The same random actions on every call."""
    shape = (steps, env.num_envs, *env.action_space.shape)
    return np.random.default_rng(0).uniform(-1.2, 1.2, shape).astype(np.float32)


def by_row(env: NavigationVecEnv, of_worlds: np.ndarray) -> np.ndarray:
    return np.repeat(of_worlds, env.num_envs // WORLDS, axis=0)


def observed(env: NavigationVecEnv, engine: BatchEngine, observations: np.ndarray) -> np.ndarray:
    if isinstance(env, CentralizedVecEnv):
        return engine.state()
    return observations.reshape(env.num_envs, -1)


@BOTH
def test_spaces(kind):
    env = kind("field_03", WORLDS)
    central = kind is CentralizedVecEnv
    assert env.num_envs == (WORLDS if central else WORLDS * ROBOTS)
    double = CentralizedVecEnv("field_03", 2, dtype="float64")
    assert double.observation_space.dtype == double.reset().dtype == np.float64
    shape = (ROBOTS, 2) if central else (2,)
    assert env.action_space == spaces.Box(-1.0, 1.0, shape, np.float32)
    assert env.observation_space.shape == ((4 * ROBOTS + 1,) if central else (env.engine.obs_size,))
    env.reset()
    for actions in forces(env, 5):
        observations, rewards, dones, _ = env.step(actions)
        assert all(env.observation_space.contains(row) for row in observations)
        assert (rewards.dtype, dones.dtype) == (np.float32, np.bool_)


@BOTH
def test_steps_are_the_engines(kind):
    env = kind("field_03", WORLDS, seed=5, **LIVELY)
    engine = BatchEngine("field_03", WORLDS, seed=5, autoreset="disabled", **LIVELY)
    np.testing.assert_array_equal(env.reset(), observed(env, engine, engine.reset()))
    seen = {"terminated": 0, "truncated": 0}
    for actions in forces(env, 3 * STEPS):
        observations, rewards, dones, infos = env.step(actions)
        last, own, terminated, truncated = engine.step(actions.reshape(WORLDS, ROBOTS, 2))
        expected = engine.team_rewards if kind is CentralizedVecEnv else own.reshape(-1)
        ended, last = terminated | truncated, observed(env, engine, last)
        rows = by_row(env, ended)
        check_final_infos(env, infos, rows, engine.metrics())
        timeouts = by_row(env, truncated & ~terminated)
        for row in np.flatnonzero(rows):
            np.testing.assert_array_equal(infos[row]["terminal_observation"], last[row])
            assert infos[row]["TimeLimit.truncated"] == timeouts[row]
        seen["terminated"] += terminated.sum()
        seen["truncated"] += truncated.sum()
        np.testing.assert_array_equal(rewards, expected)
        np.testing.assert_array_equal(dones, rows)
        assert [len(info) > 1 for info in infos] == dones.tolist()
        following = engine.reset_worlds(ended)
        np.testing.assert_array_equal(observations, observed(env, engine, following))
    assert min(seen.values()) > 5


def check_final_infos(env: Any, infos: Any, dones: np.ndarray, metrics: Any) -> None:
    central = isinstance(env, CentralizedVecEnv)
    for row in np.flatnonzero(dones):
        info, (world, robot) = infos[row], (row, 0) if central else divmod(row, ROBOTS)
        returns = metrics["episode_return"] if central else metrics["return_"].reshape(-1)
        assert info["episode"]["r"] == returns[row]
        assert info["episode"]["l"] == info["steps"] == metrics["steps"][world]
        assert info["episode"]["t"] > 0
        assert info["is_success"] == info["success"] == metrics["success"][world]
        for name in ("collision", "rois_visited", "episode_return"):
            assert info[name] == metrics[name][world]
        for name in ("wall_hits", "path_length", "impulse"):
            own = metrics[name][world]
            assert info[name] == (own.sum() if central else own[robot])


@BOTH
def test_all_that_is_returned_is_the_callers(kind):
    env, spoiled = (kind("field_03", WORLDS, **LIVELY) for _ in range(2))
    kept = [(env.reset(), spoiled.reset())]
    for actions in forces(env):
        *arrays, infos = env.step(actions)
        *others, their_infos = spoiled.step(actions)
        assert len({id(info) for info in infos}) == env.num_envs
        for info, other in zip(infos, their_infos, strict=True):
            assert info.keys() == other.keys()
            if "terminal_observation" in info:
                arrays.append(info["terminal_observation"])
                others.append(other["terminal_observation"])
            other["mark"] = "of the caller"
        kept += [(array, other.copy()) for array, other in zip(arrays, others, strict=True)]
        for other in others:
            other[...] = 1
    for array, other in kept:
        np.testing.assert_array_equal(array, other)


@BOTH
def test_seed_takes_effect_at_the_next_reset(kind):
    env = kind("field_03", WORLDS, seed=1, random_starts=True)
    expected = kind("field_03", WORLDS, seed=9, random_starts=True)
    first, (second, third) = env.reset(), (expected.reset(), expected.reset())
    assert (first != second).any() and (second != third).any()
    env.seed(9)
    np.testing.assert_array_equal(env.reset(), second)
    np.testing.assert_array_equal(env.reset(), third)


@BOTH
def test_bad_calls_are_refused_before_anything_moves(kind):
    env = kind("field_03", WORLDS)
    good = forces(env, 1)[0]
    with pytest.raises(StepError):
        env.step(good)
    env.reset()
    before = env.engine.state()
    bad = good.copy()
    bad.reshape(-1)[-1] = np.nan
    for call, error, place in (
        (env.step_wait, StepError, "step_wait: "),
        (lambda: env.step(np.zeros(2)), ActionError, "actions: "),
        (lambda: env.step(bad), ActionError, r"world 4.*robot_2"),
        (lambda: env.step([[1.0], [1.0, 0.0]]), ActionError, "actions: "),
        (lambda: kind("field_03", 4, autoreset=True), ConfigError, "autoreset: "),
        (
            lambda: kind("field_03", 0, render_mode="human"),
            ConfigError,
            r"render_mode: (.|\n)*num_",
        ),
        (lambda: CentralizedVecEnv("field_03", 0), ConfigError, "num_envs: 0"),
        (lambda: CentralizedVecEnv("field_03", num_worlds=4), ConfigError, "num_worlds: "),
        (lambda: CentralizedVecEnv("field_03", joint_observation="no"), ConfigError, "joint_obs"),
        (lambda: env.set_attr("label", "other", indices=[0]), MbnError, "label"),
    ):
        with pytest.raises(error, match=place):
            call()
        np.testing.assert_array_equal(env.engine.state(), before)
    env.set_options({"field": "field_07"})
    with pytest.raises(ConfigError, match="options: "):
        env.reset()
    env.set_options()
    env.reset()
    env.step(torch.from_numpy(good).requires_grad_())


@BOTH
def test_attributes_and_methods(kind):
    env = kind("field_03", WORLDS)
    env.reset()
    assert env.render_mode is None
    assert env.get_attr("n_robots") == [ROBOTS] * env.num_envs
    assert not env.has_attr("missing")
    env.set_attr("label", "mine")
    assert env.get_attr("label", indices=1) == ["mine"]
    (shot,) = env.env_method("snapshot", indices=[-1])
    assert shot.field.name == "field_03"
    with pytest.raises(AttributeError):
        env.env_method("missing")
    for call in (partial(env.get_attr, "n_robots"), partial(env.env_method, "snapshot")):
        with pytest.raises(IndexError, match=r"rows \[99\]"):
            call(indices=[99])
    assert env.env_is_wrapped(Monitor, indices=[0]) == [True]
    assert env.env_is_wrapped(VecMonitor, indices=0) == [False]


@BOTH
def test_evaluation_reports_true_returns_under_scaling(kind):
    env = kind("field_03", WORLDS, max_steps=7, roi_radius=0.0)
    actions = np.zeros((env.num_envs, *env.action_space.shape), np.float32)
    still = SimpleNamespace(predict=lambda *_, **__: (actions, None))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        returns, lengths = evaluate_policy(
            still, VecNormalize(env), n_eval_episodes=20, return_episode_rewards=True
        )
    robots = ROBOTS if kind is CentralizedVecEnv else 1
    assert returns == [-610.0 * robots] * 20
    assert lengths == [7] * 20


@pytest.mark.slow
def test_an_off_policy_algorithm_takes_the_joint_action():
    env = CentralizedVecEnv("field_03", 2, max_steps=10)
    model = TQC("MlpPolicy", env, learning_starts=8, batch_size=8, seed=0, device="cpu")
    model.learn(24)
    action, _ = model.predict(env.reset())
    assert action.shape == (2, ROBOTS, 2)
    # Time limits must not stop the bootstrapping.
    buffer = model.replay_buffer
    assert buffer.timeouts[9].all() and buffer.dones[9].all() and buffer.dones.sum() == 2


def test_a_central_learner_can_see_what_all_robots_see():
    settings = {"observation": "local", "seed": 5, **LIVELY}
    joint = CentralizedVecEnv("field_03", WORLDS, joint_observation=True, **settings)
    robots = SharedPolicyVecEnv("field_03", WORLDS, **settings)
    size = ROBOTS * robots.engine.obs_size
    assert joint.observation_space.shape == (size,)
    np.testing.assert_array_equal(joint.reset(), robots.reset().reshape(WORLDS, size))
    ended = 0
    for actions in forces(joint):
        seen, _, dones, infos = joint.step(actions)
        theirs, _, _, others = robots.step(actions.reshape(-1, 2))
        np.testing.assert_array_equal(seen, theirs.reshape(WORLDS, size))
        for row in np.flatnonzero(dones):
            last = [one["terminal_observation"] for one in others[ROBOTS * row :][:ROBOTS]]
            np.testing.assert_array_equal(infos[row]["terminal_observation"], np.concatenate(last))
            ended += 1
    assert ended
