"""A trained policy of a team: saved without pickle, loaded to act."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from pydantic import TypeAdapter

from baselines.policies.policy import Policy, TrainedPolicy, Wrapped
from baselines.runs.files import read_json, reading, write_json
from baselines.runs.tensors import read_tensors, write_tensors
from baselines.torchrl.networks import GaussianPolicy, TeamShape
from mbn_marl.errors import ConfigError

WEIGHTS = "policy.safetensors"
SHAPE = "policy.json"


class TeamPolicy(TrainedPolicy):
    network: GaussianPolicy

    def __init__(self, network: GaussianPolicy) -> None:
        self.network = network

    @torch.no_grad()
    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        log_std = self.network.log_std
        mean = self.means(torch.from_numpy(seen).to(log_std.device)).cpu()
        std = log_std.exp().cpu()  # the noise is the same, whatever the device
        actions = mean if deterministic else mean + std * torch.randn(mean.shape)
        return actions.float().numpy()  # under autocast they are bfloat16

    def means(self, seen: torch.Tensor) -> torch.Tensor:
        return self.network.means(self.network.norm.normalize(seen))

    def of_robot(self, robot: int, robots: int) -> Policy:
        if self.network.shape.actor == "centralized":
            problem = "actor: centralized, it sees all rows; allowed: decentralized"
            raise ConfigError("policy", [problem])
        return OneRow(self, robot, robots)

    def save(self, folder: Path) -> None:
        write_json(folder / SHAPE, asdict(self.network.shape))
        write_tensors(folder / WEIGHTS, self.network.state_dict())


class OneRow(Wrapped):
    """A team's policy for the row of one robot, with zeros in place of the others' rows."""

    # Networks find the robot's weights, and the size of the team, by the rows.
    def __init__(self, policy: Policy, robot: int, robots: int) -> None:
        super().__init__(policy)
        self._robot, self._robots = robot, robots

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        rows = np.zeros((len(seen), self._robots, seen.shape[-1]), seen.dtype)
        rows[:, self._robot] = seen[:, 0]
        actions: np.ndarray = self.policy.act(rows, deterministic=deterministic)
        return actions[:, self._robot, None]


def load_policy(folder: Path) -> TeamPolicy:
    with reading(folder / SHAPE):
        shape = TypeAdapter(TeamShape).validate_python(read_json(folder / SHAPE))
        with torch.device("meta"):  # without memory, of which a wrong shape may want much
            sizes = GaussianPolicy(shape)
    with reading(folder / WEIGHTS):
        weights = read_tensors(folder / WEIGHTS, sizes.state_dict())
        sizes.load_state_dict(weights, assign=True)  # raises if they do not fit
        network = GaussianPolicy(shape)
        network.load_state_dict(weights)
    return TeamPolicy(network)
