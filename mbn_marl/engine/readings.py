"""``Readings``: what can be read of the worlds of an engine."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.engine.backend import Backend
from mbn_marl.engine.mdp.dynamics import count_headings
from mbn_marl.engine.mdp.observations import Entry
from mbn_marl.engine.mdp.rewards import REWARD_TERMS
from mbn_marl.engine.snapshot import Snapshot
from mbn_marl.engine.state import Array
from mbn_marl.errors import ConfigError, unknown
from mbn_marl.field import Field, FieldSampler

Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

METRICS = (
    *("success", "collision", "rois_visited", "steps", "episode_return"),
    *("wall_hits", "path_length", "impulse", "failed", "return_"),
)
"""The names of the measures of an episode, in the order of ``BatchEngine.metrics``."""


class Readings:
    """The part of a :class:`~mbn_marl.BatchEngine` that is read: itself and its worlds.

    W is the number of worlds, n the number of robots.

    Attributes:
        config: the configuration, with n.
        fields: those of the worlds in turn; none with a sampler.
        sampler: what draws a field for each episode, or ``None``.
        num_worlds: W.
        n_robots: n, the most robots in a world.
        n_rois: m, the most ROIs in a world.
        teams_vary: whether a world may have fewer than n robots.
        arena: width and height, units.
        observation_table: the entries of a robot's observation.
        obs_size: how many there are.
        autoreset: the mode's name.
        first_world: the number of the world with index 0.
        dtype: the precision of rewards and states.
    """

    config: NavigationConfig
    fields: tuple[Field, ...]
    sampler: FieldSampler | None
    num_worlds: int
    n_robots: int
    n_rois: int
    teams_vary: bool
    arena: tuple[float, float]
    observation_table: tuple[Entry, ...]
    obs_size: int
    autoreset: str
    first_world: int
    dtype: np.dtype[Any]
    _backend: Backend
    _set_fields: dict[int, tuple[int, Field]]

    def __repr__(self) -> str:
        names = [*dict.fromkeys(field.name for field in self.fields)] or ["random fields"]
        where = ", ".join(names) if len(names) <= 3 else f"{len(names)} fields"
        most = "up to " if self.teams_vary else ""
        return (
            f"<{type(self).__name__} {where}: {most}{self.n_robots} robots, {self.n_rois} ROIs, "
            f"observation {self.config.observation!r} ({self.obs_size}), worlds {self.num_worlds}>"
        )

    @property
    def field(self) -> Field:
        """The field of world 0."""
        return self.field_of(0)

    def field_of(self, world: int) -> Field:
        """Return the field of a world's present episode.

        One that a sampler has drawn is read from the engine's tables, to a thousandth of a unit;
        its name has the world's number and the episode's. Before the first reset, it is that of the
        first episode.

        Raises:
            IndexError: no such world.
        """
        self._check_world(world)
        number, given = self._set_fields.get(world, (-1, None))
        if self.sampler is None:
            return given or self.fields[world % len(self.fields)]
        episode = int(self._backend.memory.episode[world])
        if given and number == max(episode, 0):
            return given
        if episode < 0:
            return self.sampler.field(self.first_world + world)
        return self._backend.field_in(world)

    def _check_world(self, world: int) -> None:
        if not 0 <= world < self.num_worlds:
            raise IndexError(f"world {world}; allowed: 0 to {self.num_worlds - 1}")

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
        positions = np.tile(self.arena, n) * arena
        speeds = np.full(2 * n, self.config.top_speed)
        headings = np.full(count_headings(self.config.of_each("dynamics", n)), np.pi)
        flags = np.full(self._backend.now.status.shape[0], arena)
        return np.concatenate([positions, speeds, headings, flags, [code]]).astype(self.dtype)

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
            reward in the last step.
        """
        return self._backend.infos()[:, :-1]

    def team_infos(self) -> NDArray[np.float64]:
        """As :meth:`infos` of the team, (W, columns): sums over it, the terms of its reward."""
        return self._backend.infos()[:, -1]

    def reward_terms(self) -> Array:
        """The named terms of each agent's reward in the last step, (W, n, terms) real.

        The last axis is ordered as ``REWARD_TERMS`` and sums to the reward, up to rounding.
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
        fail, or teams vary, n flags of those that do not work come right before the visit code.
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
            names: those to return, of ``METRICS``; all but ``path_length`` and ``impulse`` cost
                next to nothing.

        Returns:
            ``success``, ``collision`` (W,) bool; ``steps`` (W,) int32; ``episode_return`` (W,)
            float64: the team's; ``rois_visited`` (W,) int32; ``wall_hits`` (W, n) int32;
            ``path_length`` (W, n) float64, units; ``impulse`` (W, n) float64: ``|sum over steps of
            u tau|``, mass x units/step; ``failed`` (W, n) bool; ``return_`` (W, n) float64: what
            each agent was given.

        Raises:
            ConfigError: a name is none of ``METRICS``, or one stands for several; all are listed.
        """
        wrong = [name for name in names if name not in METRICS]
        problems = [f"{name!r}: {unknown('measure', str(name), METRICS)}" for name in wrong]
        if isinstance(names, str):
            problems = [f"names: {names!r}; allowed: several of {', '.join(METRICS)}"]
        if problems:
            raise ConfigError("metrics", problems)
        return self._backend.metrics(names, self.autoreset == "same_step")

    def drawn(self) -> dict[str, Array]:
        """Return the drawn numbers of the present episodes by name, (W,) in the settings' units."""
        return self._backend.drawn(final=False)

    def final_drawn(self) -> dict[str, Array]:
        """Return :meth:`drawn` of the last finished episodes, (W,); autoreset same-step only."""
        return self._backend.drawn(final=True)

    def config_in(self, world: int = 0) -> NavigationConfig:
        """Return the configuration with the drawn numbers of the present episode of ``world``."""
        return self._backend.config_in(world)

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
    def may_rest(self) -> bool:
        """True if some robots may not work: those that fail, or are not in the team."""
        return self._backend.now.status.ndim == 2

    @property
    def working(self) -> Flags:
        """Which robots are in the team and have not failed, (W, n) bool."""
        return self._backend.working()

    @property
    def present(self) -> Flags:
        """Which robots are in the present team of each world, (W, n) bool.

        The first ones always are. Those that are not observe zeros, earn nothing, touch nothing
        and visit nothing; their actions have no effect.
        """
        return self._backend.present()

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
        return self._backend.snapshot(self.field_of(world), world)
