"""The worlds of an engine in arrays, and the kernels that step them."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.engine import kernels, state
from mbn_marl.engine.arguments import Arguments
from mbn_marl.engine.state import Array, Geometry
from mbn_marl.engine.step import make_scratch
from mbn_marl.engine.tables import with_room
from mbn_marl.engine.validation import REAL, as_array
from mbn_marl.errors import ActionError, StepError
from mbn_marl.jit.compile import address_of


@dataclass(frozen=True, eq=False)
class BackendSpec:
    config: NavigationConfig  # with the team size filled in
    num_worlds: int
    obs_size: int
    autoreset: str
    threads: int | None
    seed: int
    geometry: Geometry  # in NumPy arrays
    constants: NDArray[Any]  # (1,) record
    arena: tuple[float, float]
    teams_vary: bool

    @property
    def actions_shape(self) -> tuple[int, int, int]:
        return self.num_worlds, self.geometry.team.limits.shape[1], 2


class Backend:
    """The worlds in NumPy arrays, on the CPU; ``cuda.CudaBackend`` has them in torch's."""

    xp: ModuleType = np
    derived: tuple[str, ...] = ("arguments", "cuts")
    """The attributes that :meth:`connect` makes, and a copy makes for itself."""

    def __init__(self, spec: BackendSpec) -> None:
        self.geometry = spec.geometry
        self._make_worlds(spec)
        self._count_waiting = spec.num_worlds
        self.connect()

    def _make_worlds(self, spec: BackendSpec) -> None:
        (worlds, n, _), config, xp = spec.actions_shape, spec.config, self.xp
        m = spec.geometry.field.rois.shape[1]
        self.spec, self.real = spec, getattr(xp, config.dtype)
        self.now = state.make_episode(worlds, n, config, spec.teams_vary, xp)
        # Nobody reads what robots knew at the end.
        final = state.make_episode(worlds, n, config, spec.teams_vary, xp)
        self.final = final._replace(knows=final.knows[:0])
        self.memory = state.make_memory(worlds, n, m, config, self.now, xp)
        self.output = state.make_output(worlds, n, spec.obs_size, config, xp)
        self._everyone = xp.ones(worlds, dtype=xp.bool)
        self._actions = xp.zeros(spec.actions_shape, dtype=self.real)
        self._allowed_actions = f"{spec.actions_shape} (worlds, robots, axes)"
        self.memory.seed[:] = spec.seed

    # -- the cycle: reset, step --------------------------------------------------------------------

    def reset(self, mask: Any) -> None:
        chosen = self._checked_mask("mask", mask)
        kernels.reset_worlds(self.arguments, chosen, 0, self.spec.num_worlds, True)
        self.recount()

    def step(self, actions: Any, active: Any) -> None:
        forces = self.checked_actions(actions)
        parked = None
        if self._count_waiting or active is not None:
            waiting, moving = self._waits(), self._checked_mask("active", active)
            for world in np.flatnonzero(moving & waiting):
                raise self._waiting(int(world))
            for world in np.flatnonzero(~moving & ~waiting):
                raise self._left_out(int(world))
            parked = np.flatnonzero(~moving)
            kept = [array[..., parked] for array in self.now], self.memory.plan[parked]
        if not self.arguments.resets and self.spec.autoreset != "disabled":
            # Machine code of a step finds that of a reset by its address: it is compiled here.
            asked = self._everyone, 0, self.spec.num_worlds, True
            self.arguments.reset_by(address_of(kernels.reset_worlds, self.arguments, *asked))
        ended = kernels.step_all(self.arguments, forces, self.cuts)
        if self.spec.autoreset == "disabled":
            self._count_waiting = ended
        if parked is not None:
            self._restore(parked, *kept)

    def _restore(self, parked: NDArray[np.intp], kept: list[Array], plan: Array) -> None:
        for array, columns in zip(self.now, kept, strict=True):
            array[..., parked] = columns
        self.memory.plan[parked] = plan
        mask = np.zeros(self.spec.num_worlds, np.bool_)
        mask[parked] = True
        kernels.rest_worlds(self.arguments, mask)
        self.recount()

    def _waits(self) -> NDArray[np.bool_]:
        if self.spec.autoreset == "disabled":
            return self.memory.pending
        return self.memory.episode < 0

    def recount(self) -> None:
        self._count_waiting = int(np.count_nonzero(self._waits()))

    def raise_fault(self) -> None:
        """Raise what a step has found wrong and could not raise itself; here there is nothing."""

    def make_room(self, edges: int, waypoints: int) -> None:
        larger = with_room(self.geometry, edges, waypoints, self.xp)
        if larger is not self.geometry:
            self.geometry = larger
            self.connect()

    # -- arrays ------------------------------------------------------------------------------------

    def empty(self, shape: tuple[int, ...], dtype: Any) -> Any:
        return np.empty(shape, dtype)

    def host(self, array: Any) -> NDArray[Any]:
        return np.array(array)

    def write_infos(self, rows: Any) -> None:
        """Fill (W, n + 1, columns) float64: see ``kernels.put_infos``."""
        kernels.write_infos(self.arguments, rows)

    def write_states(self, final: bool, rows: Any) -> None:
        """Fill (W, size) real: see ``observations.put_state``."""
        kernels.write_states(self.arguments, final, rows)

    def write_draw(self, rows: Any) -> None:
        kernels.draw_actions(self.arguments, rows)

    # -- what is given -----------------------------------------------------------------------------

    def checked_actions(self, actions: Any) -> Any:
        allowed = self._allowed_actions
        given = self.given("actions", actions, allowed)
        if given.shape != self._actions.shape:
            raise ActionError(f"actions: shape {tuple(given.shape)}; allowed: {allowed}")
        if not self._is_real(given):
            raise ActionError(f"actions: dtype {given.dtype}; allowed: a real number type")
        return self._in_precision(given)

    def _checked_mask(self, name: str, mask: Any) -> Any:
        if mask is None:
            return self._everyone
        worlds = self.spec.num_worlds
        allowed = f"({worlds},) of bool"
        given = self.given(name, mask, allowed)
        if tuple(given.shape) != (worlds,) or given.dtype != self.xp.bool:
            wrong = f"shape {tuple(given.shape)} of {given.dtype}"
            raise ActionError(f"{name}: {wrong}; allowed: {allowed}")
        return given

    def _waiting(self, world: int, place: str = "") -> StepError:
        why = "has ended" if self.memory.episode[world] >= 0 else "was never reset"
        return StepError(f"{place}world {world} {why}; allowed: reset() or reset_worlds() first")

    def _left_out(self, world: int, place: str = "") -> StepError:
        problem = f"{place}world {world} is left out of the step"
        return StepError(f"{problem}; allowed: only ended worlds")

    def given(self, name: str, value: Any, allowed: str) -> Any:
        try:
            return as_array(value)
        except (TypeError, ValueError) as error:
            raise ActionError(f"{name}: {error}; allowed: {allowed}") from None

    def _is_real(self, given: Any) -> bool:
        return given.dtype.kind in REAL

    def _in_precision(self, given: Any) -> Any:
        if given.dtype.kind == "f" and not self._all_finite(given):
            world, robot = np.argwhere(~np.isfinite(given).all(axis=2))[0]
            raise ActionError(
                f"actions[{world}, {robot}] (world {world}, robot_{robot}): "
                f"{given[world, robot].tolist()}; allowed: finite numbers, clipped to [-1, 1]"
            )
        if given.dtype == self.real and given.flags.c_contiguous:
            return given
        # As np.clip, which takes twice as long.
        return np.minimum(np.maximum(given, -1.0), 1.0, out=self._actions, casting="unsafe")

    def _all_finite(self, actions: Array) -> bool:
        if actions.dtype not in (np.float32, np.float64) or not actions.flags.c_contiguous:
            return bool(np.isfinite(actions).all())
        return bool(kernels.all_finite(actions))

    # -- copies ------------------------------------------------------------------------------------

    def connect(self) -> None:
        self.memory = state.share_bits(self.memory, self.now, self.xp)
        self.cuts = kernels.cuts_of(self.spec.num_worlds, self.spec.threads)
        self.arguments = self.arguments_with(self.geometry.team.limits)

    def arguments_with(self, limits: Array) -> Arguments:
        spec, team = self.spec, self.geometry.team._replace(limits=limits)
        sizes = spec.num_worlds, limits.shape[1], spec.obs_size, self.real
        scratch = [make_scratch(*sizes) for _ in self.cuts[1:]]
        geometry = self.geometry._replace(team=team)
        parts = geometry, self.memory, self.now, self.final, self.output
        return Arguments(spec.constants, parts, scratch)

    def __getstate__(self) -> dict[str, Any]:
        return {name: vars(self)[name] for name in vars(self) if name not in self.derived}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        vars(self).update(kept)
        self.connect()
