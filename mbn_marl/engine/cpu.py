"""The worlds on the CPU: NumPy arrays, compiled loops, threads."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.engine import kernels
from mbn_marl.engine.backend import Backend, BackendSpec
from mbn_marl.engine.state import Array, Episode
from mbn_marl.engine.step import make_scratch
from mbn_marl.engine.store import Store
from mbn_marl.engine.threads import WorldThreads
from mbn_marl.engine.validation import as_array
from mbn_marl.errors import ActionError
from mbn_marl.jit.compile import address_of


class CpuBackend(Backend):
    """The worlds of an engine in NumPy arrays.

    Attributes:
        store: all arrays, as the kernels take them.
        threads: what shares the worlds among threads.
    """

    xp = np
    derived = ("store", "threads")

    def __init__(self, spec: BackendSpec) -> None:
        self.geometry = spec.geometry
        self._make_worlds(spec)
        self._count_waiting = spec.num_worlds
        self._connect()

    def reset(self, mask: Any) -> None:
        """Begin a new episode in the masked worlds, or in all."""
        kernels.reset_worlds(self.store, *self._asked(self._checked_mask("mask", mask)))
        self.recount()

    def step(self, actions: Any, active: Any) -> None:
        """Step the worlds; before that, raise what is wrong with the arguments."""
        forces = self.checked_actions(actions)
        parked = None
        if self._count_waiting or active is not None:
            parked = self._checked_parked(active)
            kept = [array[..., parked] for array in self.now], self.memory.plan[parked]
        if not self.store.resets and self.spec.autoreset != "disabled":
            asked = self._asked(self._everyone)
            self.store.reset_by(address_of(kernels.reset_worlds, self.store, *asked))
        ended = self.threads.step(self.store, forces)
        if self.spec.autoreset == "disabled":
            self._count_waiting = ended
        if parked is not None:
            self._restore(parked, *kept)

    def _asked(self, mask: NDArray[np.bool_]) -> tuple[Any, ...]:
        """The arguments of ``reset_worlds`` for what a caller asks."""
        return mask, 0, self.spec.num_worlds, True

    def _checked_parked(self, active: Any) -> NDArray[np.intp]:
        """The ended worlds that this step leaves out, or an error naming the first offender."""
        waiting, moving = self._waits(), self._checked_mask("active", active)
        for world in np.flatnonzero(moving & waiting):
            raise self._waiting(int(world))
        for world in np.flatnonzero(~moving & ~waiting):
            raise self._left_out(int(world))
        return np.flatnonzero(~moving)

    def _restore(self, parked: NDArray[np.intp], kept: list[Array], plan: Array) -> None:
        """Undo the step for worlds that were left out of it."""
        for array, columns in zip(self.now, kept, strict=True):
            array[..., parked] = columns
        self.memory.plan[parked] = plan
        mask = np.zeros(self.spec.num_worlds, np.bool_)
        mask[parked] = True
        kernels.rest_worlds(self.store, mask)
        self.recount()

    def _waits(self) -> NDArray[np.bool_]:
        """Which worlds cannot be stepped before a reset."""
        if self.spec.autoreset == "disabled":
            return self.memory.pending
        return self.memory.episode < 0

    def recount(self) -> None:
        """Count the worlds that wait for a reset."""
        self._count_waiting = int(np.count_nonzero(self._waits()))

    def host(self, array: Any) -> NDArray[Any]:
        """A copy."""
        return np.array(array)

    def _given(self, name: str, value: Any, allowed: str) -> Array:
        try:
            return as_array(value)
        except (TypeError, ValueError) as error:
            raise ActionError(f"{name}: {error}; allowed: {allowed}") from None

    def _is_real(self, given: Array) -> bool:
        return given.dtype.kind in "fiu"

    def _in_precision(self, given: Array) -> Array:
        if given.dtype.kind == "f" and not self._all_finite(given):
            world, robot = np.argwhere(~np.isfinite(given).all(axis=2))[0]
            raise ActionError(
                f"actions[{world}, {robot}] (world {world}, robot_{robot}): "
                f"{given[world, robot].tolist()}; allowed: finite numbers, clipped to [-1, 1]"
            )
        if given.dtype == self._real and given.flags.c_contiguous:
            return given
        return np.clip(given, -1, 1, out=self._actions, casting="unsafe")  # type: ignore[no-any-return]

    def _all_finite(self, actions: Array) -> bool:
        if actions.dtype not in (np.float32, np.float64) or not actions.flags.c_contiguous:
            return bool(np.isfinite(actions).all())
        return bool(kernels.all_finite(actions))

    def _empty(self, shape: tuple[int, ...], dtype: Any) -> Array:
        return np.empty(shape, dtype)

    def _write_infos(self, rows: Array) -> None:
        kernels.write_infos(self.store, rows)

    def _write_states(self, episode: Episode, rows: Array) -> None:
        kernels.write_states(self.store, episode is self.final, rows)

    def _write_draw(self, rows: Array) -> None:
        kernels.draw_actions(self.store, rows)

    def _connect(self) -> None:
        super()._connect()
        self.threads = WorldThreads(self.spec.num_worlds, self.spec.threads)
        self.store = self.store_with(self.geometry.robots)

    def store_with(self, robots: Array) -> Store:
        """The arrays as the kernels take them, with these numbers of the robots, (3, n)."""
        spec, geometry = self.spec, self.geometry._replace(robots=robots)
        sizes = spec.num_worlds, robots.shape[1], spec.obs_size, self._real
        scratch = [make_scratch(*sizes) for _ in self.threads.cuts[1:]]
        parts = geometry, self.memory, self.now, self.final, self.output
        return Store(spec.constants, parts, scratch)
