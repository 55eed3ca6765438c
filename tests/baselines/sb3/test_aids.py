"""Training aids of the learners of Stable-Baselines3, what they observe, and where they stop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_wrapper

from baselines.evaluation.evaluate import evaluate
from baselines.policies.trained import load_trained
from baselines.sb3.config import load
from baselines.sb3.envs import ShrinkingRois, engines, make_env
from baselines.sb3.learner import Learner
from baselines.training import run_logger
from baselines.training.aids import RoiCurriculum
from baselines.training.config import TrainConfig
from baselines.training.run_logger import EpisodeWindow
from baselines.training.train import notes, prepare, train
from mbn_marl.adapters.sb3 import CentralizedVecEnv, NavigationVecEnv, SharedPolicyVecEnv
from mbn_marl.errors import ConfigError
from tests.support.runs import recorded

pytestmark = pytest.mark.slow

WORLDS = 64
LIVELY = {"safety_distance": 50.0, "random_starts": True, "max_steps": 10, "seed": 2, "threads": 1}
"""Settings under which some worlds have a collision while others still run."""
AIDS: dict[str, Any] = {
    **{"action_repeat": [2, 1], "action_repeat_until": 0.5, "episode_steps": 24},
    # Whatever the team does is enough for the next stage.
    **{"roi_radius": 4.0, "roi_stages": 2, "roi_success": [0.0, 0.0]},
}


def config_of(name: str, **changes: Any) -> TrainConfig:
    """Rollouts of 8 decisions in 4 worlds."""
    model = {"n_steps": 8, "policy_kwargs": {"net_arch": [8]}}
    if name != "a2c":
        model["batch_size"] = 32
    hyperparameters = {"num_envs": 4, "model": model, **AIDS, **changes}
    how: dict[str, Any] = {"steps": 256, "evaluate_every": 100, "episodes": 2}
    how["environment"] = {"safety_distance": 0.0}  # no collisions
    return TrainConfig(name, "field_03", hyperparameters=hyperparameters, **how)


@pytest.mark.parametrize("kind", [CentralizedVecEnv, SharedPolicyVecEnv])
def test_a_change_of_size_truncates_the_episodes_that_run(kind: type[NavigationVecEnv]) -> None:
    made: list[NavigationVecEnv] = []

    def make(curriculum: RoiCurriculum) -> VecEnv:
        made.append(kind("field_03", WORLDS, roi_radius=10.0 * curriculum.radius, **LIVELY))
        return made[-1]

    plain = kind("field_03", WORLDS, roi_radius=40.0, **LIVELY)
    curriculum = RoiCurriculum(4.0, stages=2, bounds=(0.0, 0.0), window=plain.num_envs)
    env = ShrinkingRois(make, curriculum, every=11)
    np.testing.assert_array_equal(env.reset(), plain.reset())
    shape = (11, env.num_envs, *env.action_space.shape)
    for actions in np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32):
        # Every world's episode has ended after ten steps, but a rollout has eleven.
        assert len(made) == 1 and curriculum.radius == 4.0
        observations, rewards, dones, infos = env.step(actions)
        last, expected, ended, others = plain.step(actions)
        np.testing.assert_array_equal(rewards, expected)
    assert [one.engine.config.roi_radius for one in made] == [40.0, 20.0]
    assert env.unwrapped is made[1] and curriculum.radius == 2.0
    np.testing.assert_array_equal(observations, make(curriculum).reset())
    assert dones.all() and 0 < ended.sum() < len(ended)
    for row, info in enumerate(infos):
        if ended[row]:  # by itself: what it was is left
            assert info["TimeLimit.truncated"] == others[row]["TimeLimit.truncated"]
            assert info["success"] == others[row]["success"]
            last_seen = others[row]["terminal_observation"]
        else:
            assert info["TimeLimit.truncated"] and "episode" not in info
            last_seen = last[row]
        np.testing.assert_array_equal(info["terminal_observation"], last_seen)
    assert not all(info["TimeLimit.truncated"] for info in infos)


@pytest.mark.parametrize("name", ["ppo", "ppo-shared"])
def test_decisions_become_shorter_and_rois_smaller_over_the_budget(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    remaining: list[float] = []
    begin_rollout = Learner.begin_rollout

    def keep(self: Learner) -> None:
        remaining.append(self.model._current_progress_remaining)
        begin_rollout(self)

    monkeypatch.setattr(Learner, "begin_rollout", keep)
    monkeypatch.setattr(run_logger, "ROW_STEPS", 1)
    config = config_of(name)
    run = train(config, tmp_path / "run")
    rows = recorded(run)["rows"]
    # Two env-steps a decision until half of the budget, then one.
    assert [int(row["env_steps"]) for row in rows] == [64, 128, 160, 192, 224, 256]
    assert remaining == [1.0, 0.75, 0.5, 0.375, 0.25, 0.125]  # of the library's schedules
    assert run.evaluation["env_steps"] == 256 and notes(config) == []
    # Episodes of 24 steps end in the second rollout (after 32), and 24 steps later in the fifth.
    assert [int(row["episodes"]) for row in rows] == [0, 4, 0, 0, 4, 0]
    assert [float(row["roi_radius"]) for row in rows] == [4.0, 2.0, 2.0, 2.0, 1.0, 1.0]
    assert run.config["environment"]["roi_radius"] == 10.0
    assert min(run.evaluation["deterministic"]["per_episode"]["steps"]) > 24


def test_robots_are_scattered_in_a_share_of_the_worlds() -> None:
    task, hyperparameters = prepare(config_of("ppo", scattered=0.25))
    (engine,) = engines(make_env(task, hyperparameters, EpisodeWindow()))
    assert engine.fields[:3] == (task.field,) * 3 and engine.fields[3] != task.field


@pytest.mark.parametrize(("name", "stride"), [("ppo", 1), ("ppo-shared", 3)])
def test_a_decision_is_discounted_once_for_each_step(name: str, stride: int) -> None:
    learner = Learner(*prepare(config_of(name)), EpisodeWindow())
    for env_steps, repeat in ((0, 2), (64, 2), (128, 1)):
        learner.model.num_timesteps = env_steps * stride
        learner.begin_rollout()
        assert learner.model.get_env().get_attr("action_repeat") == [repeat] * 4 * stride
        assert learner.model.gamma == learner.model.rollout_buffer.gamma == 0.99**repeat


def test_a_policy_of_all_robots_observations_is_kept_and_evaluated(tmp_path: Path) -> None:
    run = train(config_of("ppo", joint_observation=True), tmp_path / "run")
    policy = load_trained(run)
    assert policy.observes == "observations"
    how = {"episodes": 2, "deterministic": True}
    again = evaluate(policy, run.field, run.config["environment"], **how)
    assert again.to_json() == run.evaluation["deterministic"]
    with pytest.raises(ConfigError, match="observation: "):
        evaluate(policy, run.field, {"observation": "lidar"}, **how)


def test_other_learners_refuse_aids() -> None:
    aids = {"action_repeat": [2, 2], "roi_radius": 2.0, "scattered": 0.5, "episode_steps": 5}
    for name in ("ars", "tqc", "ppo-supersuit"):
        with pytest.raises(ConfigError) as caught:
            load(name, "N", aids)
        assert sorted(one.partition(":")[0] for one in caught.value.problems) == sorted(aids)
        load(name, "N", {"action_repeat": [1, 1], "roi_radius": 1.0, "episode_steps": None})
    with pytest.raises(ConfigError, match="joint_observation: "):  # of a central learner alone
        load("ppo-shared", "N", {"joint_observation": True})


@pytest.mark.parametrize(
    ("name", "joint", "settings", "seen"),
    [
        ("ppo", False, {}, "state"),
        ("ppo", True, {"n_robots": 1}, "observations"),
        # With headings and flags.
        ("ppo", False, {"dynamics": "unicycle", "failures": {"rate": 0.1}}, "state"),
        ("ppo-shared", False, {}, "observations"),
    ],
)
def test_a_policy_knows_what_it_observes(
    name: str, joint: bool, settings: dict[str, Any], seen: str
) -> None:
    aids = {} if name == "ppo-shared" else {"joint_observation": joint}
    config = TrainConfig(
        name, "field_03", num_envs=2, hyperparameters=aids, environment=settings, steps=1
    )
    policy = Learner(*prepare(config), EpisodeWindow()).policy
    assert policy.observes == seen
    size = policy.shape["obs_size"]
    robots = settings.get("n_robots", 3)
    rows = (2, robots, size // robots if joint else size) if seen == "observations" else (2, size)
    assert policy.act(np.zeros(rows, np.float32), deterministic=True).shape == (2, robots, 2)


@pytest.mark.parametrize("name", ["a2c", "ars"])
def test_an_evaluation_is_of_the_policy_after_the_update(name: str, tmp_path: Path) -> None:
    fast = {"model": {"learning_rate": 1.0}}
    how: dict[str, Any] = {"evaluate_every": 100, "episodes": 1, "hyperparameters": fast}
    runs = [
        train(
            TrainConfig(name, "field_03", "A", steps=steps, environment={"max_steps": 50}, **how),
            tmp_path / str(steps),
        )
        for steps in (1000, 100)
    ]
    during, (last,) = runs[0].evaluations[0], runs[1].evaluations
    assert during["env_steps"] == last["env_steps"]
    assert during["deterministic_return_mean"] == last["deterministic_return_mean"]


def test_every_stage_of_the_curriculum_draws_other_starts() -> None:
    task, hyperparameters = prepare(config_of("ppo"))
    settings = {**task.settings, "random_starts": True}
    env = make_env(replace(task, settings=settings), hyperparameters, EpisodeWindow())
    starts = [env.reset()]
    for _ in range(2):
        rois = unwrap_vec_wrapper(env, ShrinkingRois)
        assert rois is not None
        rois.curriculum.add([1.0] * rois.curriculum.window)
        assert rois.curriculum.move()
        starts.append(rois.begin(rois.curriculum))
    places = [states[:, :6] for states in starts]
    assert not any(np.array_equal(places[0], others) for others in places[1:])
    assert not np.array_equal(places[1], places[2])
