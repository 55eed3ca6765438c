"""The worlds on a CUDA device: torch tensors, which the kernels read and write in place."""

from __future__ import annotations

import importlib.util
import warnings
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numba import cuda
from numba.core.errors import NumbaPerformanceWarning
from numpy.typing import NDArray

from mbn_marl.engine import cuda_kernels as kernels
from mbn_marl.engine.backend import (
    CUDA_NEEDS,
    Plan,
    actions_shape_problem,
    left_out_problem,
    mask_problem,
    waiting_problem,
)
from mbn_marl.engine.constants import Constants
from mbn_marl.engine.kernels import INFO_COLUMNS
from mbn_marl.engine.state import Geometry, make_episode, make_memory, make_output, share_bits
from mbn_marl.errors import ActionError, ConfigError, StepError


class Device:
    """torch's current CUDA device and stream, as Numba's kernels get to know them."""

    def __init__(self) -> None:
        if problem := _missing():
            raise ConfigError("configuration", [f"{CUDA_NEEDS}; {problem}"])
        self.torch = torch.device("cuda", torch.cuda.current_device())
        self._launchers: dict[tuple[Any, int, int, int], Any] = {}

    def array(self, tensor: torch.Tensor) -> Any:
        """The tensor's memory as a Numba array."""
        return cuda.as_cuda_array(tensor.detach(), sync=False)

    def is_capturing(self) -> bool:
        """Whether what is launched now becomes part of a CUDA graph."""
        return torch.cuda.is_current_stream_capturing()

    def launch(self, kernel: Any, blocks: int, threads: int, *arguments: Any) -> None:
        """Launch a kernel on torch's current stream."""
        stream = torch.cuda.current_stream(self.torch).cuda_stream
        key = kernel, blocks, threads, stream
        if key not in self._launchers:
            with warnings.catch_warnings():  # a small batch is no mistake
                warnings.simplefilter("ignore", NumbaPerformanceWarning)
                self._launchers[key] = kernel[blocks, threads, cuda.external_stream(stream)]
        self._launchers[key](*arguments)


def _missing() -> str | None:
    """What keeps this machine from running the kernels, if anything."""
    if kernels.SIMULATED:
        return "NUMBA_ENABLE_CUDASIM is set, which leaves no GPU"
    if not torch.cuda.is_available():
        return "torch finds no GPU"
    if importlib.util.find_spec("numba_cuda") is None:
        return "numba-cuda is not installed"
    found: bool = cuda.is_available()
    return None if found else "numba-cuda finds no GPU"


class CudaBackend:
    """The worlds of an engine in torch tensors; see ``backend.Backend``.

    Nothing here waits for the device but :meth:`raise_fault` and :meth:`host`. What a captured
    graph has to find changed later (seed, number of the draw, first fault) is in tensors.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._device = Device()
        worlds, n, _ = plan.actions_shape
        real = np.dtype(plan.config.dtype)
        with self._device.torch:
            self.now = make_episode(worlds, n, real, torch)
            self.final = make_episode(worlds, n, real, torch)
            self.memory = make_memory(worlds, n, plan.config, self.now, torch)
            self.output = make_output(worlds, n, plan.obs_size, real, torch)
            self._control = kernels.Control(
                seed=torch.tensor([int(plan.constants["seed"][0])]),
                draw=torch.zeros(1, dtype=torch.int64),
                fault=torch.tensor([int(kernels.NO_FAULT)]),
            )
            self._everyone = torch.ones(worlds, dtype=torch.bool)
            self._geometry = Geometry(*map(self._tensor, plan.geometry))
            self._actions = torch.zeros(plan.actions_shape, dtype=getattr(torch, real.name))
        self._connect()

    @property
    def xp(self) -> ModuleType:
        """The module of the arrays."""
        return torch

    # -- the cycle ---------------------------------------------------------------------------------

    def reseed(self, seed: int) -> None:
        """Use another seed, and number episodes and draws from 0 again."""
        self._control.seed.fill_(seed)
        self._control.draw.zero_()
        self.memory.episode[:] = -1

    def reset(self, mask: Any) -> None:
        """Begin a new episode in the masked worlds, or in all.

        Raises:
            ActionError: the mask is no such tensor; or, before anything is reset, what
                :meth:`raise_fault` raises.
        """
        chosen = self._everyone if mask is None else self._checked_mask("mask", mask)
        self.raise_fault()
        self._run(
            kernels.reset_kernel(self.plan.obs_size),
            self._constants,
            *self._arrays,
            self._out,
            self._call(self._actions, chosen),
            self._controls,
        )

    def step(self, actions: Any, active: Any) -> None:
        """Step the worlds; those with a fault rest.

        Raises:
            ActionError: no tensor on this device, wrong shape, or not numeric.
        """
        n, size = self.plan.actions_shape[1], self.plan.obs_size
        moving = self._everyone if active is None else self._checked_mask("active", active)
        self._run(
            kernels.step_kernel(n, size, self.plan.config.dtype),
            self._constants,
            *self._arrays,
            self._last,
            self._out,
            self._call(self._checked_actions(actions), moving),
            self._controls,
        )

    def raise_fault(self) -> None:
        """Raise the first fault of the steps so far, and forget all; waits for the device.

        Raises:
            ActionError: an action was not finite.
            StepError: a world was stepped that waited for a reset, or left out although it did not.
        """
        if self._device.is_capturing():
            return
        fault = int(self._control.fault)
        if fault == kernels.NO_FAULT:
            return
        self._control.fault.fill_(int(kernels.NO_FAULT))
        world, kind = divmod(fault, kernels.KINDS)
        if kind == kernels.NOT_FINITE:
            raise ActionError(
                f"actions[{world}] of an earlier step (world {world}): not finite; "
                "allowed: finite numbers, clipped to [-1, 1]"
            )
        if kind == kernels.WAITING:
            was_reset = int(self.memory.episode[world]) >= 0
            raise StepError("an earlier step: " + waiting_problem(world, was_reset=was_reset))
        raise StepError("an earlier step: " + left_out_problem(world))

    def _checked_actions(self, actions: Any) -> torch.Tensor:
        """The actions in the engine's precision. Their values are the kernel's to judge."""
        given = self._checked_tensor("actions", actions)
        if given.shape != self._actions.shape:
            raise ActionError(actions_shape_problem(tuple(given.shape), self.plan))
        if given.dtype == torch.bool or given.is_complex():
            raise ActionError(f"actions: dtype {given.dtype}; allowed: a real number type")
        if given.dtype == self._actions.dtype and given.is_contiguous():
            return given
        if given.dtype.itemsize > self._actions.dtype.itemsize and given.is_floating_point():
            given = torch.where(given.isfinite(), given.clamp(-1, 1), given)
        return self._actions.copy_(given)

    def _checked_mask(self, name: str, mask: Any) -> torch.Tensor:
        given = self._checked_tensor(name, mask)
        if given.shape != self._everyone.shape or given.dtype != torch.bool:
            worlds = self.plan.num_worlds
            raise ActionError(mask_problem(name, tuple(given.shape), given.dtype, worlds))
        return given.contiguous()

    def _checked_tensor(self, name: str, value: Any) -> torch.Tensor:
        place = self._device.torch
        if isinstance(value, torch.Tensor) and value.device == place:
            return value.detach()
        what = value.device if isinstance(value, torch.Tensor) else type(value).__name__
        raise ActionError(f"{name}: {what}; allowed: a torch tensor on {place}")

    @property
    def counters(self) -> dict[str, torch.Tensor]:
        """The seed and the number of the next draw, tensors (1,)."""
        return {"seed": self._control.seed, "draw": self._control.draw}

    def recount(self) -> None:
        """Nothing: the kernels look at the tensors alone."""

    # -- what happened -----------------------------------------------------------------------------

    def infos(self) -> torch.Tensor:
        """What is known of each robot as of the last step, (W, n, 12) float64."""
        worlds, n, _ = self.plan.actions_shape
        rows = self._empty((worlds, n, len(INFO_COLUMNS)), torch.float64)
        arguments = (self._constants, *self._arrays, self._last, self._out, self._rows(rows))
        self._run(kernels.plain_kernel(kernels.infos), *arguments)
        return rows

    def states(self, *, final: bool) -> torch.Tensor:
        """The paper's vectors, (W, 4n + 1) real."""
        worlds, n, _ = self.plan.actions_shape
        rows = self._empty((worlds, 4 * n + 1), self._actions.dtype)
        geometry, memory, now = self._arrays
        episode = self._last if final else now
        kernel = kernels.plain_kernel(kernels.states)
        self._run(kernel, geometry, memory, episode, self._rows(rows))
        return rows

    def draw_actions(self) -> torch.Tensor:
        """Uniform random actions, (W, n, 2) float32."""
        rows = self._empty(self.plan.actions_shape, torch.float32)
        self._run(kernels.plain_kernel(kernels.draw), self._controls, self._rows(rows))
        self._control.draw.add_(1)
        return rows

    def host(self, array: Any) -> NDArray[Any]:
        """A NumPy copy; waits for the device."""
        copy: NDArray[Any] = array.cpu().numpy().copy()
        return copy

    # -- the kernels -------------------------------------------------------------------------------

    def _tensor(self, table: NDArray[Any]) -> Any:
        return torch.as_tensor(table, device=self._device.torch)

    def _empty(self, shape: tuple[int, ...], dtype: torch.dtype) -> torch.Tensor:
        return torch.empty(shape, dtype=dtype, device=self._device.torch)

    def _rows(self, rows: torch.Tensor) -> tuple[Any]:
        return (self._device.array(rows),)

    def _call(self, actions: torch.Tensor, active: torch.Tensor) -> kernels.Call:
        return kernels.Call(self._device.array(actions), self._device.array(active))

    def _run(self, kernel: Any, *arguments: Any) -> None:
        threads = kernels.threads_per_block(self.plan.obs_size)
        blocks = -(-self.plan.num_worlds // threads)
        self._device.launch(kernel, blocks, threads, *arguments)

    # -- copies ------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        """All but what :meth:`_connect` makes."""
        made = ("_constants", "_arrays", "_last", "_out", "_controls", "_device")
        return {name: vars(self)[name] for name in vars(self) if name not in made}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make a copy that goes on exactly as the original would."""
        vars(self).update(state)
        self._device = Device()
        self._connect()

    def _connect(self) -> None:
        """Make the kernels' views of the tensors, once: that takes longer than a launch."""
        self.memory = share_bits(self.memory, self.now, torch)

        def arrays(tensors: Any) -> Any:
            return type(tensors)(*map(self._device.array, tensors))

        real = np.dtype(self.plan.config.dtype).type
        values = self.plan.constants[0].item()
        self._constants = Constants(*(v if isinstance(v, int) else real(v) for v in values))
        self._arrays = arrays(self._geometry), arrays(self.memory), arrays(self.now)
        self._last, self._out = arrays(self.final), arrays(self.output)
        self._controls = arrays(self._control)
