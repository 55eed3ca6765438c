"""Records the episodes of one world of any environment."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import field as empty
from typing import Any, Self

import numpy as np

from mbn_marl.engine import BatchEngine
from mbn_marl.engine.validation import as_array
from mbn_marl.episode.episode import Array, Episode
from mbn_marl.episode.play import of_team, play
from mbn_marl.errors import EpisodeError, MbnError
from mbn_marl.field import Field

# The attributes in which environments keep their engine, and wrappers their environment.
_INNER = ("engine", "unwrapped", "env", "aec_env", "par_env", "venv", "base_env")


@dataclass
class _Tape:
    field: Field
    starts: Array
    seed: int
    number: int
    actions: list[Array] = empty(default_factory=list)
    rewards: list[float] = empty(default_factory=list)


class EpisodeRecorder:
    """Records one world of an environment from reset to reset, in a ``with`` block.

    The environment is a PettingZoo, Gymnasium, Stable-Baselines3 or TorchRL one of this package,
    in any wrappers, or a :class:`~mbn_marl.BatchEngine`. An :class:`Episode` is made by playing
    starts and actions again in an engine of one world, and checked by its rewards.
    """

    def __init__(self, environment: Any, world: int = 0, *, source: str = "") -> None:
        self._engine = find_engine(environment)
        if not 0 <= world < self._engine.num_worlds:
            raise MbnError(f"world {world}; allowed: 0 to {self._engine.num_worlds - 1}")
        self._world, self._source = world, source
        self._tapes: list[_Tape] = []
        self._recording = False

    def __enter__(self) -> Self:
        """Start with the episode that has just been reset, or else with the next one."""
        self._engine.listeners.append(self)
        self._begin()
        return self

    def __exit__(self, *_: object) -> None:
        self._engine.listeners.remove(self)
        self._recording = False

    @property
    def episodes(self) -> list[Episode]:
        """The episodes with at least one recorded step; the last one may be unfinished."""
        return [self._episode(tape) for tape in self._tapes if tape.actions]

    def was_reset(self, mask: Any) -> None:
        """Begin a new episode if ``mask`` contains the world; the engine calls this."""
        if mask is None or mask[self._world]:
            self._begin()

    def stepped(self, actions: Any, ended: Any) -> None:
        """Record the world's part of a step; the engine calls this."""
        engine, world = self._engine, self._world
        if self._recording:
            tape, acted = self._tapes[-1], as_array(actions[world])
            tape.actions.append(np.clip(acted, -1, 1).astype(engine.dtype))
            tape.rewards.append(float(engine.team_rewards[world]))
            self._recording = not ended[world]
        if not self._recording and engine.autoreset != "disabled":
            self._begin()

    def _begin(self) -> None:
        engine, world = self._engine, self._world
        moment = engine.snapshot(world)
        self._recording = bool(engine.running[world]) and moment.step == 0
        if self._recording:
            number = int(engine.episode_numbers[world])
            self._tapes.append(_Tape(moment.field, moment.positions, engine.seed, number))

    def _episode(self, tape: _Tape) -> Episode:
        engine, team = self._engine, len(tape.starts)
        episode = play(
            *(tape.field, of_team(engine.config, team), np.stack(tape.actions)[:, :team]),
            starts=tape.starts,
            source=self._source,
            seed=tape.seed,
            world=engine.first_world + self._world,
            number=tape.number,
        )
        if not np.array_equal(tape.rewards, episode.team_rewards):
            raise EpisodeError("recording", ["rewards: the engine gave others when it replayed"])
        return episode


def find_engine(environment: Any) -> BatchEngine:
    waiting, seen = [environment], set()
    while waiting:
        inner = waiting.pop()
        if isinstance(inner, BatchEngine):
            return inner
        if id(inner) not in seen:
            seen.add(id(inner))
            found = [getattr(inner, name, None) for name in _INNER]
            waiting += [one for one in found if one is not None]
    kind = type(environment).__name__
    raise MbnError(f"{kind}: not an environment of mbn_marl, nor a wrapper of one")
