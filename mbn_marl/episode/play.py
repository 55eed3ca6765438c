"""Play actions in the engine, to make an episode or to check one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mbn_marl.config import LIMITS, NavigationConfig
from mbn_marl.engine import REWARD_TERMS, BatchEngine
from mbn_marl.episode.episode import Array, Episode, Knowledge, Outcome
from mbn_marl.errors import EpisodeError, MbnError, ProblemsError
from mbn_marl.field import Field


class EpisodeLog:
    """Logs the episode of an engine with one world, from its reset on."""

    def __init__(self, engine: BatchEngine) -> None:
        self._engine, first = engine, engine.snapshot()
        self._visits = np.zeros(engine.n_rois, np.int32)
        self._positions = [first.positions]
        self._headings, self._winds = [first.headings], [first.wind]
        self._failed = np.zeros(engine.n_robots, np.int32)
        self._actions: list[Array] = []
        self._terms: list[Array] = []
        self._rewards: list[float] = []
        self._known: list[tuple[Array, ...]] = []
        self._note_knowledge()

    def add(self, actions: Array) -> list[int]:
        """Log the engine's last step, with ``actions`` (n, 2); return the ROIs visited in it."""
        moment = self._engine.snapshot()
        self._note_knowledge()
        self._positions.append(moment.positions)
        self._headings.append(moment.headings)
        self._winds.append(moment.wind)
        self._actions.append(np.clip(actions, -1, 1).astype(self._engine.dtype))
        self._terms.append(self._engine.reward_terms()[0].astype(np.float64))
        self._rewards.append(float(self._engine.team_rewards[0]))
        self._failed[moment.failed & (self._failed == 0)] = len(self._actions)
        fresh = np.flatnonzero(moment.visited & (self._visits == 0))
        self._visits[fresh] = len(self._actions)
        return fresh.tolist()

    def _note_knowledge(self) -> None:
        if self._engine.config.knowledge == "own":
            self._known.append(self._engine.knowledge())

    def _knowledge(self) -> Knowledge | None:
        if not self._known:
            return None
        done, found, heard = map(np.stack, zip(*self._known, strict=True))
        since = [np.where(one.any(axis=0), one.argmax(axis=0), len(one)) for one in (done, found)]
        return Knowledge(self._engine.decoys[0], since[0], since[1], heard)

    def episode(self, config: NavigationConfig, source: str, seed: int | None) -> Episode:
        """Return the episode so far; ``config`` may have a wind that the engine's has not."""
        engine, steps, last = self._engine, len(self._actions), self._engine.snapshot()
        ended: Outcome = "unfinished" if engine.running[0] else "truncated"
        drawn = {name: float(one[0]) for name, one in engine.drawn().items()}
        asked, had = (one.with_drawn(drawn).wind_increment() for one in (config, engine.config))
        own_wind = np.subtract(asked, had)
        shape = (steps, engine.n_robots)
        return Episode(
            field=engine.field,
            config=config.model_copy(update={"n_robots": engine.n_robots}),
            actions=np.array(self._actions, engine.dtype).reshape(*shape, 2),
            positions=np.array(self._positions),
            headings=np.array(self._headings),
            failed=self._failed.copy(),
            visits=self._visits.copy(),
            terms=np.array(self._terms, np.float64).reshape(*shape, len(REWARD_TERMS)),
            team_rewards=np.array(self._rewards),
            outcome="collision" if last.collision else "success" if last.success else ended,
            winds=np.array(self._winds) + own_wind if config.gust else None,
            source=source,
            drawn=drawn,
            seed=seed,
            world=engine.first_world,
            number=int(engine.episode_numbers[0]),
            knowledge=self._knowledge(),
        )


def of_team(config: NavigationConfig, n: int) -> NavigationConfig:
    update: dict[str, Any] = {"n_robots": n}
    for name in ("dynamics", *LIMITS):
        value = getattr(config, name)
        update[name] = value[:n] if isinstance(value, tuple) else value
    if (failures := config.failures) is not None:
        most = n - 1 if failures.most is None else min(failures.most, n)
        at = {i: step for i, step in failures.at.items() if i < n}
        now = {"at": at, "most": most or None, "rate": failures.rate if most else 0.0}
        update["failures"] = failures.model_copy(update=now)
    return config.model_copy(update=update)


def play(
    field: Field,
    config: NavigationConfig,
    actions: ArrayLike,
    *,
    starts: ArrayLike | None = None,
    source: str = "",
    seed: int | None = None,
    world: int = 0,
    number: int = 0,
) -> Episode:
    """Play ``actions``, (T, n, 2), clipped to [-1, 1], in a world of the engine.

    ``starts`` are (n, 2), units, or the field's. The key of all random numbers is ``seed``,
    ``world`` and ``number``, that of the episode since the seed was set.

    Raises:
        ConfigError: field, configuration and starts do not fit together.
        EpisodeError: the actions are not finite numbers (T, n, 2), or continue after the end.
    """
    settings = {**config.model_dump(), "random_starts": False}
    alone: dict[str, Any] = {"autoreset": False, "threads": 1, "first_world": world}
    engine = BatchEngine(field, 1, starts=starts, **alone, **settings)
    try:
        moves = np.asarray(actions)
        if moves.shape[1:] != (engine.n_robots, 2) or moves.dtype.kind not in "fiu":
            raise ValueError(f"shape {moves.shape} of {moves.dtype}")
    except ValueError as error:
        problem = f"actions: {error}; allowed: numbers (steps, {engine.n_robots}, 2)"
        raise EpisodeError("episode", [problem]) from None
    engine.reset(seed or 0, number)
    log = EpisodeLog(engine)
    for step, move in enumerate(moves):
        if not engine.running[0]:
            problem = f"actions: there are {len(moves)}; the episode ends after {step} steps"
            raise EpisodeError("episode", [problem])
        try:
            engine.step(move[None])
        except MbnError as error:
            raise EpisodeError("episode", [f"step {step + 1}: {error}"]) from None
        log.add(move)
    return log.episode(config, source, seed)


def check_episode(episode: Episode, name: str = "episode") -> Episode:
    """Check that the engine reproduces an episode, called ``name`` in errors, bit for bit.

    Return it with the ``knowledge`` of robots that know only their own, which is in no file.
    """
    try:
        again = play(
            *(episode.field, episode.config, episode.actions),
            starts=episode.positions[0],
            seed=episode.seed,
            world=episode.world,
            number=episode.number,
        )
    except ProblemsError as error:
        raise EpisodeError(name, error.problems) from None
    for what in ("positions", "headings", "winds", "terms", "team_rewards"):
        both = getattr(episode, what), getattr(again, what)
        ours, theirs = (np.nan if one is None else one for one in both)
        same = np.atleast_1d((ours == theirs) | (np.isnan(ours) & np.isnan(theirs)))
        if not same.all():
            late = len(same) - episode.steps
            step = int(np.argmax((~same).reshape(len(same), -1).any(axis=1))) + 1 - late
            problem = f"{what}: the engine gives others from step {step} on; it does not replay"
            raise EpisodeError(name, [problem])
    for what in ("failed", "visits", "outcome", "drawn"):
        ours, theirs = getattr(episode, what), getattr(again, what)
        if not np.array_equal(ours, theirs):
            raise EpisodeError(name, [f"{what}: {ours}; replayed in the engine: {theirs}"])
    return replace(episode, knowledge=again.knowledge)
