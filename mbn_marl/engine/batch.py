"""``BatchEngine``: many worlds of the MDP, stepped together."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbn_marl.config import Settings, make_config
from mbn_marl.engine import validation
from mbn_marl.engine.backend import Backend, BackendSpec
from mbn_marl.engine.constants import make_record
from mbn_marl.engine.devices import make_backend
from mbn_marl.engine.geometry import FieldSource, make_geometry, sampler_numbers, sizes_of
from mbn_marl.engine.listener import Listener
from mbn_marl.engine.mdp.observations import observation_table
from mbn_marl.engine.readings import Flags, Floats, Readings
from mbn_marl.engine.state import Array
from mbn_marl.engine.state_io import restore_worlds, save_worlds
from mbn_marl.engine.validation import Autoreset, Device
from mbn_marl.errors import ActionError, ConfigError, MbnError
from mbn_marl.field import Field, FieldSampler, load_field

FieldLike = Field | str | os.PathLike[str]
Fields = FieldLike | Sequence[FieldLike] | FieldSampler
"""A field for all worlds, those of the worlds in turn, or what draws one for each episode."""


class BatchEngine(Readings):
    """Many independent worlds of the multi-robot navigation MDP, stepped together.

    Every array that :meth:`reset` and :meth:`step` return is one of the engine's own buffers,
    overwritten by the next call: copy what you keep. W is the number of worlds, n the number of
    robots, m the number of ROIs; ``real`` is the engine's dtype. What can be read of the worlds is
    in the base class, ``Readings``.

    Args:
        field: a catalogue name, a file, a :class:`Field`, or a sequence of them: world w then has
            field ``w % len(field)``. All need the same arena. Or a
            :class:`~mbn_marl.field.FieldSampler`: every episode of every world then has a field of
            its own, made inside its reset, which depends on the sampler's seed, the world's number
            and the episode's alone. The numbers of ROIs may differ (a missing ROI is one that is
            visited from the start), and without ``n_robots`` those of robots: n is then the
            largest, see :attr:`present`.
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
            starts: in the field, and no two closer than the safety distance, or the least one
            that episodes draw.
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
        source = field if isinstance(field, FieldSampler) else _load_all(field)
        sizes, config = sizes_of(source), make_config(settings)
        n = config.n_robots or sizes.robots
        self._sizes = sizes._replace(robots=n)
        self.autoreset = validation.autoreset_mode(autoreset)
        given = validation.as_starts(starts)
        validation.check_setup(
            source, config, n, num_worlds, threads, seed, device, given, first_world
        )
        self.config = config.model_copy(update={"n_robots": n})
        self.fields = () if isinstance(source, FieldSampler) else source
        self.sampler = source if isinstance(source, FieldSampler) else None
        own_teams = self.sampler is not None or (config.n_robots is None and given is None)
        self.teams_vary = own_teams and sizes.fewest_robots < n
        self.num_worlds, self.n_robots, self.device = num_worlds, n, device
        self.first_world, self.n_rois, self.arena = first_world, sizes.rois, sizes.arena
        self.dtype = np.dtype(config.dtype)
        table = observation_table(self.config, n, self.n_rois, self.arena, self.teams_vary)
        self.observation_table, self.obs_size = table, len(table)
        self.observation_low = np.array([entry.low for entry in table], np.float32)
        self.observation_high = np.array([entry.high for entry in table], np.float32)
        self.listeners: list[Listener] = []
        self._set_fields: dict[int, tuple[int, Field]] = {}
        try:
            self._backend = self._make_worlds(source, threads, seed, given)
        except MemoryError as error:
            problem = f"num_worlds: {num_worlds} with {config.max_steps} steps need more memory"
            fewer = "allowed: fewer worlds, or a smaller max_steps"
            raise ConfigError("configuration", [f"{problem} ({error}); {fewer}"]) from None

    def _make_worlds(
        self,
        source: FieldSource,
        threads: int | None,
        seed: int,
        starts: NDArray[Any] | None,
    ) -> Backend:
        """Make the worlds' arrays on the device."""
        config, n, worlds = self.config, self.n_robots, self.num_worlds
        numbers = config, n, self.arena, self.autoreset, self.first_world, self.teams_vary
        return make_backend(
            self.device,
            BackendSpec(
                config=config,
                num_worlds=worlds,
                obs_size=self.obs_size,
                autoreset=self.autoreset,
                threads=threads,
                seed=seed,
                geometry=make_geometry(source, config, n, worlds, self.teams_vary, starts),
                constants=make_record(*numbers),
                arena=self.arena,
                teams_vary=self.teams_vary,
            ),
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

        Raises:
            ConfigError: seed or episode are not allowed.
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
            ActionError: wrong shape, not numeric, or not finite, or ``active`` with another
                autoreset. No world has moved.
            StepError: before the first reset, or, with autoreset disabled, after the end of a
                world.
        """
        if active is not None and self.autoreset != "disabled":
            allowed = "allowed: None, or worlds that wait with autoreset disabled"
            raise ActionError(f"active: given with autoreset {self.autoreset!r}; {allowed}")
        self._backend.step(actions, active)
        out = self._backend.output
        for listener in self.listeners:
            listener.stepped(actions, out.terminated | out.truncated)
        return out.observations, out.rewards, out.terminated, out.truncated

    # -- other fields ------------------------------------------------------------------------------

    def set_field(self, field: Field, world: int = 0, starts: ArrayLike | None = None) -> None:
        """Give a world another field, right before its reset.

        With a sampler, the episodes after the next one have fields that are drawn again. A CUDA
        graph has to be captured again.

        Args:
            field: of the same arena, with at most ``n_rois`` ROIs and a start for each robot.
            world: its index.
            starts: where the robots start, (n, 2) units, instead of the field's own starts.

        Raises:
            ConfigError: the field does not fit; all problems are listed. Or several worlds share
                their only field.
            IndexError: no such world.
        """
        self._check_world(world)
        given = validation.as_starts(starts)
        problems = validation.set_field_problems(
            field, self._sizes, self.config, self.teams_vary, given
        )
        if self.num_worlds > 1 and len(self.fields) == 1:
            problems.append("field: one for all worlds; allowed: with a field for each, or 1 world")
        if problems:
            raise ConfigError("set_field", problems)
        self._backend.set_field(world, field, given)
        self._set_fields[world] = int(self.episode_numbers[world]) + 1, field

    def set_sampler(self, sampler: FieldSampler) -> None:
        """Draw fields by other numbers from the next resets on, as in a curriculum.

        Args:
            sampler: its fields are at most as large as those of the first one.

        Raises:
            ConfigError: they are not, or the engine has fixed fields; all problems are listed.
        """
        problems = validation.set_sampler_problems(sampler, self._sizes, self.teams_vary)
        if self.sampler is None:
            problems = ["sampler: allowed in place of another one"]
        if problems:
            raise ConfigError("set_sampler", problems)
        self.sampler = sampler
        self._backend.set_sampler(sampler)

    # -- what changes ------------------------------------------------------------------------------

    def sample_actions(self) -> Floats:
        """Uniform random actions, (W, n, 2) float32 in [-1, 1): the seed's next ones."""
        return self._backend.draw_actions()

    def save_state(self) -> dict[str, NDArray[Any]]:
        """Copies of everything that changes, by name: NumPy arrays, to be kept in a file.

        Each has the shape and the units that the engine works with, such as (n, W) for ``now.x``.
        The fields that a sampler has drawn are among them, those of :meth:`set_field` in an engine
        without one are not.
        """
        self._backend.raise_fault()
        return save_worlds(self._backend)

    def load_state(self, saved: Mapping[str, NDArray[Any]]) -> None:
        """Go on exactly where the engine that ``saved`` came from would.

        Settings and fields have to be the same; only sizes, types and samplers are compared.

        Args:
            saved: what :meth:`save_state` gave: arrays of its shapes, such as (n, W), and units.

        Raises:
            ProblemsError: naming every array with another shape or type, or values out of range.
            MbnError: it was an engine with another sampler. In both cases nothing has changed.
        """
        if not isinstance(saved, Mapping):
            found = type(saved).__name__
            raise MbnError(f"worlds: {found}; allowed: arrays by name, as of save_state()")
        theirs = saved.get("geometry.sampler")
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


def _load_all(field: FieldLike | Sequence[FieldLike]) -> tuple[Field, ...]:
    """The fields of an engine that does not draw them."""
    several = isinstance(field, Sequence) and not isinstance(field, str)
    return tuple(load_field(one) for one in (field if several else [field]))  # type: ignore[union-attr,arg-type]
