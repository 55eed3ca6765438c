"""The worlds on a CUDA device: torch tensors, which the kernels read and write in place."""

from __future__ import annotations

import importlib.util
import warnings
from functools import partial
from typing import Any

import torch
from numba import cuda
from numpy.typing import NDArray

from mbn_marl.engine import cuda_kernels as kernels
from mbn_marl.engine.backend import Backend, BackendSpec
from mbn_marl.engine.constants import constants_of
from mbn_marl.engine.state import share_bits
from mbn_marl.errors import ActionError, ConfigError, install

NEEDS = (
    "device: 'cuda' needs an NVIDIA GPU, a torch that can use it (see pytorch.org), "
    f"and numba-cuda: {install('cuda')}"
)


class Device:
    def __init__(self) -> None:
        if problem := _missing():
            raise ConfigError("configuration", [f"{NEEDS}; {problem}"])
        self.torch = torch.device("cuda", torch.cuda.current_device())
        self._launchers: dict[tuple[Any, int, int, int], Any] = {}

    def array(self, tensor: torch.Tensor) -> Any:
        return cuda.as_cuda_array(tensor.detach(), sync=False)

    def is_capturing(self) -> bool:
        return torch.cuda.is_current_stream_capturing()

    def launch(self, kernel: Any, blocks: int, threads: int, *arguments: Any) -> None:
        stream = torch.cuda.current_stream(self.torch).cuda_stream
        key = kernel, blocks, threads, stream
        if key not in self._launchers:
            with warnings.catch_warnings():  # a small batch is no mistake
                warnings.simplefilter("ignore")
                self._launchers[key] = kernel[blocks, threads, cuda.external_stream(stream)]
        self._launchers[key](*arguments)


def _missing() -> str | None:
    if kernels.SIMULATED:
        return "NUMBA_ENABLE_CUDASIM is set, which leaves no GPU"
    if not torch.cuda.is_available():
        return "torch finds no GPU"
    if importlib.util.find_spec("numba_cuda") is None:
        return "numba-cuda is not installed"
    found: bool = cuda.is_available()
    return None if found else "numba-cuda finds no GPU"


def _mapped(function: Any, arrays: Any) -> Any:
    if not isinstance(arrays, tuple):
        return function(arrays)
    return type(arrays)(*(_mapped(function, array) for array in arrays))


class CudaBackend(Backend):
    # Nothing here waits for the device but ``raise_fault`` and ``host``. All that a captured graph
    # has to find changed later (seed, number of the draw, first fault) is in tensors.
    xp = torch
    derived = ("_arrays", "_final", "_output", "_faults", "_device")

    def __init__(self, spec: BackendSpec) -> None:
        self._constants = constants_of(spec.constants)
        with Device().torch as place:
            self._make_worlds(spec)
            self._fault = torch.tensor([int(kernels.NO_FAULT)])
            self.geometry = _mapped(partial(torch.as_tensor, device=place), spec.geometry)
        self.connect()

    def reset(self, mask: Any) -> None:
        """Begin a new episode in the masked worlds, or in all, unless there is a fault to raise."""
        chosen = self._checked_mask("mask", mask)
        self.raise_fault()
        kernel, call = kernels.reset_kernel(self.spec.obs_size), self._call(self._actions, chosen)
        self._run(kernel, self._constants, *self._arrays, self._output, call)

    def step(self, actions: Any, active: Any) -> None:
        n, size = self.spec.actions_shape[1], self.spec.obs_size
        moving = self._checked_mask("active", active)
        kernel = kernels.step_kernel(n, size, self.spec.config.dtype)
        worlds = *self._arrays, self._final, self._output
        call = self._call(self.checked_actions(actions), moving)
        self._run(kernel, self._constants, *worlds, call)

    def raise_fault(self) -> None:
        """Raise the first fault of the steps so far, and forget all; waits for the device."""
        if self._device.is_capturing():
            return
        fault = int(self._fault)
        if fault == kernels.NO_FAULT:
            return
        self._fault.fill_(int(kernels.NO_FAULT))
        world, kind = divmod(fault, kernels.KINDS)
        if kind == kernels.NOT_FINITE:
            raise ActionError(
                f"actions[{world}] of an earlier step (world {world}): not finite; "
                "allowed: finite numbers, clipped to [-1, 1]"
            )
        error = self._waiting if kind == kernels.WAITING else self._left_out
        raise error(world, "an earlier step: ")

    def recount(self) -> None:
        self._fault.fill_(int(kernels.NO_FAULT))

    def host(self, array: Any) -> NDArray[Any]:
        copy: NDArray[Any] = array.cpu().numpy().copy()
        return copy

    def given(self, name: str, value: Any, allowed: str) -> torch.Tensor:
        place = self._device.torch
        if isinstance(value, torch.Tensor) and value.device == place:
            return value.detach().contiguous()
        what = value.device if isinstance(value, torch.Tensor) else type(value).__name__
        raise ActionError(f"{name}: {what}; allowed: a torch tensor on {place}, {allowed}")

    def _is_real(self, given: torch.Tensor) -> bool:
        return given.dtype != torch.bool and not given.is_complex()

    def _in_precision(self, given: torch.Tensor) -> torch.Tensor:
        if given.dtype == self._actions.dtype:
            return given
        if given.dtype.itemsize > self._actions.dtype.itemsize and given.is_floating_point():
            given = torch.where(given.isfinite(), given.clamp(-1, 1), given)
        return torch.Tensor.copy_(self._actions, given)

    # -- the kernels -------------------------------------------------------------------------------

    def empty(self, shape: tuple[int, ...], dtype: torch.dtype) -> torch.Tensor:
        return torch.empty(shape, dtype=dtype, device=self._device.torch)

    def write_infos(self, rows: torch.Tensor) -> None:
        worlds = *self._arrays, self._final, self._output
        self._run(kernels.infos, self._constants, *worlds, self._rows(rows))

    def write_states(self, final: bool, rows: torch.Tensor) -> None:
        arrays = self._final if final else self._arrays[2]
        self._run(kernels.states, arrays, self._rows(rows))

    def write_draw(self, rows: torch.Tensor) -> None:
        self._run(kernels.draw, self._constants, self._arrays[1], self._rows(rows))

    def _rows(self, rows: torch.Tensor) -> tuple[Any]:
        return (self._device.array(rows),)

    def _call(self, actions: torch.Tensor, active: torch.Tensor) -> kernels.Call:
        array = self._device.array
        return kernels.Call(array(actions), array(active), self._faults)

    def _run(self, kernel: Any, *arguments: Any) -> None:
        threads = kernels.threads_per_block(self.spec.obs_size)
        blocks = -(-self.spec.num_worlds // threads)
        self._device.launch(kernel, blocks, threads, *arguments)

    def connect(self) -> None:
        """Make the kernels' views of the tensors, once: that takes longer than a launch."""
        self.memory = share_bits(self.memory, self.now, torch)
        self._device = Device()
        arrays = partial(_mapped, self._device.array)
        self._arrays = arrays(self.geometry), arrays(self.memory), arrays(self.now)
        self._final, self._output = arrays(self.final), arrays(self.output)
        self._faults = self._device.array(self._fault)
