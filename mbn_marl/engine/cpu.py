"""The worlds on the CPU: NumPy arrays, compiled loops, threads."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.engine import kernels
from mbn_marl.engine.backend import (
    Plan,
    actions_shape_problem,
    left_out_problem,
    mask_problem,
    waiting_problem,
)
from mbn_marl.engine.state import Array, make_episode, make_memory, make_output, share_bits
from mbn_marl.engine.store import Store
from mbn_marl.engine.threads import WorldThreads
from mbn_marl.errors import ActionError, StepError

Flags = NDArray[np.bool_]


class CpuBackend:
    """The worlds of an engine in NumPy arrays; see ``backend.Backend``.

    Attributes:
        store: all arrays, as the kernels take them.
        threads: what shares the worlds among threads.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        worlds, n, _ = plan.actions_shape
        self.dtype = np.dtype(plan.config.dtype)
        self.now = make_episode(worlds, n, self.dtype)
        self.final = make_episode(worlds, n, self.dtype)
        self.memory = make_memory(worlds, n, plan.config, self.now)
        self.output = make_output(worlds, n, plan.obs_size, self.dtype)
        self._actions = np.zeros(plan.actions_shape, self.dtype)
        self._waiting = worlds
        self._draw = np.zeros(1, np.int64)
        self._connect()

    @property
    def xp(self) -> ModuleType:
        """The module of the arrays."""
        return np

    # -- the cycle ---------------------------------------------------------------------------------

    def reseed(self, seed: int) -> None:
        """Use another seed, and number episodes and draws from 0 again."""
        self.plan.constants["seed"] = seed
        self.memory.episode[:] = -1
        self._draw[:] = 0

    def reset(self, mask: Any) -> None:
        """Begin a new episode in the masked worlds, or in all.

        Raises:
            ActionError: the mask has another shape or type.
        """
        chosen = np.ones(self.plan.num_worlds, np.bool_) if mask is None else np.asarray(mask)
        if chosen.shape != (self.plan.num_worlds,) or chosen.dtype != np.bool_:
            raise ActionError(
                mask_problem("mask", chosen.shape, chosen.dtype, self.plan.num_worlds)
            )
        kernels.reset_worlds(self.store, chosen)
        self.recount()

    def step(self, actions: Any, active: Any) -> None:
        """Step the worlds.

        Raises:
            ActionError: wrong shape, not numeric, or not finite. No world has moved.
            StepError: a world waits for a reset, or is left out although it does not.
        """
        forces = self.checked_actions(actions)
        parked = None
        if self._waiting or active is not None:
            parked = self._checked_waiting(active)
            kept = [array[..., parked] for array in self.now]
        ended = self.threads.step(self.store, forces)
        if self.plan.autoreset == "disabled":
            self._waiting = ended
        if parked is not None:
            self._restore(parked, kept)

    def checked_actions(self, actions: Any) -> Array:
        """The actions in the engine's precision, or an error that names the first offender."""
        try:
            given = np.asarray(actions)
        except ValueError as error:
            raise ActionError(f"actions: {error}; allowed: {self._actions.shape}") from None
        if given.shape != self._actions.shape:
            raise ActionError(actions_shape_problem(given.shape, self.plan))
        if given.dtype.kind not in "fiu":
            raise ActionError(f"actions: dtype {given.dtype}; allowed: a real number type")
        if given.dtype.kind == "f" and not self._all_finite(given):
            world, robot = np.argwhere(~np.isfinite(given).all(axis=2))[0]
            raise ActionError(
                f"actions[{world}, {robot}] (world {world}, robot_{robot}): "
                f"{given[world, robot].tolist()}; allowed: finite numbers, clipped to [-1, 1]"
            )
        if given.dtype == self.dtype and given.flags.c_contiguous:
            return given
        return np.clip(given, -1, 1, out=self._actions, casting="unsafe")

    def _all_finite(self, actions: Array) -> bool:
        if actions.dtype.itemsize < 4 or not actions.flags.c_contiguous:
            return bool(np.isfinite(actions).all())
        return bool(kernels.all_finite(actions))

    def _checked_waiting(self, active: Any) -> NDArray[np.intp]:
        """The ended worlds that this step leaves out, or an error naming the first offender."""
        waiting = self._waits()
        moving = np.ones(self.plan.num_worlds, np.bool_) if active is None else np.asarray(active)
        if moving.shape != waiting.shape or moving.dtype != np.bool_:
            raise ActionError(
                mask_problem("active", moving.shape, moving.dtype, self.plan.num_worlds)
            )
        for world in np.flatnonzero(moving & waiting):
            was_reset = bool(self.memory.episode[world] >= 0)
            raise StepError(waiting_problem(int(world), was_reset=was_reset))
        for world in np.flatnonzero(~moving & ~waiting):
            raise StepError(left_out_problem(int(world)))
        return np.flatnonzero(~moving)

    def _restore(self, parked: NDArray[np.intp], kept: list[Array]) -> None:
        """Undo the step for worlds that were left out of it."""
        for array, columns in zip(self.now, kept, strict=True):
            array[..., parked] = columns
        mask = np.zeros(self.plan.num_worlds, np.bool_)
        mask[parked] = True
        kernels.rest_worlds(self.store, mask)
        self.recount()

    def _waits(self) -> Flags:
        """Which worlds cannot be stepped before a reset."""
        if self.plan.autoreset == "disabled":
            return self.memory.pending
        return self.memory.episode < 0

    @property
    def counters(self) -> dict[str, Array]:
        """The seed and the number of the next draw, arrays (1,)."""
        return {"seed": self.plan.constants["seed"], "draw": self._draw}

    def recount(self) -> None:
        """Count the worlds that wait for a reset."""
        self._waiting = int(np.count_nonzero(self._waits()))

    # -- what happened -----------------------------------------------------------------------------

    def infos(self) -> Array:
        """What is known of each robot as of the last step, (W, n, 12) float64."""
        worlds, n, _ = self.plan.actions_shape
        rows = np.empty((worlds, n, len(kernels.INFO_COLUMNS)))
        kernels.write_infos(self.store, rows)
        return rows

    def states(self, *, final: bool) -> Array:
        """The paper's vectors, (W, 4n + 1) real."""
        worlds, n, _ = self.plan.actions_shape
        states = np.empty((worlds, 4 * n + 1), self.dtype)
        kernels.write_states(self.store, final, states)
        return states

    def draw_actions(self) -> Array:
        """Uniform random actions, (W, n, 2) float32."""
        actions = np.empty(self.plan.actions_shape, np.float32)
        kernels.draw_actions(self.store, int(self._draw[0]), actions)
        self._draw += 1
        return actions

    def raise_fault(self) -> None:
        """Nothing: a step raises what it finds."""

    def host(self, array: Any) -> NDArray[Any]:
        """A copy."""
        return np.array(array)

    # -- copies ------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        """All but what :meth:`_connect` makes."""
        return {name: vars(self)[name] for name in vars(self) if name not in ("store", "threads")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make a copy that goes on exactly as the original would."""
        vars(self).update(state)
        self._connect()

    def _connect(self) -> None:
        """Hand the arrays to the kernels and make the threads."""
        self.memory = share_bits(self.memory, self.now)
        self.threads = WorldThreads(self.plan.num_worlds, self.plan.threads)
        self.store = Store(
            self.plan.constants,
            self.plan.geometry,
            self.memory,
            self.now,
            self.final,
            self.output,
        )
