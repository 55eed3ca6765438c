"""``BatchEngine``: many worlds of the MDP, stepped together."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbn_marl.config import NavigationConfig, Settings, make_config
from mbn_marl.engine import validation
from mbn_marl.engine.backend import Backend, BackendSpec
from mbn_marl.engine.constants import make_record
from mbn_marl.engine.kernels import INFO_COLUMNS, MEASURES, write_heard
from mbn_marl.engine.mdp.disturbances import has_gusts
from mbn_marl.engine.mdp.drawn_numbers import WIND_X, WIND_Y, draws_numbers, rows_of_drawn
from mbn_marl.engine.mdp.dynamics import count_headings
from mbn_marl.engine.mdp.failures import ABSENT, FAILED, may_rest
from mbn_marl.engine.mdp.observations import observation_table
from mbn_marl.engine.mdp.rewards import COLLISION, RESTED, REWARD_TERMS, SUCCESS
from mbn_marl.engine.snapshot import Snapshot
from mbn_marl.engine.state import Array, Episode
from mbn_marl.engine.state_io import restore_worlds, save_worlds
from mbn_marl.engine.tables import column_of, make_geometry, read_field, sampler_numbers, sizes_of
from mbn_marl.engine.validation import Autoreset, Device
from mbn_marl.errors import (
    ActionError,
    ConfigError,
    FieldError,
    MbnError,
    collecting,
    install,
    unknown,
)
from mbn_marl.field import Field, FieldSampler, load_field
from mbn_marl.field.generator.layout import Tables

FieldLike = Field | str | os.PathLike[str]
# A field for all worlds, those of the worlds in turn, or what draws one for each episode.
Fields = FieldLike | Sequence[FieldLike] | FieldSampler
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

# The names of the measures of an episode, in the order of ``BatchEngine.metrics``.
METRICS = (
    *("success", "collision", "rois_visited", "steps", "episode_return"),
    *("wall_hits", "path_length", "impulse", "failed", "return_"),
)


class Listener(Protocol):
    """Receives every reset and step of an engine's worlds, after it has happened."""

    def was_reset(self, mask: Any) -> None:
        """The worlds of a mask (W,) bool, or all if it is ``None``, have another state."""

    def stepped(self, actions: Any, ended: Any) -> None:
        """The worlds moved by ``actions`` (W, n, 2), as given; in ``ended`` (W,) an episode ended.

        Worlds that waited for a reset did not move.
        """


class BatchEngine:
    """Many independent worlds of the multi-robot navigation MDP, stepped together.

    Every array that :meth:`reset` and :meth:`step` return is one of the engine's own buffers,
    overwritten by the next call: copy what you keep. W is the number of worlds, n the number of
    robots, m the number of ROIs; ``real`` is the engine's dtype. Arguments that are not allowed
    raise a :class:`~mbn_marl.errors.ConfigError` with all problems, an unknown world an IndexError.

    Args:
        field: a catalogue name, a file, a :class:`Field`, or a sequence of them with one arena:
            world w then has field ``w % len(field)``. Or a
            :class:`~mbn_marl.field.FieldSampler`, which draws a field for each episode. Numbers of
            ROIs may differ: a missing one is visited from the start. Without ``n_robots``, those of
            robots may too: n is then the largest, see :attr:`present`.
        num_worlds: W, at least 1.
        seed: key of all random numbers, 0 to 2^63 - 1.
        autoreset: what happens when an episode ends. ``True`` or ``"same_step"``: the world
            restarts within that step, and its last observation is in :attr:`final_observations`;
            ``"next_step"``: the next step restarts it, whatever its action, with reward 0;
            ``False`` or ``"disabled"``: it waits for :meth:`reset_worlds`.
        device: ``"cpu"``, or ``"cuda"``, torch's current CUDA device and stream: all arrays are
            then torch tensors there, actions and masks too. A CUDA graph can capture :meth:`step`,
            which never waits for the device, after a first step outside. See *Faults*.
        threads: how many threads share the worlds on the CPU; ``None`` takes one per core, but one
            for small batches. The result does not depend on it.
        starts: where the robots start in every world, (n, 2) units, instead of the field's own
            starts: in the field, no two closer than the least safety distance.
        first_world: number of the world with index 0, from 0 on. A world's random numbers depend
            on its number, the seed and its episode's number alone.
        **settings: see :class:`mbn_marl.config.NavigationConfig`.

    Attributes:
        config: the configuration, with n.
        fields: those of the worlds in turn; none with a sampler.
        sampler: what draws a field for each episode, or ``None``.
        n_robots: n, the most robots in a world.
        n_rois: m, the most ROIs in a world.
        teams_vary: whether a world may have fewer than n robots.
        has_kinds: whether a field has kinds of ROIs, and observations say which are the robot's.
        arena: width and height, units.
        observation_table: the entries of a robot's observation.
        obs_size: how many there are.
        autoreset: the mode's name.
        dtype: the precision of rewards and states.
        listeners: objects that every reset and step is reported to, such as a recorder of episodes.

    Faults:
        On the CPU, an action that is not finite and a step of a world that has ended are errors
        before any world moves. On CUDA that world rests in the step (reward 0, no flag set), the
        others move, and the next :meth:`reset`, :meth:`reset_worlds` or :meth:`snapshot` outside a
        graph's capture raises the error, once, for the first such world.

    Raises:
        FieldError: a field is invalid or unknown; problems of settings are listed too.
        ConfigError: a setting is invalid, or CUDA cannot be used; all problems are listed.
    """

    def __init__(
        self,
        field: Fields,
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
        config, keys = None, {"seed": seed, "first_world": first_world}
        problems = validation.argument_problems(num_worlds, threads, device, autoreset, keys)
        try:
            config = make_config(settings, self)
        except ConfigError as error:
            problems = [*error.problems, *problems]
        try:
            source = field if isinstance(field, FieldSampler) else _load_all(field)
        except FieldError as error:
            raise error.beside(problems) from None
        if config is None:
            raise ConfigError("configuration", problems)
        sizes, given = sizes_of(source), validation.as_starts(starts)
        n = config.n_robots or sizes.robots
        self._sizes = sizes._replace(robots=n)
        problems += validation.setup_problems(source, config, n, num_worlds, given)
        if problems:
            raise ConfigError("configuration", problems)
        self.autoreset = validation.autoreset_mode(autoreset)
        self.config = config = config.model_copy(update={"n_robots": n})
        self.fields = () if isinstance(source, FieldSampler) else source
        self.sampler = source if isinstance(source, FieldSampler) else None
        own_teams = self.sampler is not None or (settings.get("n_robots") is None and given is None)
        self.teams_vary = vary = own_teams and sizes.fewest_robots < n
        self.num_worlds, self.n_robots, self.device = num_worlds, n, device
        self.first_world, self.n_rois, self.arena = first_world, sizes.rois, sizes.arena
        self.dtype = np.dtype(config.dtype)
        self.has_kinds = sizes.kinds
        table = observation_table(config, n, self.n_rois, self.arena, vary, sizes.kinds)
        self.observation_table, self.obs_size = table, len(table)
        self.observation_low = np.array([entry.low for entry in table], np.float32)
        self.observation_high = np.array([entry.high for entry in table], np.float32)
        self.listeners: list[Listener] = []
        self._set_fields: dict[int, tuple[int, Field]] = {}
        self._drawn_rows = rows_of_drawn(config, n)
        numbers = config, n, self.arena, self.autoreset, first_world, vary
        try:
            spec = BackendSpec(
                config=config,
                num_worlds=num_worlds,
                obs_size=self.obs_size,
                autoreset=self.autoreset,
                threads=threads,
                seed=seed,
                geometry=make_geometry(source, config, n, num_worlds, vary, given),
                constants=make_record(*numbers),
                arena=self.arena,
                teams_vary=vary,
            )
            self._backend = _class_of(device)(spec)
        except MemoryError as error:
            problem = f"num_worlds: {num_worlds} with {config.max_steps} steps need more memory"
            fewer = "allowed: fewer worlds, or a smaller max_steps"
            raise ConfigError("configuration", [f"{problem} ({error}); {fewer}"]) from None

    def __repr__(self) -> str:
        names = [*dict.fromkeys(field.name for field in self.fields)] or ["random fields"]
        where = ", ".join(names) if len(names) <= 3 else f"{len(names)} fields"
        most = "up to " if self.teams_vary else ""
        return (
            f"<{type(self).__name__} {where}: {most}{self.n_robots} robots, {self.n_rois} ROIs, "
            f"observation {self.config.observation!r} ({self.obs_size}), worlds {self.num_worlds}>"
        )

    # -- the cycle: reset, step --------------------------------------------------------------------

    def reset(self, seed: int | None = None, episode: int = 0) -> Floats:
        """Begin a new episode in every world.

        Args:
            seed: key of the random numbers; the episode count restarts at ``episode``. ``None``
                keeps the seed and begins the next episode.
            episode: the number of the new episodes, from 0 on; another than 0 only with a seed.

        Returns:
            Observations, (W, n, obs_size) float32; :attr:`observation_table` has their units.
        """
        if problems := validation.reset_problems(seed, episode):
            raise ConfigError("reset", problems)
        if seed is not None:
            if self._set_fields:
                now = self.episode_numbers
                self._set_fields = {
                    world: (episode if number == now[world] + 1 else -1, field)
                    for world, (number, field) in self._set_fields.items()
                }
            memory = self._backend.memory
            memory.seed[:], memory.draw[:], memory.episode[:] = seed, 0, episode - 1
        self._backend.reset(None)
        self._tell_reset(None)
        return self._backend.output.observations

    def reset_worlds(self, mask: ArrayLike) -> Floats:
        """Begin a new episode where ``mask`` (W,) bool is set; return all worlds' observations."""
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
            ActionError: an argument is not allowed. No world has moved.
            StepError: before the first reset, or after the end of a world that waits for one.
        """
        if active is not None and self.autoreset != "disabled":
            allowed = "allowed: None, or worlds that wait with autoreset disabled"
            raise ActionError(f"active: given with autoreset {self.autoreset!r}; {allowed}")
        self._backend.step(actions, active)
        out = self._backend.output
        for listener in self.listeners:
            listener.stepped(actions, out.terminated | out.truncated)
        return out.observations, out.rewards, out.terminated, out.truncated

    def sample_actions(self) -> Floats:
        """Uniform random actions, (W, n, 2) float32 in [-1, 1): the seed's next ones."""
        backend = self._backend
        rows: Floats = backend.empty((self.num_worlds, self.n_robots, 2), backend.xp.float32)
        backend.write_draw(rows)
        drawn = backend.memory.draw
        drawn += 1
        return rows

    # -- fields ------------------------------------------------------------------------------------

    @property
    def field(self) -> Field:
        """The field of world 0."""
        return self.field_of(0)

    def field_of(self, world: int) -> Field:
        """Return the field of a world's present episode.

        One that a sampler has drawn is read from the engine's tables, to a thousandth of a unit;
        its name has the world's number and the episode's. Before the first reset, it is that of the
        first episode.
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
        f, backend = self._column(world), self._backend
        tables = Tables(*(backend.host(table[..., f : f + 1]) for table in backend.geometry.field))
        return read_field(tables, self.arena, f"world-{self.first_world + world}-{episode}")

    def _check_world(self, world: int) -> None:
        if not 0 <= world < self.num_worlds:
            raise IndexError(f"world {world}; allowed: 0 to {self.num_worlds - 1}")

    def _column(self, world: int) -> int:
        return world if self._backend.geometry.field.codes.shape[0] > 1 else 0

    def set_field(self, field: FieldLike, world: int = 0, starts: ArrayLike | None = None) -> None:
        """Give a world another field, right before its reset.

        With a sampler, the episodes after the next one have fields that are drawn again. A CUDA
        graph has to be captured again.

        Args:
            field: a catalogue name, a file or a field, of the same arena, with at most ``n_rois``
                ROIs and a start for each robot.
            world: its index.
            starts: where the robots start, (n, 2) units, instead of the field's own starts.
        """
        self._check_world(world)
        field, given, vary = load_field(field), validation.as_starts(starts), self.teams_vary
        problems = validation.set_field_problems(field, self._sizes, self.config, vary, given)
        if self.num_worlds > 1 and len(self.fields) == 1:
            problems.append("field: one for all worlds; allowed: with a field for each, or 1 world")
        if problems:
            raise ConfigError("set_field", problems)
        f, backend = self._column(world), self._backend
        tables, paths = column_of(field, backend.geometry, self.config, vary, given)
        backend.make_room(tables.edges.shape[1], paths.waypoints.shape[1])
        here = *backend.geometry.field, *backend.geometry.paths
        for table, part in zip(here, (*tables, *paths), strict=True):
            place = tuple(map(slice, part.shape[:-1]))
            table[..., f][place] = backend.xp.asarray(part[..., 0])
        if self.sampler is not None:
            backend.geometry.sampler.kept[f] = True
        self._set_fields[world] = int(self.episode_numbers[world]) + 1, field

    def set_sampler(self, sampler: FieldSampler) -> None:
        """Draw fields by other numbers from the next resets on, at most as large as at first."""
        limits = self._sizes, self.config, self.teams_vary
        if self.sampler is None:
            problems = ["sampler: allowed in place of another one"]
        elif not isinstance(sampler, FieldSampler):
            problems = [f"sampler: {type(sampler).__name__}; allowed: a FieldSampler"]
        else:
            problems = validation.set_sampler_problems(sampler, *limits)
        if problems:
            raise ConfigError("set_sampler", problems)
        self.sampler, backend = sampler, self._backend
        backend.geometry.sampler.numbers[:] = backend.xp.asarray(sampler_numbers(sampler))

    # -- what the last step gave -------------------------------------------------------------------

    @property
    def team_rewards(self) -> Array:
        """The centralised reward of the last step, (W,) real: computed as the team's value."""
        return self._backend.output.team_rewards

    @property
    def final_observations(self) -> Floats:
        """Last observations of the episodes that ended (autoreset same-step), (W, n, obs_size).

        Rows of worlds whose episode continues hold nothing of use.
        """
        self._check_same_step("final_observations")
        return self._backend.output.final_observations

    def _infos(self) -> NDArray[np.float64]:
        rows: NDArray[np.float64] = self._backend.empty(
            (self.num_worlds, self.n_robots + 1, len(INFO_COLUMNS)), self._backend.xp.float64
        )
        self._backend.write_infos(rows)
        return rows

    def infos(self) -> NDArray[np.float64]:
        """Measures of each agent as of the last step, before any automatic reset.

        Returns:
            A fresh array (W, n, columns), whose last axis is ordered as ``INFO_COLUMNS``. These
            are ``success``, ``rois_visited`` and ``collision`` of the team; the agent's own
            ``wall_hits``, ``path_length`` (units) and ``impulse`` (``|sum over steps of u tau|``,
            mass x units/step) of this episode, and whether it has ``failed``; and the terms of its
            reward in the last step.
        """
        return self._infos()[:, :-1]

    def team_infos(self) -> NDArray[np.float64]:
        """As :meth:`infos` of the team, (W, columns): sums over it, the terms of its reward."""
        return self._infos()[:, -1]

    def reward_terms(self) -> Array:
        """The named terms of each agent's reward in the last step, (W, n, terms) real.

        The last axis is ordered as ``REWARD_TERMS`` and sums to the reward, up to rounding.
        """
        terms = self.infos()[..., -len(REWARD_TERMS) :]
        rows: Array = self._backend.xp.asarray(terms, dtype=self._backend.real)
        return rows

    def metrics(self, names: Collection[str] = METRICS) -> dict[str, Array]:
        """Measures of each episode as of the last step, before any automatic reset.

        Args:
            names: those to return, of ``METRICS``; all but ``impulse`` cost next to nothing.

        Returns:
            ``success``, ``collision`` (W,) bool; ``steps`` (W,) int32; ``episode_return`` (W,)
            float64: the team's; ``rois_visited`` (W,) int32; ``wall_hits`` (W, n) int32;
            ``path_length`` (W, n) float64, units; ``impulse`` (W, n) float64: ``|sum over steps of
            u tau|``, mass x units/step; ``failed`` (W, n) bool; ``return_`` (W, n) float64: what
            each agent was given.
        """
        wrong = [name for name in names if name not in METRICS]
        problems = [f"{name!r}: {unknown('measure', str(name), METRICS)}" for name in wrong]
        if isinstance(names, str):
            problems = [f"names: {names!r}; allowed: several of {', '.join(METRICS)}"]
        if problems:
            raise ConfigError("metrics", problems)
        backend = self._backend
        now, final, output, xp = backend.now, backend.final, backend.output, backend.xp
        outcomes = output.outcomes
        collision = (outcomes & COLLISION) > 0
        ended = (output.terminated | output.truncated) & (self.autoreset == "same_step")

        def last(name: str) -> Array:
            part: Array = xp.where(ended, getattr(final, name), getattr(now, name))
            return part  # of the episode that the last step was of, ([n,] W)

        def count_visited() -> Array:
            codes = last("visited") & last("codes")
            count: Array = sum((codes >> k & 1 for k in range(self.n_rois)), xp.zeros_like(codes))
            return count

        measures: dict[str, Callable[[], Array]] = {
            "success": lambda: ((outcomes & SUCCESS) > 0) & ~collision,
            "collision": lambda: collision,
            "steps": lambda: last("steps"),
            "episode_return": lambda: last("team_return"),
            "rois_visited": count_visited,
            "wall_hits": lambda: last("wall_hits").T,
            "failed": lambda: last("status").T == FAILED if may_rest(now) else self.failed,
            "return_": lambda: last("returns").T,
            "path_length": lambda: xp.asarray(last("path_length").T, dtype=xp.float64),
            "impulse": lambda: self.infos()[..., MEASURES.index("impulse")],
        }
        return {name: measures[name]() for name in names}

    # -- the state ---------------------------------------------------------------------------------

    def state(self) -> Array:
        """The paper's state of every world now, (W, 4n + 1) real, raw units, a fresh array.

        All positions ``x1, y1, x2, y2, ...``, then all velocities, then the visit code, whose most
        significant bit is the first ROI. If a robot of the team has a heading, all headings come
        before the visit code, in radians, 0 for robots without one: (W, 5n + 1). If robots may
        fail, or teams vary, n flags of those that do not work come right before the visit code.
        """
        return self._states(final=False)

    def final_state(self) -> Array:
        """:meth:`state` at the end of the last finished episodes, (W, size) real, raw units.

        With autoreset same-step only.
        """
        self._check_same_step("final_state")
        return self._states(final=True)

    def _check_same_step(self, name: str) -> None:
        if self.autoreset != "same_step":
            problem = f"autoreset: {self.autoreset!r}; allowed: 'same_step'"
            raise ConfigError(name, [f"{problem}, elsewhere a world keeps its last state"])

    def _states(self, *, final: bool) -> Array:
        now = self._backend.now
        size = 4 * self.n_robots + now.heading.shape[0] + now.status.shape[0] + 1
        rows: Array = self._backend.empty((self.num_worlds, size), self._backend.real)
        self._backend.write_states(final, rows)
        return rows

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

    def drawn(self) -> dict[str, Array]:
        """Return the drawn numbers of the present episodes by name, (W,) in the settings' units."""
        return self._drawn_in(self._backend.now)

    def final_drawn(self) -> dict[str, Array]:
        """Return :meth:`drawn` of the last finished episodes, (W,); autoreset same-step only."""
        self._check_same_step("final_drawn")
        return self._drawn_in(self._backend.final)

    def _drawn_in(self, episode: Episode) -> dict[str, Array]:
        copied = self._backend.xp.concatenate
        return {name: copied([episode.drawn[row]]) for name, row in self._drawn_rows.items()}

    def config_in(self, world: int = 0) -> NavigationConfig:
        """Return the configuration with the drawn numbers of the present episode of ``world``."""
        self._check_world(world)
        own = {name: float(numbers[world]) for name, numbers in self.drawn().items()}
        return self.config.with_drawn(own)

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
    def running(self) -> Flags:
        """Flags of the worlds that are in an episode, (W,) bool, a fresh NumPy array.

        A world is in none before its first reset, nor between its end and its next reset.
        """
        return ~self._backend.host(self._backend.memory.pending)

    @property
    def may_rest(self) -> bool:
        """True if some robots may not work: those that fail, or are not in the team."""
        return may_rest(self._backend.now)

    @property
    def failed(self) -> Flags:
        """Flags of the robots that have failed in each world's present episode, (W, n) bool."""
        return self._have_status(FAILED)

    @property
    def working(self) -> Flags:
        """Flags of the robots that are in the team and have not failed, (W, n) bool."""
        return ~(self._have_status(FAILED) | self._have_status(ABSENT))

    @property
    def present(self) -> Flags:
        """Flags of the robots in the present team of each world, (W, n) bool.

        The first ones always are. Those that are not observe zeros, earn nothing, touch nothing
        and visit nothing; their actions have no effect.
        """
        return ~self._have_status(ABSENT)

    @property
    def decoys(self) -> Flags:
        """Flags of the empty ROIs of each world's present episode, (W, m) bool."""
        field, codes = self._backend.geometry.field, self._backend.host(self._backend.now.codes)
        bits, every = self._backend.host(field.roi_bits), self._backend.host(field.codes)
        empty: Flags = (bits.T & np.where(codes == 0, 0, every & ~codes)[:, None]) != 0
        return empty  # none before the first reset, when there are no codes

    def knowledge(self) -> tuple[Flags, Flags, Flags]:
        """Return what robots with ``knowledge="own"`` know in the first world, on the CPU.

        ``done`` and ``found``, (n, m) bool, are the ROIs that each robot knows to be done, and has
        found. ``heard``, (n, n) bool, is whether robot i received words of robot k in this step.

        Raises:
            ConfigError: ``knowledge`` is not ``"own"``.
        """
        if self.config.knowledge != "own":
            problem = f"knowledge: {self.config.knowledge!r}; allowed: 'own' for this"
            raise ConfigError("configuration", [problem])
        now, n = self._backend.now, self.n_robots
        heard = np.empty((n, n), np.bool_)
        write_heard(self._backend.arguments, heard)
        heard &= now.steps[0] >= self.config.comm_delay
        bits = self._backend.geometry.field.roi_bits[:, 0]
        known = (now.knows[: 2 * n, :1] & bits) != 0
        found = known[n:] if self.config.hidden_rois else np.ones_like(known[:n])
        return known[:n], found, heard

    def _have_status(self, status: int) -> Flags:
        found: Flags = self._backend.empty((self.num_worlds, self.n_robots), self._backend.xp.bool)
        found[...] = status == self._backend.now.status.T if self.may_rest else False
        return found

    def snapshot(self, world: int = 0) -> Snapshot:
        """A copy of everything that a picture of the world with index ``world`` needs."""
        field, backend, f = self.field_of(world), self._backend, self._column(world)
        backend.raise_fault()
        now, config, host = backend.now, self.config_in(world), backend.host
        n, steps, visited = self.n_robots, int(now.steps[world]), int(now.visited[world])
        outcome = int(backend.output.outcomes[world]) if steps else 0
        left_out = outcome & RESTED and bool(backend.memory.pending[world])
        bits = host(backend.geometry.field.roi_bits[: len(field.rois), f])
        empty = self.decoys[world, : len(bits)]
        team = int(backend.geometry.field.robots_in[f])
        failed = np.zeros(n, np.bool_)
        if self.may_rest:
            failed = host(now.status[:, world]) == FAILED
        headings = np.full(n, np.nan, self.dtype)
        if now.heading.shape[0]:
            heading, cos, sin = (host(p[:, world]) for p in (now.heading, now.cos, now.sin))
            headings = np.where((cos != 0) | (sin != 0), heading, headings)
        trail = host(backend.memory.trail[world, : (steps + 1) * n]).reshape(-1, n, 2)
        vanish = config.failures is not None and config.failures.kind == "vanish"
        made = Snapshot(
            field=field,
            positions=np.stack([host(now.x[:team, world]), host(now.y[:team, world])], axis=-1),
            velocities=np.stack([host(now.vx[:team, world]), host(now.vy[:team, world])], axis=-1),
            visited=((visited & bits) != 0) & ~empty,
            empty=empty,
            headings=headings[:team],
            failed=failed[:team],
            gone=failed[:team] & vanish,
            trail=trail[:, :team],
            step=steps,
            team_return=float(now.team_return[world]),
            winds=np.array([self._wind(world)]),
            roi_radius=config.roi_radius,
            safety_distance=config.safety_distance,
            success=outcome & (SUCCESS | COLLISION) == SUCCESS,
            collision=bool(outcome & COLLISION),
        )
        return made.judged() if left_out else made

    def _wind(self, world: int) -> tuple[float, float]:
        """The velocity that wind and gust add in the next step of a world, units/step."""
        now, host = self._backend.now, self._backend.host
        if draws_numbers(now):
            x, y = host(now.drawn[WIND_X : WIND_Y + 1, world]).tolist()
        else:
            x, y = self.config.wind_increment()
        if has_gusts(now):
            gust_x, gust_y = host(now.gust[:, world]).tolist()
            return x + gust_x, y + gust_y
        return x, y

    # -- saved states ------------------------------------------------------------------------------

    def save_state(self) -> dict[str, NDArray[Any]]:
        """Copies of everything that changes, by name: NumPy arrays, to be kept in a file.

        Each has the shape and the units that the engine works with, such as (n, W) for ``now.x``.
        The fields that a sampler has drawn are among them, those of :meth:`set_field` in an engine
        without one are not.
        """
        self._backend.raise_fault()
        return save_worlds(self._backend)

    def load_state(self, saved: Mapping[str, NDArray[Any]]) -> None:
        """Restore a saved state: the worlds then continue as those of the saved engine.

        Settings and fields have to be the same; only sizes, types and samplers are compared.
        Arrays have the shapes and units that :meth:`save_state` gave.

        Raises:
            ProblemsError: naming every array with another shape or type, or values out of range.
            MbnError: it was an engine with another sampler. In both cases nothing has changed.
        """
        if not isinstance(saved, Mapping):
            found = type(saved).__name__
            raise MbnError(f"worlds: {found}; allowed: arrays by name, as of save_state()")
        theirs = saved.get("geometry.numbers")
        own = None if self.sampler is None else sampler_numbers(self.sampler)
        if not (own is None or theirs is None or np.array_equal(own, theirs)):
            raise MbnError("worlds: of another sampler; allowed: those of this one")
        restore_worlds(self._backend, saved)
        if self.sampler is not None:
            self._set_fields.clear()
        self._tell_reset(None)

    def _tell_reset(self, mask: ArrayLike | None) -> None:
        for listener in self.listeners:
            listener.was_reset(mask)


def _class_of(device: Device) -> type[Backend]:
    """Return what makes the worlds on a device: only CUDA needs torch, and so loads it."""
    if device == "cpu":
        return Backend
    try:
        from mbn_marl.engine.cuda import CudaBackend
    except ImportError as error:
        needs = f"device: 'cuda' needs torch and numba-cuda: {install('cuda')}"
        raise ConfigError("configuration", [f"{needs}; {error}"]) from None
    return CudaBackend


def _load_all(field: FieldLike | Sequence[FieldLike]) -> tuple[Field, ...]:
    if not isinstance(field, Sequence) or isinstance(field, str):
        return (load_field(field),)
    loaded, problems = [], list[str]()
    for one in field:
        with collecting(problems):
            loaded.append(load_field(one))
    if problems:
        raise FieldError("fields", problems)
    return tuple(loaded)
