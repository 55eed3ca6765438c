"""Records the episodes of one world, whatever form of the environment it belongs to."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

import numpy as np

from mbn_marl.engine import BatchEngine
from mbn_marl.episode.episode import Array, Episode
from mbn_marl.episode.play import play
from mbn_marl.errors import EpisodeError, MbnError

_INNER = ("unwrapped", "env", "aec_env", "par_env", "venv", "base_env")
"""What wrappers call what they wrap."""


@dataclass
class _Tape:
    """What is noted of one episode: its start, its actions, and its team rewards to check by."""

    starts: Array
    seed: int
    actions: list[Array] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)


class EpisodeRecorder:
    """Follows one world of an environment from reset to reset, in a ``with`` block.

    For example::

        with EpisodeRecorder(env, source="my policy") as recorder:
            env.reset(seed=0)
            ...
        save_episode(recorder.episodes[-1], "episode.json")

    It notes starts and actions. Everything else of an :class:`Episode` comes from playing them
    again in an engine of one world, and is only handed out if that gave the same rewards.

    Args:
        environment: a PettingZoo, Gymnasium, Stable-Baselines3 or TorchRL environment of this
            package, in any wrappers, or a :class:`~mbn_marl.BatchEngine`.
        world: which world of it.
        source: what acts, in words.

    Raises:
        MbnError: there is no engine in ``environment``, or no such world.
    """

    def __init__(self, environment: Any, world: int = 0, *, source: str = "") -> None:
        self._engine = find_engine(environment)
        if not 0 <= world < self._engine.num_worlds:
            raise MbnError(f"world {world}; allowed: 0 to {self._engine.num_worlds - 1}")
        self._world, self._source = world, source
        self._tapes: list[_Tape] = []
        self._going_on = False

    def __enter__(self) -> Self:
        """Begin to follow: the episode that has just been reset, or else the next one."""
        self._engine.listeners.append(self)
        self._begin()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop following; what was recorded stays."""
        self._engine.listeners.remove(self)
        self._going_on = False

    @property
    def episodes(self) -> list[Episode]:
        """Every episode so far of which at least one step was seen, the last perhaps unfinished.

        Raises:
            EpisodeError: the engine did not do the same again.
        """
        return [self._episode(tape) for tape in self._tapes if tape.actions]

    def was_reset(self, mask: Any) -> None:
        """See :class:`mbn_marl.engine.listener.Listener`."""
        if mask is None or mask[self._world]:
            self._begin()

    def stepped(self, actions: Any, ended: Any) -> None:
        """See :class:`mbn_marl.engine.listener.Listener`."""
        engine, world = self._engine, self._world
        if not self._going_on:
            if engine.autoreset == "next_step":
                self._begin()
            return
        tape = self._tapes[-1]
        tape.actions.append(np.clip(_host(actions[world]), -1, 1).astype(engine.dtype))
        tape.rewards.append(float(engine.team_rewards[world]))
        if ended[world]:
            self._going_on = False
            if engine.autoreset == "same_step":
                self._begin()

    def _begin(self) -> None:
        """Begin a tape, if the world stands at the start of an episode."""
        moment = self._engine.snapshot(self._world)
        self._going_on = bool(self._engine.running[self._world]) and moment.step == 0
        if self._going_on:
            self._tapes.append(_Tape(moment.positions, self._engine.seed))

    def _episode(self, tape: _Tape) -> Episode:
        engine = self._engine
        episode = play(
            engine.fields[self._world % len(engine.fields)],
            engine.config,
            np.stack(tape.actions),
            starts=tape.starts,
            source=self._source,
            seed=tape.seed,
        )
        if not np.array_equal(tape.rewards, episode.team_rewards):
            raise EpisodeError("recording", ["rewards: the engine did not do the same again"])
        return episode


def find_engine(environment: Any) -> BatchEngine:
    """The engine behind ``environment``, which may be one itself or be wrapped.

    Raises:
        MbnError: there is none.
    """
    waiting, seen = [environment], set()
    while waiting:
        inner = waiting.pop()
        if isinstance(inner, BatchEngine):
            return inner
        if id(inner) not in seen:
            seen.add(id(inner))
            names = ("engine", *_INNER)
            found = [getattr(inner, name, None) for name in names]
            waiting += [one for one in found if one is not None]
    kind = type(environment).__name__
    raise MbnError(f"{kind}: no environment of mbn_marl, nor a wrapper round one")


def _host(array: Any) -> Array:
    """As a NumPy array; a torch tensor may be elsewhere."""
    return np.asarray(array.cpu() if hasattr(array, "cpu") else array)
