"""Shared-policy PPO: the engine's rows and SuperSuit's, counted, recorded and kept alike."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from baselines.algorithms import find_algorithm
from baselines.policies.trained import load_trained
from baselines.runs.files import RunError, read_json, write_json
from baselines.runs.folder import RunFolder
from baselines.runs.tensors import write_tensors
from baselines.sb3.envs import engines, make_env
from baselines.sb3.policy import SB3Policy
from baselines.sb3.policy import load_policy as load_saved
from baselines.training.config import Task, TrainConfig
from baselines.training.run_logger import EpisodeWindow
from baselines.training.train import train
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field
from tests.support.runs import TinyRuns, recorded, same_policies, small_config

pytestmark = pytest.mark.slow

NAMES = ["ppo-shared", "ppo-supersuit"]
ROBOTS = 3


def make_rows(name: str, window: EpisodeWindow, **environment: Any) -> Any:
    config = TrainConfig(name, "field_03", environment=environment)
    hyperparameters = find_algorithm(name).resolve({"num_envs": 2, "normalize_observation": False})
    settings = {**hyperparameters.environment, **config.environment}
    return make_env(Task(config, load_field("field_03"), settings), hyperparameters, window)


def test_a_seed_decides_the_policy(tmp_path: Path, tiny_runs: TinyRuns) -> None:
    other = train(replace(small_config("ppo-shared"), seed=6), tmp_path / "other")
    assert not same_policies(other, tiny_runs.finished("ppo-shared"))  # its resumption is the same


def test_env_steps_are_steps_of_worlds(tmp_path: Path) -> None:
    model = {"n_steps": 16, "batch_size": 64, "policy_kwargs": {"net_arch": [8]}}
    budget: dict[str, Any] = {"steps": 128, "evaluate_every": 64, "episodes": 2}
    small = {"num_envs": 4, "model": model}
    short = {"max_steps": 20}
    config = TrainConfig(
        "ppo-shared", "field_03", **budget, environment=short, hyperparameters=small
    )
    run = train(config, tmp_path / "run")
    rows = recorded(run)["rows"]
    # Two rollouts of 4 worlds x 16 steps, although the library counts 384 steps of robots.
    assert [int(row["env_steps"]) for row in rows] == [64, 128]
    assert run.evaluation["env_steps"] == 128
    assert [entry["env_steps"] for entry in run.evaluations] == [64, 128]
    # After 16 steps no episode of 20 has ended, after 32 one of each world.
    assert [int(row["episodes"]) for row in rows] == [0, 4]
    assert not list(run.path.rglob("*.zip")) and not list(run.path.rglob("*.pkl"))


def test_the_learner_sees_scaled_shares_and_the_window_true_team_returns() -> None:
    for name in NAMES:
        window = EpisodeWindow()
        env = make_rows(name, window, max_steps=2, reward_sharing="individual")
        env.reset()
        still = np.zeros((2 * ROBOTS, 2), np.float32)
        first, second = (env.step(still)[1] for _ in range(2))
        # Two of the three robots start in an ROI: 10,000 - 10 each; then 100 for standing still.
        assert sorted(first[:ROBOTS]) == pytest.approx([-0.0005, 0.4995, 0.4995])
        assert second == pytest.approx([-0.005] * 2 * ROBOTS)
        row = window.pop()
        assert (row["episodes"], row["return_mean"], row["return_std"]) == (2, 19_670.0, 0.0)


def test_both_bridges_bring_the_same_rows_and_supersuit_hides_time_limits() -> None:
    windows = EpisodeWindow(), EpisodeWindow()
    native, bridged = (
        make_rows(name, window, max_steps=8) for name, window in zip(NAMES, windows, strict=True)
    )
    assert (len(engines(native)), len(engines(bridged))) == (1, 2)
    np.testing.assert_array_equal(native.reset(), bridged.reset())
    random = np.random.default_rng(0)
    for step in range(1, 25):
        actions = random.uniform(-1.0, 1.0, (2 * ROBOTS, 2)).astype(np.float32)
        ours, theirs = native.step(actions), bridged.step(actions)
        for mine, other in zip(ours[:3], theirs[:3], strict=True):
            np.testing.assert_array_equal(mine, other)
        assert ours[2].all() == (step % 8 == 0)
    seen = [[info.get("TimeLimit.truncated") for info in infos] for *_, infos in (ours, theirs)]
    assert seen == [[True] * 2 * ROBOTS, [None] * 2 * ROBOTS]
    assert windows[0].pop() == windows[1].pop()


def test_a_success_is_counted() -> None:
    window = EpisodeWindow()
    env = make_rows("ppo-shared", window, roi_radius=1000.0)  # the first step visits all ROIs
    env.reset()
    env.step(np.zeros((2 * ROBOTS, 2), np.float32))
    row = window.pop()
    assert (row["episodes"], row["success_rate"]) == (2, 1.0)


def test_a_saved_policy_acts_as_before(tmp_path: Path, tiny_runs: TinyRuns) -> None:
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
        assert {path.name for path in (tmp_path / name).iterdir()} == {
            *("policy.json", "policy.safetensors")
        }
        for deterministic in (True, False):
            acts = []
            for each in (one, load_saved(tmp_path / name)):
                torch.manual_seed(1)
                acts.append(each.act(seen, deterministic=deterministic))
            np.testing.assert_array_equal(*acts)
    # Each robot's action follows from its own observation, by the same network for all.
    turned = policy.act(seen[:, ::-1], deterministic=True)[:, ::-1]
    np.testing.assert_allclose(turned, mean, atol=1e-6)
    shape = read_json(tmp_path / "whole" / "policy.json")
    old = {name: shape[name] for name in ("obs_size", "arguments", "normalization")}
    write_json(tmp_path / "whole" / "policy.json", old)  # as an older version wrote it
    np.testing.assert_array_equal(
        load_saved(tmp_path / "whole").act(seen, deterministic=True), mean
    )


def test_a_damaged_policy_is_named(tmp_path: Path, tiny_runs: TinyRuns) -> None:
    shutil.copytree(tiny_runs.finished("ppo-shared").path, tmp_path / "run")
    run = RunFolder.open(tmp_path / "run")
    (run.policy / "checksums.json").unlink()
    write_tensors(run.policy / "policy.safetensors", {"log_std": torch.zeros(2)})
    with pytest.raises(RunError, match=r"policy\.safetensors"):
        load_trained(run)
    (run.policy / "policy.safetensors").write_bytes(b"nonsense")
    with pytest.raises(RunError, match=r"policy\.safetensors"):
        load_trained(run)


def test_what_makes_no_learner_is_said_before_the_folder_is_made(tmp_path: Path) -> None:
    wrong = {"model": {"n_steps": 1, "batch_size": 1}, "num_envs": 4}
    with pytest.raises(ConfigError):
        train(TrainConfig("ppo-shared", "field_03", hyperparameters=wrong), tmp_path / "run")
    assert not (tmp_path / "run").exists()
