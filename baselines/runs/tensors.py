"""Tensors by name in safetensors files, which no reader unpickles: weights, optimisers' moments."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors import torch as safetensors_torch

from baselines.runs.files import RunError
from mbn_marl.checksums import check
from mbn_marl.files import replacing


def write_tensors(path: Path, tensors: Mapping[str, torch.Tensor]) -> None:
    """Write tensors by name, atomically.

    Raises:
        OSError: they cannot be written.
    """
    with replacing(path) as temporary:
        try:
            safetensors_torch.save_file(dict(tensors), temporary)
        except SafetensorError as error:  # the library's, for a full disk too
            raise OSError(f"{path} cannot be written: {error}") from error


def read_tensors(path: Path) -> dict[str, torch.Tensor]:
    """Read what :func:`write_tensors` wrote.

    Raises:
        RunError: the file is missing or damaged.
        DamageError: it is not what was written.
    """
    try:
        check(path)
        tensors: dict[str, torch.Tensor] = safetensors_torch.load_file(path)
    except (OSError, SafetensorError) as error:
        raise RunError(f"{path} cannot be read: {error}") from None
    return tensors


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
