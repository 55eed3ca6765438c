"""Small runs, interrupted ones, and whether two runs are the same bit for bit."""

import csv
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from filelock import FileLock

from baselines.algorithms import Setting
from baselines.policies.load import load_trained
from baselines.runs.folder import RunFolder
from baselines.training.config import TrainConfig
from baselines.training.run_logger import Report
from baselines.training.train import train

AIDS = {"roi_radius": 4.0, "scattered": 0.5}
STAGES = {**AIDS, "roi_radius": 20.0}
"""ROIs that reach every robot of field_03, so that they shrink after every rollout at first."""
TEAM = {"num_worlds": 4, "rollout_steps": 16, "hidden": [8, 8], **AIDS}
NET = {"policy_kwargs": {"net_arch": [8]}}
SHORT = {**NET, "n_steps": 32, "batch_size": 32}
REPLAY = {**NET, "learning_starts": 100, "train_freq": 4, "batch_size": 16, "buffer_size": 150}
"""At the checkpoint the buffer is full and the warm-up is over."""
FALLING = {"learning_rate": {"from": 0.01, "to": 0.001}}
LEARNERS: dict[str, dict[str, Any]] = {
    "a2c": {"model": NET},
    "ppo": {"model": {**SHORT, **FALLING}},
    "trpo": {"model": SHORT, **STAGES},
    "ars": {"model": {"n_delta": 1, "n_top": 1, **FALLING}, "num_envs": 1},
    "crossq": {"model": {**REPLAY, "gradient_steps": 2}},
    "crossq-sbx": {"model": {**REPLAY, "gradient_steps": 2}},
    "tqc": {"model": REPLAY},
    "ppo-shared": {"model": SHORT, **STAGES},
}


def small_config(name: str, setting: Setting = "N") -> TrainConfig:
    small = TEAM
    if name in LEARNERS:
        kind = {} if name == "ars" else {"policy": "MlpPolicy"}
        small = {"num_envs": 2, **kind, **LEARNERS[name]}
    environment = {"max_steps": 50, "random_starts": "scattered" not in small}
    budget = {"steps": 400, "evaluate_every": 150, "episodes": 2}
    changes = {"environment": environment, "hyperparameters": small}
    return TrainConfig(name, "field_03", setting, **budget, **changes)


def interrupted(config: TrainConfig, out: Path, after: int = 0, **options: Any) -> RunFolder:
    """A run that is cut off by its first checkpoint after so many steps."""

    def interrupt(report: Report) -> None:
        if RunFolder(out).saved_steps > after:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        train(config, out, listener=interrupt, **options)
    return RunFolder.open(out)


def recorded(run: RunFolder) -> dict[str, Any]:
    def timeless(entry: dict[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in entry.items() if "seconds" not in name}

    with run.progress.open(newline="") as file:
        rows = [timeless(row) for row in csv.DictReader(file)]
    evaluations = [timeless(entry) for entry in run.evaluations]
    return {"rows": rows, "evaluations": evaluations, "final": timeless(run.evaluation)}


def same_policies(run: RunFolder, other: RunFolder) -> bool:
    policies = [load_trained(one) for one in (run, other)]
    ours, theirs = (policy.network.state_dict() for policy in policies)
    return ours.keys() == theirs.keys() and all(
        torch.equal(weight, theirs[name]) for name, weight in ours.items()
    )


class TinyRuns:
    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def finished(self, name: str) -> RunFolder:
        return self._made(f"{name}-finished", lambda out: train(small_config(name), out))

    def stopped(self, name: str, copy: Path) -> RunFolder:
        run = self._made(f"{name}-stopped", lambda out: interrupted(small_config(name), out))
        return RunFolder.open(shutil.copytree(run.path, copy))

    def _made(self, name: str, make: Callable[[Path], RunFolder]) -> RunFolder:
        self._folder.mkdir(exist_ok=True)
        out = self._folder / name
        with FileLock(f"{out}.lock"):
            return RunFolder.open(out) if out.exists() else make(out)


@pytest.fixture(scope="session")
def tiny_runs(tmp_path_factory):
    base = tmp_path_factory.getbasetemp()
    workers = "PYTEST_XDIST_WORKER" in os.environ  # whose folders are in one
    return TinyRuns((base.parent if workers else base) / "runs")
