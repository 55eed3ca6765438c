"""``BatchEngine``: many worlds of the MDP, stepped together."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TypeGuard, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbn_marl.config import NavigationConfig, Settings, make_config
from mbn_marl.engine import validation
from mbn_marl.engine.backend import BackendSpec
from mbn_marl.engine.constants import make_record
from mbn_marl.engine.devices import make_backend
from mbn_marl.engine.kernels import MEASURES
from mbn_marl.engine.listener import Listener
from mbn_marl.engine.mdp.dynamics import count_headings
from mbn_marl.engine.mdp.observations import observation_table
from mbn_marl.engine.mdp.rewards import COLLISION, REWARD_TERMS, SUCCESS
from mbn_marl.engine.snapshot import Snapshot
from mbn_marl.engine.state import Array, make_geometry
from mbn_marl.engine.state_io import restore_worlds, save_worlds
from mbn_marl.engine.validation import Autoreset, Device
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, load_field

FieldLike = Field | str | os.PathLike[str]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

METRICS = (
    *("success", "collision", "rois_visited", "steps", "episode_return"),
    *("wall_hits", "path_length", "impulse", "failed", "return_"),
)
"""The names of the measures of an episode, in the order of ``BatchEngine.metrics``."""


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
        device: ``"cpu"``, or ``"cuda"``, torch's current CUDA device: a thread per world, on
            torch's current stream. What this class says to be an array is then a torch tensor
            there, actions and masks are too, and :meth:`step` never waits for the device, so that
            it can be captured in a CUDA graph (after a first step outside). See *Faults*.
        threads: how many threads share the worlds on the CPU; ``None`` takes one per core, but one
            for small batches. The result does not depend on it.
        starts: where the robots start in every world, (n, 2) units, instead of the field's own
            starts: in the field, and no two closer than the safety distance.
        first_world: number of the world with index 0, from 0 on. A world's random numbers depend
            on its number, the seed and the number of its episode alone, not on the batch.
        **settings: see :class:`mbn_marl.config.NavigationConfig`.

    Attributes:
        listeners: what to tell of every reset and step, such as a recorder of episodes; empty at
            first. To stop telling one, remove it.

    Faults:
        On the CPU, an action that is not finite and a step of a world that has ended are errors
        before any world moves. On CUDA they are found on the device: the world concerned rests in
        that step (reward 0, no flag set), the others move, and the next :meth:`reset`,
        :meth:`reset_worlds` or :meth:`snapshot` outside a graph's capture raises the error, once,
        for the first such world. Shapes and types are checked at once on both.

    Raises:
        FieldError: a field is invalid or unknown.
        ConfigError: a setting is invalid; all problems are listed. Or CUDA is not to be had: what
            is missing is said.

    Source:
        Choton, Woods, Hsu, sections 3 and 4, and the authors' released code: the rules are those
        of ``docs/mdp.md``.
    """

    def __init__(
        self,
        field: FieldLike | Sequence[FieldLike],
        num_worlds: int = 4096,
        *,
        seed: int = 0,
        autoreset: Autoreset = True,
        device: Device = "cpu",
        threads: int | None = None,
        starts: ArrayLike | None = None,
        first_world: int = 0,
        **settings: Unpack[Settings],
    ) -> None:
        fields: Sequence[FieldLike] = field if _is_several(field) else [field]  # type: ignore[list-item]
        self.fields = tuple(load_field(one) for one in fields)
        config = make_config(settings)
        n = config.n_robots or min((len(one.starts) for one in self.fields), default=1)
        self.config = config.model_copy(update={"n_robots": n})
        self.autoreset = validation.autoreset_mode(autoreset)
        given = None if starts is None else np.asarray(starts)
        validation.check_setup(
            self.fields, self.config, n, num_worlds, threads, seed, device, given, first_world
        )
        self.num_worlds, self.n_robots, self.device = num_worlds, n, device
        self.first_world = first_world
        self.n_rois = max(len(one.rois) for one in self.fields)
        self.dtype = np.dtype(config.dtype)
        table = observation_table(self.config, n, self.n_rois, self.field.arena)
        self.observation_table, self.obs_size = table, len(table)
        self.observation_low = np.array([entry.low for entry in table], np.float32)
        self.observation_high = np.array([entry.high for entry in table], np.float32)
        self.listeners: list[Listener] = []
        self._backend = make_backend(
            device,
            BackendSpec(
                config=self.config,
                num_worlds=num_worlds,
                obs_size=self.obs_size,
                autoreset=self.autoreset,
                threads=threads,
                seed=seed,
                geometry=make_geometry(self.fields, self.config, n, num_worlds, given),
                constants=make_record(
                    self.config, n, self.field.arena, self.autoreset, first_world
                ),
            ),
        )

    # -- what the engine is ------------------------------------------------------------------------

    @property
    def field(self) -> Field:
        """The field, or the first of several."""
        return self.fields[0]

    @property
    def state_low(self) -> Array:
        """Lower bounds of :meth:`state`, (size,) real, raw units."""
        return -self._state_bound(0.0, 0.0)

    @property
    def state_high(self) -> Array:
        """Upper bounds of :meth:`state`, (size,) real, raw units."""
        return self._state_bound(1.0, float(2**self.n_rois - 1))

    def _state_bound(self, arena: float, code: float) -> Array:
        n = self.n_robots
        positions = np.tile(self.field.arena, n) * arena
        speeds = np.full(2 * n, self.config.top_speed)
        headings = np.full(count_headings(self.config.of_each("dynamics", n)), np.pi)
        failed = np.full(n if self.config.failures else 0, arena)
        return np.concatenate([positions, speeds, headings, failed, [code]]).astype(self.dtype)

    # -- the cycle: reset, step --------------------------------------------------------------------

    def reset(self, seed: int | None = None, episode: int = 0) -> Floats:
        """Begin a new episode in every world.

        Args:
            seed: key of the random numbers; the episode count restarts at ``episode``. ``None``
                keeps the seed and begins the next episode.
            episode: the number of the new episodes, from 0 on; another than 0 only with a seed.

        Returns:
            Observations, (W, n, obs_size) float32; :attr:`observation_table` has their units.

        Raises:
            ConfigError: seed or episode are not allowed.
        """
        if problems := validation.reset_problems(seed, episode):
            raise ConfigError("reset", problems)
        if seed is not None:
            self._backend.reseed(seed, episode)
        self._backend.reset(None)
        self._tell_reset(None)
        return self._backend.output.observations

    def reset_worlds(self, mask: ArrayLike) -> Floats:
        """Begin a new episode in the worlds where ``mask`` (W,) bool is set.

        Returns:
            The observations of all worlds, (W, n, obs_size) float32.

        Raises:
            ActionError: the mask has another shape or type.
        """
        self._backend.reset(mask)
        self._tell_reset(mask)
        return self._backend.output.observations

    def step(
        self, actions: ArrayLike, active: ArrayLike | None = None
    ) -> tuple[Floats, Array, Flags, Flags]:
        """Move every world by one step.

        Args:
            actions: (W, n, 2), finite; values outside [-1, 1] are clipped.
            active: (W,) bool, or ``None`` for all; only with autoreset disabled. Worlds that have
                ended may be left out: they stay as they are, with reward 0 and no flag set.

        Returns:
            The four ``(observations, rewards, terminated, truncated)``, (W, n, obs_size) float32,
            (W, n) real, and two (W,) bool. A time limit is a truncation, never a termination.

        Raises:
            ActionError: wrong shape, not numeric, or not finite. No world has moved.
            StepError: before the first reset, or, with autoreset disabled, after the end of a
                world.
        """
        self._backend.step(actions, active)
        out = self._backend.output
        for listener in self.listeners:
            listener.stepped(actions, out.terminated | out.truncated)
        return out.observations, out.rewards, out.terminated, out.truncated

    # -- what happened -----------------------------------------------------------------------------

    @property
    def team_rewards(self) -> Array:
        """The centralised reward of the last step, (W,) real: computed as the team's value."""
        return self._backend.output.team_rewards

    @property
    def final_observations(self) -> Floats:
        """Last observations of the episodes that ended (autoreset same-step), (W, n, obs_size).

        Rows of worlds whose episode continues hold nothing of use.
        """
        return self._backend.output.final_observations

    def infos(self) -> NDArray[np.float64]:
        """Measures of each agent as of the last step, before any automatic reset.

        Returns:
            A fresh array (W, n, columns), whose last axis is ordered as ``INFO_COLUMNS``. These
            are ``success``, ``rois_visited`` and ``collision`` of the team; the agent's own
            ``wall_hits``, ``path_length`` (units) and ``impulse`` (``|sum over steps of u tau|``,
            mass x units/step) of this episode, and whether it has ``failed``; and the terms of its
            own reward in the last step.
        """
        return self._backend.infos()

    def reward_terms(self) -> Array:
        """The named terms of each agent's own reward in the last step, (W, n, terms) real.

        The last axis is ordered as ``REWARD_TERMS`` and sums to the individual reward.
        """
        xp = self._backend.xp
        terms = self.infos()[..., -len(REWARD_TERMS) :]
        rows: Array = xp.asarray(terms, dtype=getattr(xp, self.config.dtype))
        return rows

    def state(self) -> Array:
        """The paper's state of every world now, (W, 4n + 1) real, raw units, a fresh array.

        All positions ``x1, y1, x2, y2, ...``, then all velocities, then the visit code, whose most
        significant bit is the first ROI. If a robot of the team has a heading, all headings come
        before the visit code, in radians, 0 for robots without one: (W, 5n + 1). If robots may
        fail, n flags of those that have come right before the visit code.
        """
        return self._backend.states(final=False)

    def final_state(self) -> Array:
        """:meth:`state` at the end of the last finished episodes, (W, size) real, raw units.

        With autoreset same-step only.
        """
        return self._backend.states(final=True)

    def metrics(self, names: Collection[str] = METRICS) -> dict[str, Array]:
        """Measures of each episode as of the last step, before any automatic reset.

        Args:
            names: those to return, of ``METRICS``. ``success``, ``collision``, ``steps``,
                ``episode_return`` and ``return_`` cost next to nothing.

        Returns:
            ``success``, ``collision`` (W,) bool; ``steps`` (W,) int32; ``episode_return`` (W,)
            float64: the team's; ``rois_visited`` (W,) int32; ``wall_hits`` (W, n) int32;
            ``path_length`` (W, n) real, units; ``impulse`` (W, n) real: ``|sum over steps of u
            tau|``, mass x units/step; ``failed`` (W, n) bool; ``return_`` (W, n) float64: what
            each agent was given.
        """
        backend, outcomes = self._backend, self._backend.output.outcomes
        now, final, xp = backend.now, backend.final, backend.xp
        collision = (outcomes & COLLISION) > 0
        ended = backend.output.terminated | backend.output.truncated
        ended &= self.autoreset == "same_step"
        measures: dict[str, Callable[[], Array]] = {
            "success": lambda: ((outcomes & SUCCESS) > 0) & ~collision,
            "collision": lambda: collision,
            "steps": lambda: xp.where(ended, final.steps, now.steps),
            "episode_return": lambda: xp.where(ended, final.team_return, now.team_return),
            "failed": lambda: (
                xp.where(ended, final.failed, now.failed).T
                if self.config.failures
                else xp.zeros_like(now.returns.T, dtype=xp.bool)
            ),
            "return_": lambda: xp.where(ended, final.returns, now.returns).T,
        }
        if not set(names) <= set(measures):
            infos = self.infos()
            columns = {name: infos[..., k] for k, name in enumerate(MEASURES)}
            measures |= {
                "rois_visited": lambda: xp.asarray(columns["rois_visited"][:, 0], dtype=xp.int32),
                "wall_hits": lambda: xp.asarray(columns["wall_hits"], dtype=xp.int32),
                "path_length": lambda: columns["path_length"],
                "impulse": lambda: columns["impulse"],
            }
        return {name: measures[name]() for name in names}

    def drawn(self) -> dict[str, Array]:
        """Return the drawn numbers of the present episodes by name, (W,) in the settings' units."""
        return self._backend.drawn(final=False)

    def final_drawn(self) -> dict[str, Array]:
        """Return :meth:`drawn` of the last finished episodes, (W,); autoreset same-step only."""
        return self._backend.drawn(final=True)

    def config_in(self, world: int = 0) -> NavigationConfig:
        """Return the configuration with the drawn numbers of the present episode of ``world``."""
        return self._backend.config_in(world)

    def sample_actions(self) -> Floats:
        """Uniform random actions, (W, n, 2) float32 in [-1, 1): the seed's next ones."""
        return self._backend.draw_actions()

    def save_state(self) -> dict[str, NDArray[Any]]:
        """Copies of everything that changes, by name: NumPy arrays, to be kept in a file.

        Each has the shape and the units that the engine works with, such as (n, W) for ``now.x``.
        """
        self._backend.raise_fault()
        return save_worlds(self._backend)

    def load_state(self, saved: Mapping[str, NDArray[Any]]) -> None:
        """Go on exactly where the engine that ``saved`` came from would.

        Args:
            saved: what :meth:`save_state` gave: arrays of its shapes, such as (n, W), and units.

        Raises:
            MbnError: it was an engine of other settings or sizes; this one is left as it was.
        """
        restore_worlds(self._backend, saved)
        self._tell_reset(None)

    def _tell_reset(self, mask: ArrayLike | None) -> None:
        for listener in self.listeners:
            listener.was_reset(mask)

    @property
    def seed(self) -> int:
        """The key of the random numbers."""
        return int(self._backend.memory.seed[0])

    @property
    def episode_numbers(self) -> NDArray[np.int64]:
        """The number of each world's episode since the seed was set, (W,), >= 0, a fresh array.

        It is -1 before the first reset.
        """
        return self._backend.host(self._backend.memory.episode)

    @property
    def failed(self) -> Flags:
        """Which robots have failed in the present episode of each world, (W, n) bool."""
        return self._backend.failures()

    @property
    def running(self) -> Flags:
        """Which worlds are in an episode, (W,) bool, a fresh NumPy array.

        A world is not before its first reset, nor after its end until it is reset, by itself or
        by :meth:`reset_worlds`.
        """
        return ~self._backend.host(self._backend.memory.pending)

    def snapshot(self, world: int = 0) -> Snapshot:
        """A copy of everything that a picture of the world with index ``world`` needs.

        Raises:
            IndexError: no such world.
        """
        if not 0 <= world < self.num_worlds:
            raise IndexError(f"world {world}; allowed: 0 to {self.num_worlds - 1}")
        return self._backend.snapshot(self.fields[world % len(self.fields)], world)


def _is_several(field: FieldLike | Sequence[FieldLike]) -> TypeGuard[Sequence[FieldLike]]:
    return isinstance(field, Sequence) and not isinstance(field, str)
