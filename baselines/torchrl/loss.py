"""PPO's losses for a team.

TorchRL's ``MAPPOLoss`` and ``IPPOLoss`` compute the same numbers (a test compares them) from
tensordicts and distribution objects; here it is tensors in, tensors out (see ``trainer``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch.nn import functional

HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


class Samples(NamedTuple):
    """What a minibatch is made of; B env-steps of n robots."""

    observations: torch.Tensor  # (B, n, obs_size), normalised
    actions: torch.Tensor  # (B, n, 2), as sampled, not clipped
    log_probs: torch.Tensor  # (B, n), of the policy that sampled them
    advantages: torch.Tensor  # (B, n)
    targets: torch.Tensor  # (B, n), of the value


class Losses(NamedTuple):
    """Means over a minibatch, scalars."""

    objective: torch.Tensor  # PPO's clipped surrogate, negated: to be made small
    critic: torch.Tensor  # half the squared error of the value
    entropy: torch.Tensor  # of a robot's actions, nats
    kl_approx: torch.Tensor  # estimate of the divergence from the policy that sampled
    clip_fraction: torch.Tensor  # share of ratios outside the clip range


def log_prob(noise: torch.Tensor, log_std: torch.Tensor) -> torch.Tensor:
    """Log-density (...) of a normal action ``mean + std * noise``, noise (..., 2)."""
    return -(0.5 * noise.square() + log_std + HALF_LOG_TWO_PI).sum(-1)


def ppo_losses(
    mean: torch.Tensor,
    log_std: torch.Tensor,
    values: torch.Tensor,
    samples: Samples,
    clip: float,
) -> Losses:
    """The losses of a minibatch.

    Args:
        mean: of the actions, (B, n, 2).
        log_std: of the actions, broadcast to the mean.
        values: (B, n).
        samples: the minibatch.
        clip: the probability ratio's clip range.
    """
    noise = (samples.actions - mean) * (-log_std).exp()
    log_ratio = log_prob(noise, log_std) - samples.log_probs
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    gain = torch.minimum(ratio * samples.advantages, clipped * samples.advantages)
    entropy = (log_std + (0.5 + HALF_LOG_TWO_PI)).sum(-1).mean()
    with torch.no_grad():
        kl_approx = ((ratio - 1.0) - log_ratio).mean()
        clip_fraction = (ratio != clipped).float().mean()
    return Losses(
        objective=-gain.mean(),
        critic=0.5 * functional.mse_loss(values, samples.targets),
        entropy=entropy,
        kl_approx=kl_approx,
        clip_fraction=clip_fraction,
    )
