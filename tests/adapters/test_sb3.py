"""The Stable-Baselines3 environments: equality with the engine, its conventions, and training."""

import warnings
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from mbn_marl import centralized_env
from mbn_marl.adapters.sb3 import CentralizedVecEnv, NavigationVecEnv, SharedPolicyVecEnv
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ActionError, ConfigError, MbnError, StepError

WORLDS, ROBOTS, STEPS = 5, 3, 60
LIVELY = {"max_steps": 25, "safety_distance": 50.0, "random_starts": True}
"""Settings under which random robots soon collide, or else run out of time."""

BOTH = pytest.mark.parametrize("kind", [CentralizedVecEnv, SharedPolicyVecEnv])


def forces(env: NavigationVecEnv, steps: int = STEPS) -> np.ndarray:
    """Random actions, ``(steps, *batch of actions)``, the same on every call."""
    shape = (steps, env.num_envs, *env.action_space.shape)
    return np.random.default_rng(0).uniform(-1.2, 1.2, shape).astype(np.float32)


def by_row(env: NavigationVecEnv, of_worlds: np.ndarray) -> np.ndarray:
    return np.repeat(of_worlds, env.num_envs // WORLDS, axis=0)


def observed(env: NavigationVecEnv, engine: BatchEngine, observations: np.ndarray) -> np.ndarray:
    """Return the expected observations of the rows of ``env``, from an engine in its state."""
    if isinstance(env, CentralizedVecEnv):
        return engine.state()
    return observations.reshape(env.num_envs, -1)


@pytest.mark.filterwarnings("error")
def test_sb3_check_env() -> None:
    for settings in ({}, {"field": "field_10", "n_robots": 2, "reward": "formal", "max_steps": 20}):
        check_env(centralized_env(**settings))


@BOTH
def test_spaces(kind: type[NavigationVecEnv]) -> None:
    env = kind("field_03", WORLDS)
    central = kind is CentralizedVecEnv
    assert env.num_envs == (WORLDS if central else WORLDS * ROBOTS)
    shape = (ROBOTS, 2) if central else (2,)
    assert env.action_space == spaces.Box(-1.0, 1.0, shape, np.float32)
    assert env.observation_space.shape == ((4 * ROBOTS + 1,) if central else (env.engine.obs_size,))
    observations = env.reset()
    assert all(env.observation_space.contains(row) for row in observations)
    for actions in forces(env, 5):
        observations, rewards, dones, _ = env.step(actions)
        assert all(env.observation_space.contains(row) for row in observations)
        assert (rewards.dtype, dones.dtype) == (np.float32, np.bool_)


def test_centralized_observations_keep_the_engines_precision() -> None:
    env = CentralizedVecEnv("field_03", 2, dtype="float64")
    assert env.observation_space.dtype == env.reset().dtype == np.float64


@BOTH
def test_steps_are_the_engines(kind: type[NavigationVecEnv]) -> None:
    """Also that nothing leaks across a reset, against an engine that is reset by hand."""
    env = kind("field_03", WORLDS, seed=5, **LIVELY)
    engine = BatchEngine("field_03", WORLDS, seed=5, autoreset="disabled", **LIVELY)
    np.testing.assert_array_equal(env.reset(), observed(env, engine, engine.reset()))
    seen = {"terminated": 0, "truncated": 0}
    for actions in forces(env):
        observations, rewards, dones, infos = env.step(actions)
        last, own, terminated, truncated = engine.step(actions.reshape(WORLDS, ROBOTS, 2))
        last = observed(env, engine, last).copy()
        expected = engine.team_rewards if kind is CentralizedVecEnv else own.reshape(-1)
        np.testing.assert_array_equal(rewards, expected)
        np.testing.assert_array_equal(dones, by_row(env, terminated | truncated))
        timeouts = by_row(env, truncated & ~terminated)
        assert [info["TimeLimit.truncated"] for info in infos] == timeouts.tolist()
        assert [len(info) > 1 for info in infos] == dones.tolist()
        check_final_infos(env, infos, dones, engine.metrics())
        for row in np.flatnonzero(dones):
            np.testing.assert_array_equal(infos[row]["terminal_observation"], last[row])
        seen["terminated"] += terminated.sum()
        seen["truncated"] += truncated.sum()
        following = engine.reset_worlds(terminated | truncated)
        np.testing.assert_array_equal(observations, observed(env, engine, following))
    assert min(seen.values()) > 0


def check_final_infos(
    env: NavigationVecEnv,
    infos: list[dict[str, Any]],
    dones: np.ndarray,
    metrics: dict[str, np.ndarray],
) -> None:
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
def test_all_that_is_returned_is_the_callers(kind: type[NavigationVecEnv]) -> None:
    """No later step changes a result, and changing every result changes no later step."""
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
def test_seed_takes_effect_at_the_next_reset(kind: type[NavigationVecEnv]) -> None:
    env = kind("field_03", WORLDS, seed=1, random_starts=True)
    expected = kind("field_03", WORLDS, seed=9, random_starts=True)
    first, (second, third) = env.reset(), (expected.reset(), expected.reset())
    assert (first != second).any() and (second != third).any()
    env.seed(9)
    np.testing.assert_array_equal(env.reset(), second)
    np.testing.assert_array_equal(env.reset(), third)


@BOTH
def test_bad_calls_are_refused_before_anything_moves(kind: type[NavigationVecEnv]) -> None:
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
        (lambda: kind("field_03", WORLDS, max_step=3), ConfigError, "max_step: "),
        (lambda: kind("field_03", WORLDS, action_repeat=0), ConfigError, "action_repeat: "),
        (lambda: env.set_attr("action_repeat", 0), ConfigError, "action_repeat: "),
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


@BOTH
def test_attributes_and_methods(kind: type[NavigationVecEnv]) -> None:
    env = kind("field_03", WORLDS)
    env.reset()
    assert env.render_mode is None
    assert env.get_attr("n_robots") == [ROBOTS] * env.num_envs
    assert env.get_attr("num_envs", indices=[0, 2]) == [env.num_envs] * 2
    assert not env.has_attr("missing")
    env.set_attr("label", "mine")
    assert env.get_attr("label", indices=1) == ["mine"]
    shots = env.env_method("snapshot", indices=[env.num_envs - 1])
    assert [shot.field.name for shot in shots] == ["field_03"]
    with pytest.raises(AttributeError):
        env.env_method("missing")
    assert env.env_is_wrapped(Monitor, indices=[0]) == [True]
    assert env.env_is_wrapped(VecMonitor, indices=[0, 1]) == [False, False]


class Still:
    """A model for ``evaluate_policy`` that applies no force."""

    def __init__(self, env: NavigationVecEnv) -> None:
        self.actions = np.zeros((env.num_envs, *env.action_space.shape), np.float32)

    def predict(self, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        return self.actions, None


@BOTH
def test_evaluation_reports_true_returns_under_scaling(kind: type[NavigationVecEnv]) -> None:
    """Standing still for 7 steps costs r_s once and r_m six times, for each robot."""
    env = kind("field_03", WORLDS, max_steps=7, roi_radius=0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        returns, lengths = evaluate_policy(
            Still(env), VecNormalize(env), n_eval_episodes=20, return_episode_rewards=True
        )
    robots = ROBOTS if kind is CentralizedVecEnv else 1
    assert returns == [-610.0 * robots] * 20
    assert lengths == [7] * 20


def train(kind: type[NavigationVecEnv], seed: int) -> PPO:
    torch.set_num_threads(1)
    env = VecNormalize(kind("field_03", 4, **LIVELY))
    options = {"n_steps": 32, "batch_size": 64, "n_epochs": 2, "device": "cpu"}
    return PPO("MlpPolicy", env, seed=seed, **options).learn(32 * env.num_envs * 2)


@pytest.mark.slow
@BOTH
def test_seeded_ppo_gives_bit_equal_weights(kind: type[NavigationVecEnv]) -> None:
    first, again, other = (train(kind, seed) for seed in (0, 0, 1))
    weights = [list(model.policy.parameters()) for model in (first, again, other)]
    assert all(torch.equal(a, b) for a, b in zip(*weights[:2], strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(*weights[::2], strict=True))
    assert len(first.ep_info_buffer) > 0 and len(first.ep_success_buffer) > 0


@pytest.mark.slow
def test_an_off_policy_algorithm_takes_the_joint_action() -> None:
    env = CentralizedVecEnv("field_03", 2, max_steps=10)
    model = TQC("MlpPolicy", env, learning_starts=8, batch_size=8, seed=0, device="cpu")
    model.learn(24)
    action, _ = model.predict(env.reset())
    assert action.shape == (2, ROBOTS, 2)
    # Time limits must not stop the bootstrapping.
    buffer = model.replay_buffer
    assert buffer.timeouts[9].all() and buffer.dones[9].all() and buffer.dones.sum() == 2


@BOTH
def test_a_repeated_action_is_several_steps_that_stop_at_the_end(
    kind: type[NavigationVecEnv],
) -> None:
    """Against an environment that is stepped by hand: sums until the end, then a new episode."""
    env = kind("field_03", WORLDS, seed=5, action_repeat=3, **LIVELY)
    engine = BatchEngine("field_03", WORLDS, seed=5, autoreset="disabled", **LIVELY)
    env.reset(), engine.reset()
    middle = 0
    for number, actions in enumerate(forces(env, 30)):
        repeat = 3 if number < 15 else 2
        env.set_attr("action_repeat", repeat)
        observations, rewards, dones, infos = env.step(actions)
        expected, running = np.zeros(env.num_envs), np.ones(WORLDS, bool)
        for step in range(repeat):
            last, own, terminated, truncated = engine.step(
                actions.reshape(WORLDS, ROBOTS, 2), running
            )
            single = engine.team_rewards if kind is CentralizedVecEnv else own.reshape(-1)
            expected += single
            ended = terminated | truncated
            assert not (ended & ~running).any()
            check_final_infos(env, infos, by_row(env, ended), engine.metrics())
            last = observed(env, engine, last)
            for row in np.flatnonzero(by_row(env, ended)):
                np.testing.assert_array_equal(infos[row]["terminal_observation"], last[row])
                timeout = (truncated & ~terminated)[row * WORLDS // env.num_envs]
                assert infos[row]["TimeLimit.truncated"] == timeout
            running &= ~ended
            middle += int(ended.sum()) if step < repeat - 1 else 0
        np.testing.assert_array_equal(dones, by_row(env, ~running))
        np.testing.assert_allclose(rewards, expected, rtol=1e-6)
        following = engine.reset_worlds(~running)
        np.testing.assert_array_equal(observations, observed(env, engine, following))
    assert middle > 5


def test_a_central_learner_can_see_what_all_robots_see() -> None:
    settings: dict[str, Any] = {"observation": "local", "seed": 5, **LIVELY}
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
        assert all(joint.observation_space.contains(row) for row in seen)
        for row in np.flatnonzero(dones):
            last = [one["terminal_observation"] for one in others[ROBOTS * row :][:ROBOTS]]
            np.testing.assert_array_equal(infos[row]["terminal_observation"], np.concatenate(last))
            ended += 1
    assert ended > 0
