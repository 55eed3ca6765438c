"""A trained policy of a team: saved without pickle, loaded to act."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from pydantic import TypeAdapter

from baselines.evaluation.layers import Activation, Layers, Plain
from baselines.runs.files import read_json, reading, write_json
from baselines.runs.tensors import read_tensors, write_tensors
from baselines.torchrl.networks import CLIP, GaussianPolicy, TeamMLP, TeamShape

WEIGHTS = "policy.safetensors"
SHAPE = "policy.json"


class TeamPolicy:
    observes: Literal["observations", "state"] = "observations"

    def __init__(self, network: GaussianPolicy) -> None:
        self.network = network

    @torch.no_grad()
    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Actions (worlds, n, 2) for observations (worlds, n, obs_size)."""
        network, device = self.network, self.network.log_std.device
        mean = network.means(network.norm.normalize(torch.from_numpy(seen).to(device))).cpu()
        std = network.log_std.exp().cpu()  # the noise is the same, whatever the device
        actions = mean if deterministic else mean + std * torch.randn(mean.shape)
        return actions.float().numpy()  # under autocast they are bfloat16

    def layers(self) -> Plain:
        network, mlp = self.network, self.network.mean
        if not isinstance(mlp, TeamMLP):
            return mlp.layers()
        team = network.shape.actor == "centralized"  # it has the robots side by side
        mean, scale = (
            part.expand(network.shape.n_robots, -1).reshape(1, 1, -1)
            if team
            else part.reshape(network.shape.networks, 1, -1)
            for part in (network.norm.statistics.mean, network.norm.scale())
        )
        tanh: Activation = "tanh"
        return Layers(
            mean.numpy(force=True),
            scale.numpy(force=True),
            CLIP,
            tuple(weight.numpy(force=True) for weight in mlp.weights),
            tuple(bias.numpy(force=True) for bias in mlp.biases),
            (*[tanh] * (len(mlp.weights) - 1), "clip"),
        )

    def save(self, folder: Path) -> None:
        write_json(folder / SHAPE, asdict(self.network.shape))
        write_tensors(folder / WEIGHTS, self.network.state_dict())


def load_policy(folder: Path) -> TeamPolicy:
    """Load what :meth:`TeamPolicy.save` wrote; raise a RunError if it is missing or damaged."""
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
