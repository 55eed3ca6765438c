"""Shared-policy PPO: a row for each robot, counted, recorded and kept."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from baselines.algorithms import find_algorithm
from baselines.evaluation.policy import load_trained
from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.runs.tensors import write_tensors
from baselines.sb3.envs import make_env
from baselines.sb3.policy import SB3Policy, load_policy
from baselines.training.config import Task, TrainConfig
from baselines.training.run_logger import EpisodeWindow
from baselines.training.train import train
from mbn_marl.field import load_field
from tests.support.runs import TinyRuns, recorded, same_policies, small_config

pytestmark = pytest.mark.slow

ROBOTS = 3


def test_another_seed_makes_another_policy(tmp_path: Path, tiny_runs: TinyRuns) -> None:
    other = train(replace(small_config("ppo-shared"), seed=6), tmp_path / "other")
    assert not same_policies(other, tiny_runs.finished("ppo-shared"))


def test_env_steps_are_steps_of_worlds(tmp_path: Path) -> None:
    model = {"n_steps": 16, "batch_size": 64, "policy_kwargs": {"net_arch": [8]}}
    how: dict[str, Any] = {"steps": 128, "evaluate_every": 64, "episodes": 2}
    how |= {"environment": {"max_steps": 20}, "hyperparameters": {"num_envs": 4, "model": model}}
    run = train(TrainConfig("ppo-shared", "field_03", **how), tmp_path / "run")
    rows = recorded(run)["rows"]
    # Two rollouts of 4 worlds x 16 steps, although the library counts 384 steps of robots.
    assert [int(row["env_steps"]) for row in rows] == [64, 128]
    assert run.evaluation["env_steps"] == 128
    assert [entry["env_steps"] for entry in run.evaluations] == [64, 128]
    # After 16 steps no episode of 20 has ended, after 32 one of each world.
    assert [int(row["episodes"]) for row in rows] == [0, 4]
    assert not list(run.path.rglob("*.zip")) and not list(run.path.rglob("*.pkl"))


@pytest.mark.parametrize(
    ("name", "settings", "rewards", "row"),
    [
        # Two of the three robots start in an ROI: 10,000 - 10 each; then 100 for standing still.
        ("ppo-shared", {}, [[-0.0005, 0.4995, 0.4995] * 2, [-0.005] * 6], (2, 19_670.0, 0.0)),
        ("ppo", {}, [[0.9985] * 2, [-0.015] * 2], (2, 19_670.0, 0.0)),
        # The first step visits all ROIs.
        ("ppo-shared", {"roi_radius": 1000.0}, [], (2, None, 1.0)),
    ],
)
def test_learner_sees_scaled_rewards_and_the_window_true_team_returns(
    name: str, settings: dict[str, Any], rewards: list[list[float]], row: tuple[Any, ...]
) -> None:
    window = EpisodeWindow()
    config = TrainConfig(name, "field_03", environment={"max_steps": 2, **settings})
    changes: dict[str, Any] = {"num_envs": 2, "normalize_observation": False}
    hyperparameters = find_algorithm(name).resolve(changes)
    settings = {**hyperparameters.environment, **config.environment}
    env = make_env(Task(config, load_field("field_03"), settings), hyperparameters, window)
    env.reset()
    still = np.zeros((env.num_envs, *env.action_space.shape), np.float32)
    for expected in rewards or [[]]:
        found = env.step(still)[1]
        assert not expected or sorted(found[:ROBOTS]) == pytest.approx(sorted(expected[:ROBOTS]))
    seen = window.pop()
    assert (seen["episodes"], seen["success_rate"]) == (row[0], row[2])
    assert row[1] is None or (seen["return_mean"], seen["return_std"]) == (row[1], 0.0)


def test_saved_policy_acts_as_before(tmp_path: Path, tiny_runs: TinyRuns) -> None:
    policy = load_trained(tiny_runs.finished("ppo-shared"))
    assert isinstance(policy, SB3Policy) and policy.normalization is not None
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (5, ROBOTS, 33)).astype(np.float32)
    mean = policy.act(seen, deterministic=True)
    assert mean.shape == (5, ROBOTS, 2)
    raw = SB3Policy(policy.network, policy.shape, None)
    assert not np.array_equal(raw.act(seen, deterministic=True), mean)
    for name, one in (("whole", policy), ("raw", raw)):
        (tmp_path / name).mkdir()
        one.save(tmp_path / name)
        written = {path.name for path in (tmp_path / name).iterdir()}
        assert written == {"policy.json", "policy.safetensors"}
        for deterministic in (True, False):
            acts = []
            for each in (one, load_policy(tmp_path / name)):
                torch.manual_seed(1)
                acts.append(each.act(seen, deterministic=deterministic))
            np.testing.assert_array_equal(*acts)
    # Each robot's action follows from its own observation, by the same network for all.
    turned = policy.act(seen[:, ::-1], deterministic=True)[:, ::-1]
    np.testing.assert_allclose(turned, mean, atol=1e-6)


def test_damaged_policy_is_named(tmp_path: Path, tiny_runs: TinyRuns) -> None:
    shutil.copytree(tiny_runs.finished("ppo-shared").path, tmp_path / "run")
    run = RunFolder.open(tmp_path / "run")
    (run.policy / "checksums.json").unlink(missing_ok=True)
    weights = run.policy / "policy.safetensors"
    for damage in (
        lambda: write_tensors(weights, {"log_std": torch.zeros(2)}),
        lambda: weights.write_bytes(b"nonsense"),
        weights.unlink,
    ):
        damage()
        with pytest.raises(RunError, match=r"policy\.safetensors"):
            load_trained(run)
