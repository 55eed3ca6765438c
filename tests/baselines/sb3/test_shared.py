"""Shared-policy PPO: the engine's rows and SuperSuit's, counted, recorded and kept alike."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from baselines.algorithms import find_algorithm
from baselines.cli import main
from baselines.evaluation.policy import load_trained
from baselines.runs.files import RunError
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

NAMES = ["ppo-shared", "ppo-supersuit"]
BOTH = pytest.mark.parametrize("name", NAMES)
ROBOTS = 3
SMALL: dict[str, Any] = {
    "num_envs": 4,
    "model": {"n_steps": 16, "batch_size": 64, "policy_kwargs": {"net_arch": [8]}},
}


def config_of(name: str, **changes: Any) -> TrainConfig:
    environment = {"max_steps": 20, **changes.pop("environment", {})}
    hyperparameters = {**SMALL, **changes.pop("hyperparameters", {})}
    return TrainConfig(
        name,
        "field_03",
        steps=128,
        evaluate_every=64,
        episodes=2,
        environment=environment,
        hyperparameters=hyperparameters,
        **changes,
    )


def weights_of(run: RunFolder) -> dict[str, torch.Tensor]:
    policy: Any = load_trained(run)
    return dict(policy.network.state_dict())


def make_rows(name: str, window: EpisodeWindow, **environment: Any) -> Any:
    config = config_of(name, environment=environment)
    hyperparameters = find_algorithm(name).resolve({"num_envs": 2, "normalize_observation": False})
    settings = {**hyperparameters.environment, **config.environment}
    return make_env(Task(config, load_field("field_03"), settings), hyperparameters, window)


@BOTH
def test_a_seed_decides_the_policy(name: str, tmp_path: Path) -> None:
    first, again = (
        train(config_of(name, seed=5), tmp_path / folder) for folder in ("first", "again")
    )
    other = train(config_of(name, seed=6), tmp_path / "other")
    ours, theirs, others = weights_of(first), weights_of(again), weights_of(other)
    assert all(torch.equal(ours[key], theirs[key]) for key in ours)
    assert not all(torch.equal(ours[key], others[key]) for key in ours)
    assert first.evaluation["stochastic"] == again.evaluation["stochastic"]


@BOTH
def test_env_steps_are_steps_of_worlds(name: str, tmp_path: Path) -> None:
    run = train(config_of(name), tmp_path / "run")
    with run.progress.open(newline="") as file:
        rows = list(csv.DictReader(file))
    # Two rollouts of 4 worlds x 16 steps, although the library counts 384 steps of robots.
    assert [int(row["env_steps"]) for row in rows] == [64, 128]
    assert run.evaluation["env_steps"] == 128
    assert [entry["env_steps"] for entry in run.evaluations] == [64, 128]
    # After 16 steps no episode of 20 has ended, after 32 one of each world.
    assert [int(row["episodes"]) for row in rows] == [0, 4]
    assert not list(run.path.rglob("*.zip")) and not list(run.path.rglob("*.pkl"))


@BOTH
def test_the_learner_sees_scaled_shares_and_the_window_true_team_returns(name: str) -> None:
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


def test_both_bridges_bring_the_same_rows() -> None:
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
    assert windows[0].pop() == windows[1].pop()


@BOTH
def test_a_success_is_counted(name: str) -> None:
    window = EpisodeWindow()
    env = make_rows(name, window, roi_radius=1000.0)  # all ROIs are visited in the first step
    env.reset()
    env.step(np.zeros((2 * ROBOTS, 2), np.float32))
    row = window.pop()
    assert (row["episodes"], row["success_rate"]) == (2, 1.0)


def test_only_supersuit_hides_time_limits() -> None:
    seen = []
    for name in NAMES:
        env = make_rows(name, EpisodeWindow(), max_steps=1)
        env.reset()
        *_, dones, infos = env.step(np.zeros((2 * ROBOTS, 2), np.float32))
        assert dones.all()
        seen.append([info.get("TimeLimit.truncated") for info in infos])
    assert seen == [[True] * 2 * ROBOTS, [None] * 2 * ROBOTS]


@pytest.mark.parametrize("max_steps", [1000, 20])
def test_the_bridges_differ_by_the_time_limits_alone(max_steps: int, tmp_path: Path) -> None:
    ours, theirs = (
        weights_of(train(config_of(name, environment={"max_steps": max_steps}), tmp_path / name))
        for name in NAMES
    )
    equal = all(torch.equal(ours[key], theirs[key]) for key in ours)
    assert equal == (max_steps > 128 // SMALL["num_envs"])


@pytest.mark.parametrize("normalized", [True, False])
def test_a_saved_policy_acts_as_before(normalized: bool, tmp_path: Path) -> None:
    config = config_of("ppo-shared", hyperparameters={"normalize_observation": normalized})
    run = train(config, tmp_path / "run")
    names = {"checksums.json", "policy.json", "policy.safetensors", "learner.safetensors"}
    assert {path.name for path in run.policy.iterdir()} == names
    policy = load_trained(run)
    assert isinstance(policy, SB3Policy)
    assert (policy.normalization is not None) == normalized
    policy.save(tmp_path)
    assert not (tmp_path / "learner.safetensors").exists()
    copy = load_saved(tmp_path)
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (5, ROBOTS, 33)).astype(np.float32)
    acts = []
    for one in (policy, copy):
        torch.manual_seed(1)
        acts.append([one.act(seen, deterministic=chosen) for chosen in (True, False)])
    np.testing.assert_array_equal(acts[0], acts[1])
    assert acts[0][0].shape == (5, ROBOTS, 2)
    raw = SB3Policy(policy.network, policy.shape, None).act(seen, deterministic=True)
    assert np.array_equal(raw, acts[0][0]) != normalized
    # Each robot's action follows from its own observation, by the same network for all.
    turned = policy.act(seen[:, ::-1], deterministic=True)[:, ::-1]
    np.testing.assert_allclose(turned, acts[0][0], atol=1e-6)


def test_a_damaged_policy_is_named(tmp_path: Path) -> None:
    run = train(config_of("ppo-shared"), tmp_path / "run")
    (run.policy / "checksums.json").unlink()
    write_tensors(run.policy / "policy.safetensors", {"log_std": torch.zeros(2)})
    with pytest.raises(RunError, match=r"policy\.safetensors does not fit policy\.json"):
        load_trained(run)
    (run.policy / "policy.safetensors").write_bytes(b"nonsense")
    with pytest.raises(RunError, match=r"policy\.safetensors cannot be read"):
        load_trained(run)


def test_hyperparameters_are_the_same_for_both() -> None:
    first, second = (find_algorithm(name).resolve({}) for name in NAMES)
    assert first == second
    changed = find_algorithm(NAMES[1]).resolve({"model": {"gamma": 0.5}}, num_envs=3)
    assert changed.model == {**first.model, "gamma": 0.5} and changed.num_envs == 3
    with pytest.raises(ConfigError, match=r"model\.tau: unknown name; known: .*gamma"):
        find_algorithm(NAMES[0]).resolve({"model": {"tau": 0.1}})
    with pytest.raises(ConfigError, match="setting: ppo-shared has N, not A"):
        TrainConfig("ppo-shared", "field_03", setting="A")


def test_what_makes_no_learner_is_said_before_the_folder_is_made(tmp_path: Path) -> None:
    config = config_of("ppo-shared", hyperparameters={"model": {"n_steps": 1, "batch_size": 1}})
    with pytest.raises(ConfigError, match=r"of ppo-shared: 1 problem\n.*no learner can be made"):
        train(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_command_line_takes_them(tmp_path: Path) -> None:
    out = tmp_path / "run"
    tiny = ["--steps", "1", "--num-envs", "2", "--episodes", "1", "--out", str(out)]
    assert main(["train", "ppo-supersuit", "field_03", *tiny]) == 0
    run = RunFolder.open(out)
    assert (run.config["algorithm"], run.evaluation["env_steps"]) == ("ppo-supersuit", 128)
    assert json.loads((out / "versions.json").read_text())["packages"]["supersuit"]


def test_a_policy_saved_before_the_centralised_ones_were_kept_alike_is_read(tmp_path: Path) -> None:
    run = train(config_of("ppo-shared"), tmp_path / "run")
    policy = load_trained(run)
    policy.save(tmp_path)
    shape = json.loads((tmp_path / "policy.json").read_text())
    old = {name: shape[name] for name in ("obs_size", "arguments", "normalization")}
    (tmp_path / "policy.json").write_text(json.dumps(old))
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (5, ROBOTS, 33)).astype(np.float32)
    expected = policy.act(seen, deterministic=True)
    np.testing.assert_array_equal(load_saved(tmp_path).act(seen, deterministic=True), expected)
