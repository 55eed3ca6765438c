"""A learner's tensors in safetensors files, and the random number generators as JSON values."""

import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors import torch as safetensors_torch

from baselines.runs.files import RunError
from mbn_marl.files import replacing


def write_tensors(path: Path, tensors: Mapping[str, torch.Tensor]) -> None:
    with replacing(path) as temporary:
        try:
            whole = {name: tensor.contiguous() for name, tensor in tensors.items()}
            safetensors_torch.save_file(whole, temporary)
        except SafetensorError as error:  # the library's, for a full disk too
            raise OSError(f"{path} cannot be written: {error}") from error


def read_tensors(
    path: Path, like: Mapping[str, torch.Tensor] | None = None
) -> dict[str, torch.Tensor]:
    """Read tensors; a RunError names one that is not finite, or of another type than ``like``."""
    try:
        tensors: dict[str, torch.Tensor] = safetensors_torch.load_file(path)
    except (OSError, SafetensorError) as error:
        raise RunError(f"{path} cannot be read: {error}") from None
    for name, tensor in tensors.items():
        allowed = tensor.dtype if like is None or name not in like else like[name].dtype
        if tensor.dtype != allowed:
            raise RunError(f"{path}: {name} is {tensor.dtype}; allowed: {allowed}")
        if not tensor.isfinite().all():
            raise RunError(f"{path}: {name} has a number that is not finite")
    return tensors


def moments_of(state: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """Return the tensors of an optimiser's ``state_dict`` as ``"<parameter's number>.<name>"``."""
    return {
        f"{index}.{name}": tensor
        for index, entry in state["state"].items()
        for name, tensor in entry.items()
    }


def with_moments(state: Mapping[str, Any], moments: Mapping[str, torch.Tensor]) -> dict[str, Any]:
    entries: dict[int, dict[str, torch.Tensor]] = {}
    for key, tensor in moments.items():
        index, name = key.split(".")
        entries.setdefault(int(index), {})[name] = tensor
    return {**state, "state": entries}


def save_generators() -> dict[str, Any]:
    numbers: Any = np.random.get_state(legacy=False)
    numbers["state"]["key"] = numbers["state"]["key"].tolist()
    cuda: Any = torch.cuda  # not all of it has types
    devices = cuda.get_rng_state_all() if cuda.is_initialized() else []
    return {
        "python": random.getstate(),
        "numpy": numbers,
        "torch": torch.get_rng_state().numpy().tobytes().hex(),
        "cuda": [device.numpy().tobytes().hex() for device in devices],
    }


def restore_generators(saved: Mapping[str, Any]) -> None:
    version, numbers, gauss = saved["python"]
    random.setstate((version, tuple(numbers), gauss))
    if not 0 <= (pos := saved["numpy"]["state"]["pos"]) <= 624:  # NumPy would read past the key
        raise ValueError(f"pos {pos}; allowed: 0 to 624")
    np.random.set_state(saved["numpy"])
    torch.set_rng_state(_tensor(saved["torch"]))
    if saved["cuda"]:
        torch.cuda.set_rng_state_all([_tensor(device) for device in saved["cuda"]])


def _tensor(digits: str) -> torch.Tensor:
    return torch.frombuffer(bytearray.fromhex(digits), dtype=torch.uint8)
