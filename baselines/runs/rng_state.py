"""The states of the global random number generators, as JSON values."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch


def save_generators() -> dict[str, Any]:
    """Return the states of Python's, NumPy's and torch's global generators."""
    version, numbers, gauss = random.getstate()
    state: Any = np.random.get_state(legacy=False)
    key = state["state"]["key"].tolist()
    cuda: Any = torch.cuda  # not all of it has types
    devices = cuda.get_rng_state_all() if cuda.is_initialized() else []
    return {
        "python": [version, list(numbers), gauss],
        "numpy": {**state, "state": {**state["state"], "key": key}},
        "torch": torch.get_rng_state().numpy().tobytes().hex(),
        "cuda": [device.numpy().tobytes().hex() for device in devices],
    }


def restore_generators(saved: Mapping[str, Any]) -> None:
    """Restore the states that :func:`save_generators` returned."""
    version, numbers, gauss = saved["python"]
    random.setstate((version, tuple(numbers), gauss))
    state = saved["numpy"]
    key = np.asarray(state["state"]["key"], np.uint32)
    if not 0 <= state["state"]["pos"] <= key.size:  # NumPy would read past the key
        raise ValueError(f"pos {state['state']['pos']}; allowed: 0 to {key.size}")
    np.random.set_state({**state, "state": {**state["state"], "key": key}})
    torch.set_rng_state(_tensor(saved["torch"]))
    if saved["cuda"]:
        torch.cuda.set_rng_state_all([_tensor(device) for device in saved["cuda"]])


def _tensor(digits: str) -> torch.Tensor:
    return torch.frombuffer(bytearray.fromhex(digits), dtype=torch.uint8)
