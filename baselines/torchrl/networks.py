"""Actor and critic of a team: one set of layers for all robots or one for each, normalised input.

TorchRL's ``MultiAgentMLP`` computes the same, with ``vmap`` over stacked parameters; the layers
here are batched products instead (see ``trainer`` for what that saves).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import nn
from torchrl.modules import RunningValueNorm

Sharing = Literal["full", "full+id", "none"]

CLIP = 10.0
"""Normalised observations are clipped to +-CLIP, as is usual (a bit that was rarely set)."""


@dataclass(frozen=True)
class TeamShape:
    """The sizes of a team's networks.

    Attributes:
        obs_size: numbers of a robot's observation.
        n_robots: robots of a world.
        hidden: widths of the hidden layers (tanh).
        sharing: ``"full"``, one network for all robots; ``"full+id"``, one whose observation says
            which robot it is; ``"none"``, a network for each robot.
    """

    obs_size: int
    n_robots: int
    hidden: tuple[int, ...]
    sharing: Sharing

    @property
    def networks(self) -> int:
        """How many networks the robots have: 1 or ``n_robots``."""
        return self.n_robots if self.sharing == "none" else 1


class ObservationNorm(nn.Module):
    """Running normalisation of observations: for each robot its own, or one for all.

    Until the first update it passes observations on unchanged.

    Args:
        shape: robots that share a network share the normalisation too.
    """

    def __init__(self, shape: TeamShape) -> None:
        super().__init__()
        robots = (shape.n_robots,) if shape.networks > 1 else ()
        self.statistics = RunningValueNorm(shape=(*robots, shape.obs_size))

    def update(self, observations: torch.Tensor) -> None:
        """Take ``observations`` (..., n, obs_size) into the mean and variance."""
        self.statistics.update(observations)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Normalise ``observations`` (..., n, obs_size)."""
        if self.statistics.count == 0:
            return observations
        normalized: torch.Tensor = self.statistics.normalize(observations)
        return normalized.clamp_(-CLIP, CLIP)


class TeamMLP(nn.Module):
    """A tanh network for all rows of a batch, or one for each of k groups of rows.

    Orthogonal initial weights; biases start at zero.

    Args:
        networks: k, how many.
        sizes: inputs, widths of the hidden layers, outputs.
        last_gain: gain of the last layer.
    """

    def __init__(self, networks: int, sizes: tuple[int, ...], *, last_gain: float) -> None:
        super().__init__()
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for layer, (inputs, outputs) in enumerate(pairwise(sizes)):
            last = layer == len(sizes) - 2
            gain = last_gain if last else nn.init.calculate_gain("tanh")
            weight = torch.empty(networks, inputs, outputs)
            for matrix in weight:
                nn.init.orthogonal_(matrix, gain)
            self.weights.append(nn.Parameter(weight))
            self.biases.append(nn.Parameter(torch.zeros(networks, 1, outputs)))

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Outputs (..., n, outputs) of ``rows`` (..., n, inputs); n is k, or any if k is 1."""
        *batch, n, inputs = rows.shape
        networks = len(self.weights[0])
        together = rows.reshape(1, -1, inputs)
        flow = together if networks == 1 else together.view(-1, n, inputs).transpose(0, 1)
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            flow = torch.baddbmm(bias, flow.tanh_() if layer else flow, weight)
        if networks > 1:
            flow = flow.transpose(0, 1)
        return flow.reshape(*batch, n, -1)


class GaussianPolicy(nn.Module):
    """Mean and standard deviation of the actions, each robot's from its own observation.

    Args:
        shape: of the team.
        log_std: initial logarithm of the standard deviation (state-independent, one per axis).
    """

    def __init__(self, shape: TeamShape, log_std: float = 0.0) -> None:
        super().__init__()
        self.shape = shape
        self.norm = ObservationNorm(shape)
        self.mean = TeamMLP(shape.networks, (shape.obs_size, *shape.hidden, 2), last_gain=0.01)
        self.log_std = nn.Parameter(torch.full((shape.networks, 2), log_std))

    def forward(self, observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and standard deviation, (..., n, 2) each, from observations (..., n, obs_size)."""
        mean = self.mean(self.norm(observations))
        return mean, self.log_std.exp().expand_as(mean)

    @torch.no_grad()
    def cap_log_std(self, cap: float) -> None:
        """Lower the log-std to ``cap`` where it is above."""
        self.log_std.clamp_(max=cap)


class CentralizedCritic(nn.Module):
    """A value for every robot, all from the observations of all robots (MAPPO)."""

    def __init__(self, shape: TeamShape) -> None:
        super().__init__()
        sizes = (shape.n_robots * shape.obs_size, *shape.hidden, shape.n_robots)
        self.values = TeamMLP(1, sizes, last_gain=1.0)

    def forward(self, normalized: torch.Tensor) -> torch.Tensor:
        """Values (..., n) of normalised observations (..., n, obs_size)."""
        values: torch.Tensor = self.values(normalized.flatten(-2).unsqueeze(-2))
        return values.squeeze(-2)


class IndependentCritic(nn.Module):
    """A value for every robot, each from its own observation (IPPO)."""

    def __init__(self, shape: TeamShape) -> None:
        super().__init__()
        sizes = (shape.obs_size, *shape.hidden, 1)
        self.values = TeamMLP(shape.networks, sizes, last_gain=1.0)

    def forward(self, normalized: torch.Tensor) -> torch.Tensor:
        """Values (..., n) of normalised observations (..., n, obs_size)."""
        values: torch.Tensor = self.values(normalized)
        return values.squeeze(-1)


CRITICS = {"centralized": CentralizedCritic, "independent": IndependentCritic}
