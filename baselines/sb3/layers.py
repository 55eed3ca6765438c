"""The deterministic part of a Stable-Baselines3 policy as plain arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from sb3_contrib.common.torch_layers import BatchRenorm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from torch import nn

from baselines.evaluation.layers import Activation, Layers
from mbn_marl.errors import ConfigError

ACTIVATIONS: dict[type[nn.Module], Activation] = {nn.Tanh: "tanh", nn.ReLU: "relu"}
Affine = tuple[torch.Tensor, torch.Tensor]


def layers_of(network: BasePolicy, mean: np.ndarray, scale: np.ndarray, clip: float) -> Layers:
    """Return the network behind rows, (inputs,), that are normalised by mean, scale and clip.

    Batch normalisation, which is affine once a policy is trained, becomes part of the layer after.

    Raises:
        ConfigError: naming the parts of the network that plain layers have not.
    """
    modules = _modules(network)
    known = (nn.Linear, BatchRenorm, *ACTIVATIONS)
    if others := {type(module).__name__ for module in modules if not isinstance(module, known)}:
        allowed = ", ".join(kind.__name__ for kind in known)
        problems = [f"network: has {name}; allowed: {allowed}" for name in sorted(others)]
        raise ConfigError("export", problems)
    weights, biases = [], []
    activations: list[Activation] = []
    before: Affine = torch.tensor(1.0), torch.tensor(0.0)
    for module in modules:
        if isinstance(module, nn.Linear):
            factor, offset = before
            bias = module.bias if module.bias is not None else torch.zeros(module.out_features)
            weights.append((module.weight * factor).T[None].numpy(force=True))
            shifted = bias + module.weight @ offset.expand(module.in_features)
            biases.append(shifted[None, None].numpy(force=True))
            activations.append("clip")
            before = torch.tensor(1.0), torch.tensor(0.0)
        elif isinstance(module, BatchRenorm):
            before = _affine(module)
        else:
            activations[-1] = ACTIVATIONS[type(module)]
    normal = mean[None, None], scale[None, None], clip
    return Layers(*normal, tuple(weights), tuple(biases), tuple(activations))


def _modules(network: Any) -> list[nn.Module]:
    """The modules between a row and its mean action, in order."""
    if isinstance(network, ActorCriticPolicy):
        parts = [network.mlp_extractor.policy_net, network.action_net]
    elif hasattr(network, "actor"):
        parts = [network.actor.latent_pi, network.actor.mu, nn.Tanh()]
    else:
        parts = [network.action_net]
    nested = [part if isinstance(part, nn.Sequential) else [part] for part in parts]
    return [module for several in nested for module in several]


def _affine(norm: Any) -> Affine:
    """Factor and offset of a trained batch normalisation, (inputs,) each."""
    factor = (norm.ra_var + norm.eps).rsqrt()
    offset = -norm.ra_mean * factor
    return factor * norm.scale, offset * norm.scale + norm.bias
