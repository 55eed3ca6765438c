"""The moments of an optimiser as tensors by name, to be kept without pickle."""

from __future__ import annotations

from collections.abc import Mapping

import torch


def moments_of(optimizer: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """What ``optimizer`` remembers of each parameter: ``"<parameter's number>.<name>"``."""
    return {
        f"{index}.{name}": tensor
        for index, entry in optimizer.state_dict()["state"].items()
        for name, tensor in entry.items()
    }


def restore_moments(optimizer: torch.optim.Optimizer, moments: Mapping[str, torch.Tensor]) -> None:
    """Go on from what :func:`moments_of` returned."""
    state: dict[int, dict[str, torch.Tensor]] = {}
    for key, tensor in moments.items():
        index, name = key.split(".")
        state.setdefault(int(index), {})[name] = tensor
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
