"""Learners of Stable-Baselines3: their worlds, training aids, policies; rows of robots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from baselines.evaluation.evaluate import evaluate
from baselines.policies.load import load_trained
from baselines.sb3.config import load
from baselines.sb3.trainer import Learner, TrainingWorlds, make_env
from baselines.training import aids, run_logger
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
AIDS: dict[str, Any] = {"action_repeat": [2, 1], "episode_steps": 24, "roi_radius": 4.0}


@pytest.fixture
def two_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aids, "STAGES", 2)
    monkeypatch.setattr(aids, "SUCCESS", (0.0, 0.0))


def config_of(name: str, **changes: Any) -> TrainConfig:
    model = {"n_steps": 8, "policy_kwargs": {"net_arch": [8]}}
    if name != "a2c":
        model["batch_size"] = 32
    how: dict[str, Any] = {"steps": 256, "evaluate_every": 100, "episodes": 2}
    how["hyperparameters"] = {"num_envs": 4, "model": model, **AIDS, **changes}
    return TrainConfig(name, "field_03", environment={"safety_distance": 0.0}, **how)


@pytest.mark.usefixtures("two_stages")
@pytest.mark.parametrize("kind", [CentralizedVecEnv, SharedPolicyVecEnv])
def test_change_of_size_truncates_the_episodes_that_run(kind: type[NavigationVecEnv]) -> None:
    made: list[NavigationVecEnv] = []

    def make(curriculum: RoiCurriculum) -> NavigationVecEnv:
        made.append(kind("field_03", WORLDS, roi_radius=10.0 * curriculum.radius, **LIVELY))
        return made[-1]

    plain = kind("field_03", WORLDS, roi_radius=40.0, **LIVELY)
    curriculum = RoiCurriculum(4.0, window=WORLDS)
    env = TrainingWorlds(make, curriculum, EpisodeWindow())
    env.every = 11
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


@pytest.mark.usefixtures("two_stages")
@pytest.mark.parametrize(("name", "stride"), [("ppo", 1), ("ppo-shared", 3)])
def test_decisions_become_shorter_and_rois_smaller_over_the_budget(
    name: str, stride: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[float, float, list[int]]] = []
    begin_rollout = Learner.begin_rollout

    def keep(self: Learner) -> None:
        begin_rollout(self)
        model = self.model
        assert model.gamma == model.rollout_buffer.gamma
        repeats = model.get_env().get_attr("action_repeat")
        seen.append((model._current_progress_remaining, model.gamma, repeats))

    monkeypatch.setattr(Learner, "begin_rollout", keep)
    monkeypatch.setattr(run_logger, "ROW_STEPS", 1)
    config = config_of(name)
    run = train(config, tmp_path / "run")
    rows = recorded(run)["rows"]
    # Two env-steps a decision at first, one after: each discounts once.
    assert [int(row["env_steps"]) for row in rows] == [64, 96, 128, 160, 192, 224, 256]
    remaining = [1.0, 0.75, 0.625, 0.5, 0.375, 0.25, 0.125]  # of the library's schedules
    repeats = [2, 1, 1, 1, 1, 1, 1]
    assert seen == [
        (rest, 0.99**repeat, [repeat] * 4 * stride)
        for rest, repeat in zip(remaining, repeats, strict=True)
    ]
    assert run.evaluation["env_steps"] == 256 and notes(config) == []
    # Episodes of 24 steps end in the second rollout (at 24 of 32), and two rollouts later.
    assert [int(row["episodes"]) for row in rows] == [0, 4, 0, 0, 4, 0, 0]
    assert [float(row["roi_radius"]) for row in rows] == [4.0, 2.0, 2.0, 2.0, 1.0, 1.0, 1.0]
    assert run.config["environment"]["roi_radius"] == 10.0
    assert min(run.evaluation["deterministic"]["per_episode"]["steps"]) > 24


def test_policy_of_all_robots_observations_is_kept_and_evaluated(tmp_path: Path) -> None:
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
    for name in ("ars", "tqc"):
        with pytest.raises(ConfigError) as caught:
            load(name, "N", aids)
        assert sorted(one.partition(":")[0] for one in caught.value.problems) == sorted(aids)
        load(name, "N", {"action_repeat": [1, 1], "roi_radius": 1.0, "episode_steps": None})
    with pytest.raises(ConfigError, match="joint_observation: "):  # of a central learner alone
        load("ppo-shared", "N", {"joint_observation": True})


@pytest.mark.parametrize("name", ["a2c", "ars"])
def test_evaluation_is_of_the_policy_after_the_update(name: str, tmp_path: Path) -> None:
    how: dict[str, Any] = {"evaluate_every": 100, "episodes": 1}
    how |= {"hyperparameters": {"model": {"learning_rate": 1.0}}, "environment": {"max_steps": 50}}
    runs = [
        train(TrainConfig(name, "field_03", "A", steps=steps, **how), tmp_path / str(steps))
        for steps in (1000, 100)
    ]
    during, (last,) = runs[0].evaluations[0], runs[1].evaluations
    assert during["env_steps"] == last["env_steps"]
    assert during["deterministic_return_mean"] == last["deterministic_return_mean"]


ROBOTS = 3


def test_learner_sees_scaled_rewards_and_the_window_true_team_returns() -> None:
    changes: dict[str, Any] = {"num_envs": 2, "normalize_observation": False}
    rows = []
    for settings in ({"max_steps": 2}, {"roi_radius": 1000.0}):
        window, rewards = EpisodeWindow(), []
        config = TrainConfig(
            "ppo-shared", "field_03", environment=settings, hyperparameters=changes
        )
        env, _ = make_env(*prepare(config), window)
        env.reset()
        for _ in range(settings.get("max_steps", 1)):
            rewards.append(env.step(np.zeros((2 * ROBOTS, 2), np.float32))[1])
        row = window.pop()
        rows.append((row["episodes"], row["success_rate"], row["return_mean"], row["return_std"]))
        if "max_steps" in settings:
            # Two of three robots start in an ROI: 10,000 - 10 each; then 100 for standing still.
            assert sorted(rewards[0][:ROBOTS]) == pytest.approx([-0.0005, 0.4995, 0.4995])
            assert rewards[1] == pytest.approx([-0.005] * 2 * ROBOTS)
    assert rows[0] == (2, 0.0, 19_670.0, 0.0) and rows[1][:2] == (2, 1.0)
