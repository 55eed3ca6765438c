"""A trained policy of a team: saved without pickle, loaded to act."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from pydantic import TypeAdapter

from baselines.policies.policy import Policy, TrainedPolicy
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

    def of_robot(self, robot: int) -> Policy:
        shape = self.network.shape
        if shape.actor == "centralized":
            problem = "actor: centralized, it sees all rows; allowed: decentralized"
            raise ConfigError("policy", [problem])
        if shape.networks == 1:
            return super().of_robot(robot)
        own = GaussianPolicy(replace(shape, n_robots=1))
        sizes = {name: value.shape for name, value in own.state_dict().items()}
        own.load_state_dict(
            {
                name: value if value.shape == sizes[name] else value[robot].reshape(sizes[name])
                for name, value in self.network.state_dict().items()
            }
        )
        return TeamPolicy(own.to(self.network.log_std.device))

    def save(self, folder: Path) -> None:
        write_json(folder / SHAPE, asdict(self.network.shape))
        write_tensors(folder / WEIGHTS, self.network.state_dict())


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
