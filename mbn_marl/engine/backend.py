"""The worlds of an engine on one kind of device, and what all kinds share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.engine import state
from mbn_marl.engine.geometry import column_of, read_field, sampler_numbers, with_room
from mbn_marl.engine.kernels import INFO_COLUMNS, MEASURES
from mbn_marl.engine.mdp.drawn import WIND_X, WIND_Y, rows_of_drawn
from mbn_marl.engine.mdp.failures import ABSENT, FAILED
from mbn_marl.engine.mdp.rewards import COLLISION, RESTED, SUCCESS
from mbn_marl.engine.snapshot import Snapshot
from mbn_marl.engine.state import Array, Episode, Geometry, Memory, Output
from mbn_marl.errors import ActionError, StepError, install
from mbn_marl.field import Field, FieldSampler
from mbn_marl.field.generator.layout import Tables

CUDA_NEEDS = (
    "device: 'cuda' needs an NVIDIA GPU, a torch that can use it (see pytorch.org), "
    f"and numba-cuda: {install('cuda')}"
)


@dataclass(frozen=True, eq=False)
class BackendSpec:
    """The settings and tables that a backend is made from.

    Attributes:
        config: with the team size filled in.
        num_worlds: W.
        obs_size: entries of a robot's observation.
        autoreset: the mode's name.
        threads: of the CPU.
        seed: key of the random numbers.
        geometry: NumPy tables of the field, or of each world's.
        constants: the MDP's, (1,) record.
        arena: width and height, units.
        teams_vary: whether robots may be absent.
    """

    config: NavigationConfig
    num_worlds: int
    obs_size: int
    autoreset: str
    threads: int | None
    seed: int
    geometry: Geometry
    constants: NDArray[Any]
    arena: tuple[float, float]
    teams_vary: bool

    @property
    def actions_shape(self) -> tuple[int, int, int]:
        """The shape of an action, (W, n, 2)."""
        return self.num_worlds, self.geometry.robots.shape[1], 2


class Backend(ABC):
    """The worlds on one kind of device; what differs between kinds is left to subclasses.

    Attributes:
        spec: what it was made from.
        geometry: the tables of the present fields.
        now: the present episode of each world.
        final: the last finished ones (autoreset same-step).
        memory: what outlives or supports an episode.
        output: what the last step or reset returned.
        xp: the module of the arrays: numpy or torch.
        derived: the attributes that :meth:`_connect` makes, and a copy makes for itself.
    """

    xp: ModuleType
    derived: tuple[str, ...]
    spec: BackendSpec
    geometry: Geometry
    now: Episode
    final: Episode
    memory: Memory
    output: Output

    def _make_worlds(self, spec: BackendSpec) -> None:
        """Make all arrays, on the default device of ``xp``."""
        (worlds, n, _), config, xp = spec.actions_shape, spec.config, self.xp
        m = spec.geometry.rois.shape[1]
        self.spec, self._real = spec, getattr(xp, config.dtype)
        self._drawn_rows = rows_of_drawn(config, n)
        self.now = state.make_episode(worlds, n, config, spec.teams_vary, xp)
        self.final = state.make_episode(worlds, n, config, spec.teams_vary, xp)
        self.memory = state.make_memory(worlds, n, m, config, self.now, xp)
        self.output = state.make_output(worlds, n, spec.obs_size, config, xp)
        self._everyone = xp.ones(worlds, dtype=xp.bool)
        self._actions = xp.zeros(spec.actions_shape, dtype=self._real)
        self._allowed_actions = f"{spec.actions_shape} (worlds, robots, axes)"
        self.memory.seed[:] = spec.seed

    def reseed(self, seed: int, episode: int) -> None:
        """Use another seed, and number the next episodes from ``episode`` on, draws from 0."""
        self.memory.seed[:] = seed
        self.memory.draw[:] = 0
        self.memory.episode[:] = episode - 1

    @abstractmethod
    def reset(self, mask: Any) -> None:
        """Begin a new episode in the worlds of a mask (W,), or in all if it is ``None``."""

    @abstractmethod
    def step(self, actions: Any, active: Any) -> None:
        """Check the arguments and step the worlds."""

    def infos(self) -> Array:
        """See ``BatchEngine.infos``; the row after the robots' is the team's."""
        worlds, n, _ = self._actions.shape
        rows: Array = self._empty((worlds, n + 1, len(INFO_COLUMNS)), self.xp.float64)
        self._write_infos(rows)
        return rows

    def states(self, *, final: bool) -> Array:
        """See ``BatchEngine.state`` and ``BatchEngine.final_state``."""
        worlds, n, _ = self.spec.actions_shape
        size = 4 * n + self.now.heading.shape[0] + self.now.status.shape[0] + 1
        rows: Array = self._empty((worlds, size), self._real)
        self._write_states(self.final if final else self.now, rows)
        return rows

    def snapshot(self, field: Field, world: int) -> Snapshot:
        """See ``BatchEngine.snapshot``; ``field`` is the world's."""
        self.raise_fault()
        now, config, host = self.now, self.config_in(world), self.host
        n, steps, visited = now.x.shape[0], int(now.steps[world]), int(now.visited[world])
        outcome = int(self.output.outcomes[world]) if steps else 0
        left_out = outcome & RESTED and bool(self.memory.pending[world])
        bits = host(self.geometry.roi_bits[: len(field.rois), self._column(world)])
        team = int(self.geometry.robots_in[self._column(world)])
        failed = self.failed(world)[:team]
        trail = host(self.memory.trail[world, : (steps + 1) * n]).reshape(-1, n, 2)
        made = Snapshot(
            field=field,
            positions=np.stack([host(now.x[:team, world]), host(now.y[:team, world])], axis=-1),
            velocities=np.stack([host(now.vx[:team, world]), host(now.vy[:team, world])], axis=-1),
            visited=(visited & bits) != 0,
            headings=self.headings(world)[:team],
            failed=failed,
            gone=failed & (config.failures is not None and config.failures.kind == "vanish"),
            trail=trail[:, :team],
            step=steps,
            team_return=float(now.team_return[world]),
            winds=np.array([self.wind(world)]),
            roi_radius=config.roi_radius,
            safety_distance=config.safety_distance,
            success=outcome & (SUCCESS | COLLISION) == SUCCESS,
            collision=bool(outcome & COLLISION),
        )
        return made.judged() if left_out else made

    def _column(self, world: int) -> int:
        """The column of a world in the tables of its field."""
        return world if self.geometry.codes.shape[0] > 1 else 0

    def field_in(self, world: int) -> Field:
        """The field of the present episode of a world, from its tables."""
        f, g = self._column(world), self.geometry
        tables = Tables(*(self.host(getattr(g, name)[..., f : f + 1]) for name in Tables._fields))
        number = int(self.spec.constants["first_world"][0]) + world
        name = f"world-{number}-{int(self.memory.episode[world])}"
        return read_field(tables, self.spec.arena, name)

    def set_field(self, world: int, field: Field, starts: Array | None) -> None:
        """See ``BatchEngine.set_field``; all is allowed."""
        f = self._column(world)
        parts = column_of(field, self.geometry, self.spec.config, self.spec.teams_vary, starts)
        self.make_room(parts["edges"].shape[1], parts["waypoints"].shape[1])
        for name, part in parts.items():
            table = getattr(self.geometry, name)[..., f]
            table[tuple(map(slice, part.shape[:-1]))] = self.xp.asarray(part[..., 0])
        if self.geometry.kept.shape[0]:
            self.geometry.kept[f] = True

    def set_sampler(self, sampler: FieldSampler) -> None:
        """See ``BatchEngine.set_sampler``; all is allowed."""
        self.geometry.sampler[:] = self.xp.asarray(sampler_numbers(sampler))

    def make_room(self, edges: int, waypoints: int) -> None:
        """Make room for so many edges and waypoints, where there is less."""
        larger = with_room(self.geometry, edges, waypoints, self.xp)
        if larger is not self.geometry:
            self.geometry = larger
            self._connect()

    def wind(self, world: int) -> tuple[float, float]:
        """The velocity that wind and gust add in the next step of a world, units/step."""
        if self.now.drawn.ndim == 2:
            x, y = self.host(self.now.drawn[WIND_X : WIND_Y + 1, world]).tolist()
        else:
            x, y = self.spec.config.wind_increment()
        if self.now.gust.ndim != 2:
            return x, y
        gust_x, gust_y = self.host(self.now.gust[:, world]).tolist()
        return x + gust_x, y + gust_y

    def config_in(self, world: int) -> NavigationConfig:
        """The configuration with the numbers that a world's present episode has drawn."""
        drawn = self.drawn(final=False)
        own = {name: float(numbers[world]) for name, numbers in drawn.items()}
        return self.spec.config.with_drawn(own)

    def drawn(self, *, final: bool) -> dict[str, Array]:
        """See ``BatchEngine.drawn`` and ``BatchEngine.final_drawn``."""
        episode, copied = self.final if final else self.now, self.xp.concatenate
        return {name: copied([episode.drawn[row]]) for name, row in self._drawn_rows.items()}

    def headings(self, world: int) -> NDArray[Any]:
        """The robots' headings in a world, (n,), radians; NaN for those without one."""
        now, none = self.now, np.full(self.spec.actions_shape[1], np.nan, self.spec.config.dtype)
        if not now.heading.shape[0]:
            return none
        parts = (self.host(part[:, world]) for part in (now.heading, now.cos, now.sin))
        heading, cos, sin = parts
        return np.where((cos != 0) | (sin != 0), heading, none)

    def failed(self, world: int) -> NDArray[np.bool_]:
        """Which robots of a world have failed, (n,)."""
        if self.now.status.ndim != 2:
            return np.zeros(self.spec.actions_shape[1], np.bool_)
        failed: NDArray[np.bool_] = self.host(self.now.status[:, world]) == FAILED
        return failed

    def failures(self) -> Array:
        """Which robots have failed, (W, n) bool, a fresh array."""
        return self._have_status(FAILED)

    def working(self) -> Array:
        """Which robots are in the team and have not failed, (W, n) bool, a fresh array."""
        resting: Array = self._have_status(FAILED) | self._have_status(ABSENT)
        return ~resting

    def present(self) -> Array:
        """Which robots are in the team, (W, n) bool, a fresh array."""
        there: Array = ~self._have_status(ABSENT)
        return there

    def _have_status(self, status: int) -> Array:
        """Which robots have a status, (W, n) bool, a fresh array."""
        worlds, n, _ = self.spec.actions_shape
        found: Array = self._empty((worlds, n), self.xp.bool)
        found[...] = status == self.now.status.T if self.now.status.ndim == 2 else False
        return found

    def metrics(self, names: Collection[str], same_step: bool) -> dict[str, Array]:
        """See ``BatchEngine.metrics``."""
        outcomes, has_status = self.output.outcomes, self.now.status.ndim == 2
        collision = (outcomes & COLLISION) > 0
        ended = (self.output.terminated | self.output.truncated) & same_step

        def last(name: str) -> Array:
            """Return the part ``name`` of the episodes that the last step was of, ([n,] W)."""
            part: Array = self.xp.where(ended, getattr(self.final, name), getattr(self.now, name))
            return part

        measures: dict[str, Callable[[], Array]] = {
            "success": lambda: ((outcomes & SUCCESS) > 0) & ~collision,
            "collision": lambda: collision,
            "steps": lambda: last("steps"),
            "episode_return": lambda: last("team_return"),
            "rois_visited": lambda: self._count_bits(last("visited") & last("codes")),
            "wall_hits": lambda: last("wall_hits").T,
            "failed": lambda: (
                last("status").T == FAILED if has_status else self._have_status(FAILED)
            ),
            "return_": lambda: last("returns").T,
        }
        if not set(names) <= set(measures):
            infos = self.infos()[:, :-1]
            columns = {name: infos[..., k] for k, name in enumerate(MEASURES)}
            measures |= {
                name: partial(columns.__getitem__, name) for name in ("path_length", "impulse")
            }
        return {name: measures[name]() for name in names}

    def _count_bits(self, codes: Array) -> Array:
        """Count the ROIs in visit codes (W,) int32, as a fresh array."""
        rois = range(self.geometry.rois.shape[1])
        count: Array = sum((codes >> k & 1 for k in rois), self.xp.zeros_like(codes))
        return count

    def draw_actions(self) -> Array:
        """The seed's next random actions, a fresh array."""
        rows: Array = self._empty(self.spec.actions_shape, self.xp.float32)
        draw = self.memory.draw
        self._write_draw(rows)
        draw += 1
        return rows

    def recount(self) -> None:  # noqa: B027 - where nothing is counted, there is nothing to do
        """Take note that the arrays were written from outside."""

    def raise_fault(self) -> None:  # noqa: B027 - where a step raises what it finds
        """Raise what a step has found wrong and could not raise itself."""

    @abstractmethod
    def host(self, array: Any) -> NDArray[Any]:
        """A NumPy copy of an array of this backend."""

    # -- what is given -----------------------------------------------------------------------------

    def checked_actions(self, actions: Any) -> Any:
        """Return the actions in the engine's precision.

        Raises:
            ActionError: wrong shape, not numeric, or found not to be finite.
        """
        allowed = self._allowed_actions
        given = self._given("actions", actions, allowed)
        if given.shape != self._actions.shape:
            raise ActionError(f"actions: shape {tuple(given.shape)}; allowed: {allowed}")
        if not self._is_real(given):
            raise ActionError(f"actions: dtype {given.dtype}; allowed: a real number type")
        return self._in_precision(given)

    def _checked_mask(self, name: str, mask: Any) -> Any:
        """Return a mask of the worlds; ``None`` is that of all."""
        if mask is None:
            return self._everyone
        worlds = self.spec.num_worlds
        allowed = f"({worlds},) of bool"
        given = self._given(name, mask, allowed)
        if tuple(given.shape) != (worlds,) or given.dtype != self.xp.bool:
            wrong = f"shape {tuple(given.shape)} of {given.dtype}"
            raise ActionError(f"{name}: {wrong}; allowed: {allowed}")
        return given

    def _waiting(self, world: int, place: str = "") -> StepError:
        """The error of a step of a world that waits for a reset."""
        why = "has ended" if self.memory.episode[world] >= 0 else "was never reset"
        return StepError(f"{place}world {world} {why}; allowed: reset() or reset_worlds() first")

    @staticmethod
    def _left_out(world: int, place: str = "") -> StepError:
        """The error of a step without a world that is in an episode."""
        return StepError(
            f"{place}world {world} is left out of the step; allowed: only ended worlds"
        )

    # -- what differs between devices --------------------------------------------------------------

    @abstractmethod
    def _given(self, name: str, value: Any, allowed: str) -> Any:
        """An argument as an array of this backend, or an error that says what is allowed."""

    @abstractmethod
    def _is_real(self, given: Any) -> bool:
        """Return whether an array holds real numbers."""

    @abstractmethod
    def _in_precision(self, given: Any) -> Any:
        """Actions of the right shape in the engine's precision."""

    @abstractmethod
    def _empty(self, shape: tuple[int, ...], dtype: Any) -> Any: ...

    @abstractmethod
    def _write_infos(self, rows: Any) -> None: ...

    @abstractmethod
    def _write_states(self, episode: Episode, rows: Any) -> None: ...

    @abstractmethod
    def _write_draw(self, rows: Any) -> None: ...

    # -- copies ------------------------------------------------------------------------------------

    def _connect(self) -> None:
        """Make what refers to the arrays."""
        self.memory = state.share_bits(self.memory, self.now, self.xp)

    def __getstate__(self) -> dict[str, Any]:
        """All but what :meth:`_connect` makes."""
        return {name: vars(self)[name] for name in vars(self) if name not in self.derived}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        """Make a copy that continues exactly as the original would."""
        vars(self).update(kept)
        self._connect()
