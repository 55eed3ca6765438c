"""Small runs, interrupted ones, and whether two runs are the same bit for bit."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
import torch

from baselines.evaluation.policy import load_trained
from baselines.runs.folder import RunFolder
from baselines.training.config import TrainConfig
from baselines.training.progress_bar import Report
from baselines.training.train import train


def small_config(name: str) -> TrainConfig:
    """A run of ``"mappo"`` or ``"ppo"`` with two fresh evaluations on the way."""
    hyperparameters: dict[str, Any] = {"num_worlds": 4, "rollout_steps": 16, "hidden": [8, 8]}
    hyperparameters |= {"action_repeat": [1, 1], "action_repeat_until": 0.5}
    if name == "ppo":
        model = {"policy_kwargs": {"net_arch": [8]}, "n_steps": 32, "batch_size": 32}
        hyperparameters = {"num_envs": 2, "model": model}
    return TrainConfig(
        name,
        "field_03",
        steps=320,
        evaluate_every=100,
        episodes=2,
        environment={"max_steps": 50},
        hyperparameters=hyperparameters,
    )


def interrupted(config: TrainConfig, out: Path) -> RunFolder:
    """The folder of a run that stopped after its first checkpoint."""

    def interrupt(report: Report) -> None:
        if (out / "checkpoints").exists():
            raise InterruptedError

    with pytest.raises(InterruptedError):
        train(config, out, listener=interrupt)
    return RunFolder.open(out)


def recorded(run: RunFolder) -> dict[str, Any]:
    """The records of a run without the seconds."""

    def timeless(entry: dict[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in entry.items() if "seconds" not in name}

    with run.progress.open(newline="") as file:
        rows = [timeless(row) for row in csv.DictReader(file)]
    evaluations = [timeless(entry) for entry in run.evaluations]
    return {"rows": rows, "evaluations": evaluations, "final": timeless(run.evaluation)}


def parameters(run: RunFolder) -> dict[str, torch.Tensor]:
    """The weights of a run's policy."""
    policy: Any = load_trained(run)
    return dict(policy.network.state_dict())


def same_policies(run: RunFolder, other: RunFolder) -> bool:
    """Return whether the weights of two runs are bit for bit the same."""
    ours, theirs = parameters(run), parameters(other)
    return ours.keys() == theirs.keys() and all(
        torch.equal(weight, theirs[name]) for name, weight in ours.items()
    )
