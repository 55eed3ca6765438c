"""``BatchEngine``: many worlds of the MDP, stepped together."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, TypeGuard, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbn_marl.config import Settings, make_config
from mbn_marl.engine import kernels
from mbn_marl.engine.checks import Autoreset, autoreset_mode, check_setup, seed_problems
from mbn_marl.engine.constants import make_record
from mbn_marl.engine.kernels import INFO_COLUMNS
from mbn_marl.engine.observation import observation_table
from mbn_marl.engine.rewards import COLLISION, REWARD_TERMS, SUCCESS
from mbn_marl.engine.snapshot import Snapshot
from mbn_marl.engine.state import (
    Array,
    make_episode,
    make_geometry,
    make_memory,
    make_output,
)
from mbn_marl.engine.store import Store
from mbn_marl.engine.threads import WorldThreads
from mbn_marl.errors import ActionError, ConfigError, StepError
from mbn_marl.field import Field, load_field

FieldLike = Field | str | os.PathLike[str]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]


class BatchEngine:
    """Many independent worlds of the multi-robot navigation MDP, stepped together.

    Every array that :meth:`reset` and :meth:`step` return is one of the engine's own buffers,
    overwritten by the next call: copy what you keep. W is the number of worlds, n the number of
    robots, m the number of ROIs; ``real`` is the engine's dtype.

    Args:
        field: a catalogue name, a file, a :class:`Field`, or a sequence of them: world w then has
            field ``w % len(field)``. All need the same arena; ROI counts may differ (a missing
            ROI is one that is visited from the start).
        num_worlds: W, at least 1.
        seed: key of all random numbers, 0 to 2^63 - 1.
        autoreset: what happens when an episode ends. ``True`` or ``"same_step"``: the world
            restarts within that step, and its last observation is in :attr:`final_observations`;
            ``"next_step"``: the next step restarts it, whatever its action, with reward 0;
            ``False`` or ``"disabled"``: it waits for :meth:`reset_worlds`.
        threads: how many threads share the worlds; ``None`` takes one per core, but one for small
            batches. The result does not depend on it.
        **settings: see :class:`mbn_marl.config.NavigationConfig`.

    Raises:
        FieldError: a field is invalid or unknown.
        ConfigError: a setting is invalid; all problems are listed.
    """

    def __init__(
        self,
        field: FieldLike | Sequence[FieldLike],
        num_worlds: int = 4096,
        *,
        seed: int = 0,
        autoreset: Autoreset = True,
        threads: int | None = None,
        **settings: Unpack[Settings],
    ) -> None:
        fields: Sequence[FieldLike] = field if _is_several(field) else [field]  # type: ignore[list-item]
        self.fields = tuple(load_field(one) for one in fields)
        config = make_config(settings)
        n = config.n_robots or min((len(one.starts) for one in self.fields), default=1)
        self.config = config.model_copy(update={"n_robots": n})
        self.autoreset = autoreset_mode(autoreset)
        check_setup(self.fields, self.config, n, num_worlds, threads, seed)
        self.num_worlds, self.n_robots, self.thread_count = num_worlds, n, threads
        self.n_rois = max(len(one.rois) for one in self.fields)
        self.dtype = np.dtype(config.dtype)
        self._geometry = make_geometry(self.fields, self.config, n)
        self._constants = make_record(self.config, n, self.field.arena, self.autoreset, seed)
        table = observation_table(self.config, n, self.n_rois, self.field.arena)
        self.observation_table = table
        self.observation_low = np.array([entry.low for entry in table], np.float32)
        self.observation_high = np.array([entry.high for entry in table], np.float32)
        self.obs_size = len(table)
        self._now = make_episode(num_worlds, n, self.dtype)
        self._final = make_episode(num_worlds, n, self.dtype)
        self._memory = make_memory(num_worlds, n, self.config, self._now, len(self.fields))
        self._output = make_output(num_worlds, n, self.obs_size, self.dtype)
        self._actions = np.zeros((num_worlds, n, 2), self.dtype)
        self._waiting = num_worlds
        self._draws = 0
        self._connect()

    # -- what the engine is ------------------------------------------------------------------------

    @property
    def field(self) -> Field:
        """The field, or the first of several."""
        return self.fields[0]

    @property
    def state_low(self) -> Array:
        """Lower bounds of :meth:`state`, (4n + 1,) real."""
        return -self._state_bound(0.0, 0.0)

    @property
    def state_high(self) -> Array:
        """Upper bounds of :meth:`state`, (4n + 1,) real."""
        return self._state_bound(1.0, float(2**self.n_rois - 1))

    def _state_bound(self, arena: float, code: float) -> Array:
        n = self.n_robots
        positions = np.tile(self.field.arena, n) * arena
        speeds = np.full(2 * n, self.config.v_clip)
        return np.concatenate([positions, speeds, [code]]).astype(self.dtype)

    # -- the cycle: reset, step --------------------------------------------------------------------

    def reset(self, seed: int | None = None) -> Floats:
        """Begin a new episode in every world.

        Args:
            seed: key of the random numbers; the episode count restarts at 0. ``None`` keeps the
                seed and goes on to the next episode.

        Returns:
            Observations, (W, n, obs_size) float32.
        """
        if seed is not None:
            if problems := seed_problems(seed):
                raise ConfigError("reset", problems)
            self._constants["seed"] = seed
            self._memory.episode[:] = -1
            self._draws = 0
        return self.reset_worlds(np.ones(self.num_worlds, np.bool_))

    def reset_worlds(self, mask: ArrayLike) -> Floats:
        """Begin a new episode in the worlds where ``mask`` (W,) bool is set.

        Returns:
            The observations of all worlds, (W, n, obs_size) float32.

        Raises:
            ActionError: the mask has another shape or type.
        """
        chosen = np.asarray(mask)
        if chosen.shape != (self.num_worlds,) or chosen.dtype != np.bool_:
            raise ActionError(
                f"mask: shape {chosen.shape} of {chosen.dtype}; "
                f"allowed: ({self.num_worlds},) of bool"
            )
        kernels.reset_worlds(self._store, chosen)
        self._waiting = int(np.count_nonzero(self._waits()))
        return self._output.observations

    def step(
        self, actions: ArrayLike, active: ArrayLike | None = None
    ) -> tuple[Floats, Array, Flags, Flags]:
        """Move every world by one step.

        Args:
            actions: (W, n, 2), finite; values outside [-1, 1] are clipped.
            active: (W,) bool, or ``None`` for all; only with autoreset disabled. Worlds that have
                ended may be left out: they stay as they are, with reward 0 and no flag set.

        Returns:
            ``(observations, rewards, terminated, truncated)``: (W, n, obs_size) float32, (W, n)
            real, and two (W,) bool. A time limit is a truncation, never a termination.

        Raises:
            ActionError: wrong shape, not numeric, or not finite. No world has moved.
            StepError: before the first reset, or, with autoreset disabled, after the end of a
                world.
        """
        forces = self._checked_actions(actions)
        parked = None
        if self._waiting or active is not None:
            parked = self._checked_waiting(active)
            kept = [array[..., parked] for array in self._now]
        ended = self._threads.step(self._store, forces)
        if self.autoreset == "disabled":
            self._waiting = ended
        out = self._output
        if parked is not None:
            self._restore(parked, kept)
        return out.observations, out.rewards, out.terminated, out.truncated

    def _checked_actions(self, actions: ArrayLike) -> Array:
        """The actions in the engine's precision, or an error that names the first offender."""
        try:
            given = np.asarray(actions)
        except ValueError as error:
            raise ActionError(f"actions: {error}; allowed: {self._actions.shape}") from None
        if given.shape != self._actions.shape:
            raise ActionError(
                f"actions: shape {given.shape}; "
                f"allowed: {self._actions.shape} (worlds, robots, axes)"
            )
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

    def _checked_waiting(self, active: ArrayLike | None) -> NDArray[np.intp]:
        """The ended worlds that this step leaves out, or an error naming the first offender."""
        waiting = self._waits()
        moving = np.ones(self.num_worlds, np.bool_) if active is None else np.asarray(active)
        if moving.shape != waiting.shape or moving.dtype != np.bool_:
            raise ActionError(
                f"active: shape {moving.shape} of {moving.dtype}; "
                f"allowed: ({self.num_worlds},) of bool"
            )
        for world in np.flatnonzero(moving & waiting):
            why = "has ended" if self._memory.episode[world] >= 0 else "was never reset"
            raise StepError(f"world {world} {why}; allowed: reset() or reset_worlds() first")
        for world in np.flatnonzero(~moving & ~waiting):
            raise StepError(f"world {world} is left out of the step; allowed: only ended worlds")
        return np.flatnonzero(~moving)

    def _restore(self, parked: NDArray[np.intp], kept: list[Array]) -> None:
        """Undo the step for worlds that were left out of it."""
        for array, columns in zip(self._now, kept, strict=True):
            array[..., parked] = columns
        mask = np.zeros(self.num_worlds, np.bool_)
        mask[parked] = True
        kernels.rest_worlds(self._store, mask)
        self._waiting = int(np.count_nonzero(self._waits()))

    def _waits(self) -> Flags:
        """Which worlds cannot be stepped before a reset."""
        return self._memory.pending if self.autoreset == "disabled" else self._memory.episode < 0

    # -- what happened -----------------------------------------------------------------------------

    @property
    def team_rewards(self) -> Array:
        """The centralised reward of the last step, (W,) real: computed as the team's value."""
        return self._output.team_rewards

    @property
    def final_observations(self) -> Floats:
        """Last observations of the episodes that ended (autoreset same-step), (W, n, obs_size).

        Rows of worlds whose episode goes on hold nothing of use.
        """
        return self._output.final_observations

    def infos(self) -> NDArray[np.float64]:
        """What is known of each agent as of the last step, before any automatic reset.

        Returns:
            A fresh array (W, n, 12); the last axis is ordered as ``INFO_COLUMNS``: ``success``,
            ``rois_visited`` and ``collision`` of the team; the agent's own ``wall_hits``,
            ``path_length`` (units) and ``impulse`` (``|sum over steps of u tau|``, mass x
            units/step) of this episode; and the six terms of its own reward in the last step.
        """
        rows = np.empty((self.num_worlds, self.n_robots, len(INFO_COLUMNS)))
        kernels.write_infos(self._store, rows)
        return rows

    def reward_terms(self) -> Array:
        """The named terms of each agent's own reward in the last step, (W, n, 6) real.

        The last axis is ordered as ``REWARD_TERMS`` and sums to the individual reward.
        """
        return self.infos()[..., -len(REWARD_TERMS) :].astype(self.dtype)

    def state(self) -> Array:
        """The paper's state of every world now, (W, 4n + 1) real, a fresh array.

        All positions ``x1, y1, x2, y2, ...``, then all velocities, then the visit code, whose most
        significant bit is the first ROI.
        """
        return self._states(final=False)

    def final_state(self) -> Array:
        """:meth:`state` at the end of the last finished episodes (autoreset same-step only)."""
        return self._states(final=True)

    def _states(self, *, final: bool) -> Array:
        states = np.empty((self.num_worlds, 4 * self.n_robots + 1), self.dtype)
        kernels.write_states(self._store, final, states)
        return states

    def metrics(self) -> dict[str, Array]:
        """Measures of each episode as of the last step, before any automatic reset.

        Returns:
            ``success``, ``collision`` (W,) bool; ``rois_visited``, ``steps`` (W,) int32;
            ``episode_return`` (W,) float64: the team's; ``wall_hits`` (W, n) int32;
            ``path_length`` (W, n) real, units; ``impulse`` (W, n) real: ``|sum over steps of u
            tau|``, mass x units/step; ``return_`` (W, n) float64: what each agent was given.
        """
        infos, now, final = self.infos(), self._now, self._final
        columns = {name: infos[..., k] for k, name in enumerate(INFO_COLUMNS[:6])}
        ended = self._output.terminated | self._output.truncated
        ended &= self.autoreset == "same_step"
        return {
            "success": columns["success"][:, 0] > 0,
            "collision": columns["collision"][:, 0] > 0,
            "rois_visited": columns["rois_visited"][:, 0].astype(np.int32),
            "steps": np.where(ended, final.steps, now.steps),
            "episode_return": np.where(ended, final.team_return, now.team_return),
            "wall_hits": columns["wall_hits"].astype(np.int32),
            "path_length": columns["path_length"],
            "impulse": columns["impulse"],
            "return_": np.where(ended, final.returns, now.returns).T,
        }

    def sample_actions(self) -> Floats:
        """Uniform random actions, (W, n, 2) float32 in [-1, 1): the seed's next ones."""
        actions = np.empty((self.num_worlds, self.n_robots, 2), np.float32)
        kernels.draw_actions(self._store, self._draws, actions)
        self._draws += 1
        return actions

    def snapshot(self, world: int = 0) -> Snapshot:
        """What a picture of one world needs, copied.

        Raises:
            IndexError: no such world.
        """
        if not 0 <= world < self.num_worlds:
            raise IndexError(f"world {world}; allowed: 0 to {self.num_worlds - 1}")
        now, memory = self._now, self._memory
        outcome = int(self._output.outcomes[world]) if now.steps[world] else 0
        entries = slice(0, (int(now.steps[world]) + 1) * self.n_robots)
        trail = memory.trail[world, entries].copy()
        field = self.fields[int(memory.field[world])]
        bits = self._geometry.roi_bits[: len(field.rois), memory.field[world]]
        return Snapshot(
            field=field,
            positions=np.stack([now.x[:, world], now.y[:, world]], axis=-1),
            velocities=np.stack([now.vx[:, world], now.vy[:, world]], axis=-1),
            visited=(now.visited[world] & bits) != 0,
            trail=trail.reshape(-1, self.n_robots, 2),
            step=int(now.steps[world]),
            team_return=float(now.team_return[world]),
            wind=self.config.wind_increment(),
            roi_radius=self.config.roi_radius,
            safety_distance=self.config.safety_distance,
            success=outcome & (SUCCESS | COLLISION) == SUCCESS,
            collision=bool(outcome & COLLISION),
        )

    # -- copies ------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        """All but what :meth:`_connect` makes."""
        return {name: vars(self)[name] for name in vars(self) if name not in ("_store", "_threads")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make a copy that goes on exactly as the original would."""
        vars(self).update(state)
        self._connect()

    def _connect(self) -> None:
        """Hand the arrays to the kernels and make the threads."""
        bits = self._memory.x_bits.dtype
        self._memory = self._memory._replace(
            x_bits=self._now.x.view(bits),
            y_bits=self._now.y.view(bits),
            trail_bits=self._memory.trail.view(bits),
            trail_key=self._memory.trail.view(np.uint64)[..., 0],
        )
        self._threads = WorldThreads(self.num_worlds, self.thread_count)
        self._store = Store(
            self._constants, self._geometry, self._memory, self._now, self._final, self._output
        )


def _is_several(field: FieldLike | Sequence[FieldLike]) -> TypeGuard[Sequence[FieldLike]]:
    return isinstance(field, Sequence) and not isinstance(field, str)
