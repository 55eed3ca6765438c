"""Actor and critic: TorchRL's multi-agent networks behind a running normalisation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict.nn import InteractionType, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, MultiAgentMLP, ProbabilisticActor, RunningValueNorm

OBSERVATION = ("robots", "observation")
ACTION = ("robots", "action")
LOG_PROB = ("robots", "action_log_prob")
VALUE = ("robots", "state_value")

CLIP = 10.0
"""Normalised observations are clipped to +-CLIP, as is usual (a bit that was rarely set)."""


@dataclass(frozen=True)
class TeamShape:
    """The sizes of a team's networks.

    Attributes:
        obs_size: numbers of a robot's observation.
        n_robots: robots of a world.
        hidden: widths of the hidden layers (tanh).
        share_parameters: one network for all robots, or one for each.
    """

    obs_size: int
    n_robots: int
    hidden: tuple[int, ...]
    share_parameters: bool


class ObservationNorm(nn.Module):
    """Running normalisation of observations: for each robot its own, or one for all.

    Until the first update it passes observations on unchanged.

    Args:
        shape: with shared parameters the normalisation is shared too.
    """

    def __init__(self, shape: TeamShape) -> None:
        super().__init__()
        robots = () if shape.share_parameters else (shape.n_robots,)
        self.statistics = RunningValueNorm(shape=(*robots, shape.obs_size))

    def update(self, observations: torch.Tensor) -> None:
        """Take ``observations`` (..., n, obs_size) into the mean and variance."""
        self.statistics.update(observations)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Normalise ``observations`` (..., n, obs_size)."""
        if self.statistics.count == 0:
            return observations
        normalized: torch.Tensor = self.statistics.normalize(observations)
        return normalized.clamp(-CLIP, CLIP)


class GaussianPolicy(nn.Module):
    """Mean and standard deviation of the actions, each robot's from its own observation.

    Args:
        shape: of the team.
        log_std: initial logarithm of the standard deviation.
    """

    def __init__(self, shape: TeamShape, log_std: float = 0.0) -> None:
        super().__init__()
        self.shape = shape
        self.norm = ObservationNorm(shape)
        self.mean = team_mlp(shape, 2, last_gain=0.01)
        self.log_std = nn.Parameter(torch.full((2,), log_std))

    def forward(self, observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and standard deviation, (..., n, 2) each, from observations (..., n, obs_size)."""
        mean = self.mean(self.norm(observations))
        return mean, self.log_std.exp().expand_as(mean)

    @torch.no_grad()
    def cap_log_std(self, cap: float) -> None:
        """Lower the log-std to ``cap`` where it is above."""
        self.log_std.clamp_(max=cap)


def make_actor(policy: GaussianPolicy) -> ProbabilisticActor:
    """The policy as a TorchRL actor that writes actions and their log-probabilities."""
    module = TensorDictModule(
        policy, in_keys=[OBSERVATION], out_keys=[("robots", "loc"), ("robots", "scale")]
    )
    return ProbabilisticActor(
        module,
        in_keys=[("robots", "loc"), ("robots", "scale")],
        out_keys=[ACTION],
        distribution_class=IndependentNormal,
        default_interaction_type=InteractionType.RANDOM,
        return_log_prob=True,
        log_prob_key=LOG_PROB,
    )


def make_critic(policy: GaussianPolicy, *, centralized: bool) -> TensorDictModule:
    """A critic with a value for every robot.

    Args:
        policy: the actor, whose shape and normalisation it shares.
        centralized: it sees the observations of all robots (MAPPO), or each its own (IPPO).
    """
    network = team_mlp(policy.shape, 1, last_gain=1.0, centralized=centralized)
    return TensorDictModule(
        nn.Sequential(policy.norm, network), in_keys=[OBSERVATION], out_keys=[VALUE]
    )


def team_mlp(
    shape: TeamShape, outputs: int, *, last_gain: float, centralized: bool = False
) -> MultiAgentMLP:
    """TorchRL's multi-agent network, tanh, initialised orthogonally.

    Args:
        shape: of the team.
        outputs: numbers for each robot.
        last_gain: gain of the last layer.
        centralized: every robot's outputs depend on all observations, or on its own.
    """
    network = MultiAgentMLP(
        n_agent_inputs=shape.obs_size,
        n_agent_outputs=outputs,
        n_agents=shape.n_robots,
        centralized=centralized,
        share_params=shape.share_parameters,
        num_cells=list(shape.hidden),
        activation_class=nn.Tanh,
    )
    linear = [
        layer for layer in network.get_stateful_net().modules() if isinstance(layer, nn.Linear)
    ]
    for layer in linear:
        gain = last_gain if layer is linear[-1] else nn.init.calculate_gain("tanh")
        matrices = layer.weight if layer.weight.ndim == 3 else [layer.weight]
        for matrix in matrices:
            nn.init.orthogonal_(matrix, gain)
        nn.init.zeros_(layer.bias)
    return network
