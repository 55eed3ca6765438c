"""What two runs have to have in common to be the same."""

from __future__ import annotations

import csv
from typing import Any

import torch

from baselines.evaluation.policy import load_policy
from baselines.runs.folder import RunFolder
from baselines.sb3.policy import CentralizedPolicy


def recorded(run: RunFolder) -> dict[str, Any]:
    """What a run recorded, but for the seconds."""

    def timeless(entry: dict[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in entry.items() if "seconds" not in name}

    with run.progress.open(newline="") as file:
        rows = [timeless(row) for row in csv.DictReader(file)]
    evaluations = [timeless(entry) for entry in run.evaluations]
    return {"rows": rows, "evaluations": evaluations, "final": timeless(run.evaluation)}


def parameters(run: RunFolder) -> dict[str, torch.Tensor]:
    """The weights of a run's policy."""
    policy: Any = load_policy(run)
    network = policy.model.policy if isinstance(policy, CentralizedPolicy) else policy.network
    return dict(network.state_dict())


def same_policies(run: RunFolder, other: RunFolder) -> bool:
    """Whether the weights of two runs are bit by bit the same."""
    ours, theirs = parameters(run), parameters(other)
    return ours.keys() == theirs.keys() and all(
        torch.equal(weight, theirs[name]) for name, weight in ours.items()
    )
