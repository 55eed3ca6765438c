"""Play actions in the engine, to make an episode or to check one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mbn_marl.config import NavigationConfig
from mbn_marl.engine import REWARD_TERMS, BatchEngine
from mbn_marl.episode.episode import Array, Episode, Outcome
from mbn_marl.errors import EpisodeError, MbnError, ProblemsError
from mbn_marl.field import Field

COMPARED = ("positions", "terms", "team_rewards")
"""The arrays that must be equal bit for bit, step by step."""


def play(
    field: Field,
    config: NavigationConfig,
    actions: ArrayLike,
    *,
    starts: ArrayLike | None = None,
    source: str = "",
    seed: int | None = None,
) -> Episode:
    """Play ``actions`` in a world of the engine.

    Args:
        field: the field.
        config: the configuration; ``random_starts`` is ignored.
        actions: (T, n, 2), clipped to [-1, 1].
        starts: the robots' starts, (n, 2), units; ``None`` for the field's own.
        source: the name of what chose the actions.
        seed: the seed of what chose the actions.

    Raises:
        ConfigError: field, configuration and starts do not fit together.
        EpisodeError: the actions are not finite numbers (T, n, 2), or continue after the end.
    """
    settings = {**config.model_dump(), "random_starts": False}
    engine = BatchEngine(field, 1, autoreset=False, threads=1, starts=starts, **settings)
    given = np.asarray(actions)
    robots = engine.n_robots
    if given.ndim != 3 or given.shape[1:] != (robots, 2) or given.dtype.kind not in "fiu":
        shape = f"shape {given.shape} of {given.dtype}"
        raise EpisodeError("episode", [f"actions: {shape}; allowed: numbers (steps, {robots}, 2)"])
    moves = np.clip(given, -1, 1).astype(engine.dtype)
    steps = len(moves)
    positions = np.empty((steps + 1, robots, 2), engine.dtype)
    visits = np.zeros(len(field.rois), np.int32)
    terms = np.empty((steps, robots, len(REWARD_TERMS)))
    team_rewards = np.empty(steps)
    outcome: Outcome = "unfinished"
    engine.reset()
    positions[0] = _positions(engine)
    for step, move in enumerate(moves, start=1):
        if outcome != "unfinished":
            problem = f"actions: there are {steps}; the episode ends after {step - 1} steps"
            raise EpisodeError("episode", [problem])
        try:
            _, _, terminated, truncated = engine.step(move[None])
        except MbnError as error:
            raise EpisodeError("episode", [f"step {step}: {error}"]) from None
        positions[step] = _positions(engine)
        terms[step - 1] = engine.reward_terms()[0]
        team_rewards[step - 1] = engine.team_rewards[0]
        visits[(visits == 0) & _visited(engine)] = step
        if terminated[0]:
            outcome = "collision" if engine.metrics()["collision"][0] else "success"
        elif truncated[0]:
            outcome = "truncated"
    return Episode(
        field=field,
        config=config.model_copy(update={"n_robots": robots}),
        actions=moves,
        positions=positions,
        visits=visits,
        terms=terms,
        team_rewards=team_rewards,
        outcome=outcome,
        source=source,
        seed=seed,
    )


def check_episode(episode: Episode, name: str = "episode") -> None:
    """Check that the engine reproduces an episode bit for bit.

    Args:
        episode: the episode.
        name: its name in errors, such as its file.

    Raises:
        EpisodeError: naming the first step that differs, or the parts of its field, configuration,
            starts and actions that do not fit together.
    """
    try:
        again = play(episode.field, episode.config, episode.actions, starts=episode.positions[0])
    except ProblemsError as error:
        raise EpisodeError(name, error.problems) from None
    for what in COMPARED:
        ours, theirs = getattr(episode, what), getattr(again, what)
        if not np.array_equal(ours, theirs):
            late = len(theirs) - episode.steps
            step = int(np.argmax((ours != theirs).reshape(len(ours), -1).any(axis=1))) + 1 - late
            problem = f"{what}: the engine gives others from step {step} on; it does not replay"
            raise EpisodeError(name, [problem])
    for what in ("visits", "outcome"):
        ours, theirs = getattr(episode, what), getattr(again, what)
        if not np.array_equal(ours, theirs):
            raise EpisodeError(name, [f"{what}: {ours}; replayed in the engine: {theirs}"])


def _positions(engine: BatchEngine) -> Array:
    state = engine.state()[0]
    positions: Array = state[: 2 * engine.n_robots].reshape(-1, 2)
    return positions


def _visited(engine: BatchEngine) -> Any:
    """Decode which ROIs are visited, (m,) bool; the first is the code's most significant bit."""
    code = int(engine.state()[0, -1])
    return np.array([code >> bit & 1 for bit in reversed(range(engine.n_rois))], np.bool_)
