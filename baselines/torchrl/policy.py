"""A trained policy of a team: saved without pickle, loaded to act."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from pydantic import TypeAdapter

from baselines.policies.policy import TrainedPolicy
from baselines.runs.files import read_json, reading, write_json
from baselines.runs.tensors import read_tensors, write_tensors
from baselines.torchrl.networks import GaussianPolicy, TeamShape

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
