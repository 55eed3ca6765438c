"""Interrupted runs go on from their newest checkpoint as if nothing had happened."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from baselines.algorithms import ALGORITHMS
from baselines.centralized.policy import CentralizedPolicy
from baselines.policies import load_policy
from baselines.progress import Report
from baselines.runs import RunFolder, TrainConfig
from baselines.storage import RunError
from baselines.train import train
from mbn_marl.cli import main
from mbn_marl.errors import ConfigError

SMALL = {"policy_kwargs": {"net_arch": [8]}}
REPLAY = {**SMALL, "learning_starts": 100, "batch_size": 16, "buffer_size": 150}
"""The buffer is full and the warm-up is over when the run is interrupted."""
MODELS: dict[str, dict[str, Any]] = {
    "a2c": SMALL,
    "ppo": {**SMALL, "n_steps": 32, "batch_size": 32, "learning_rate": {"from": 0.01, "to": 0.001}},
    "trpo": {**SMALL, "n_steps": 32, "batch_size": 32},
    "ars": {"n_delta": 1, "n_top": 1},
    "crossq": {**REPLAY, "gradient_steps": 2},
    "tqc": REPLAY,
}


class Interrupted(Exception):
    """Stands for a killed process."""


def _config(name: str, **changes: Any) -> TrainConfig:
    """A run of a few updates with a checkpoint on the way."""
    if ALGORITHMS[name].form == "decentralized":
        small = {"num_worlds": 4, "rollout_steps": 16, "hidden": [8]}
        config = TrainConfig(name, "field_03", steps=320, evaluate_every=128, episodes=2)
        return replace(config, hyperparameters=small, **changes)
    envs = 1 if name == "ars" else 2
    hyperparameters = {"num_envs": envs, "model": MODELS[name]}
    if name != "ars":
        hyperparameters["policy"] = "MlpPolicy"
    return TrainConfig(
        name,
        "field_03",
        steps=400,
        evaluate_every=150,
        episodes=2,
        environment={"max_steps": 50, "random_starts": True},
        hyperparameters=hyperparameters,
        **changes,
    )


def _recorded(run: RunFolder) -> dict[str, Any]:
    """What a run recorded, but for the seconds."""

    def timeless(entry: dict[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in entry.items() if "seconds" not in name}

    with run.progress.open(newline="") as file:
        rows = [timeless(row) for row in csv.DictReader(file)]
    evaluations = [timeless(entry) for entry in run.evaluations]
    return {"rows": rows, "evaluations": evaluations, "final": timeless(run.evaluation)}


def _parameters(run: RunFolder) -> dict[str, torch.Tensor]:
    policy: Any = load_policy(run)
    network = policy.model.policy if isinstance(policy, CentralizedPolicy) else policy.network
    return dict(network.state_dict())


def _assert_equal(run: RunFolder, other: RunFolder) -> None:
    assert _recorded(run) == _recorded(other)
    ours, theirs = _parameters(run), _parameters(other)
    assert ours.keys() == theirs.keys()
    for name in ours:
        assert torch.equal(ours[name], theirs[name]), name


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_resumed_run_equals_an_uninterrupted_one(name: str, tmp_path: Path) -> None:
    config = _config(name)
    whole = train(config, tmp_path / "whole")

    def interrupt(report: Report) -> None:
        if (tmp_path / "resumed" / "checkpoints").exists():
            raise Interrupted

    with pytest.raises(Interrupted):
        train(config, tmp_path / "resumed", listener=interrupt)
    torch.manual_seed(99)
    np.random.seed(99)
    resumed = train(config, tmp_path / "resumed", resume=True)
    history = json.loads((resumed.path / "resumed.json").read_text())
    assert 0 < history[0]["env_steps"] < config.steps
    _assert_equal(resumed, whole)
    assert not (resumed.path / "checkpoints").exists()
