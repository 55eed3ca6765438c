"""Which kind of device the worlds of an engine live on."""

from __future__ import annotations

from mbn_marl.engine.backend import CUDA_NEEDS, Backend, BackendSpec
from mbn_marl.engine.cpu import CpuBackend
from mbn_marl.engine.validation import Device
from mbn_marl.errors import ConfigError


def make_backend(device: Device, spec: BackendSpec) -> Backend:
    """Where the worlds live: only CUDA needs torch, and so loads it."""
    if device == "cpu":
        return CpuBackend(spec)
    try:
        from mbn_marl.engine.cuda import CudaBackend
    except ImportError as error:
        raise ConfigError("configuration", [f"{CUDA_NEEDS}; {error}"]) from None
    return CudaBackend(spec)
