"""From routes to a verified plan: motions of the whole team, kept apart, replayed in the engine."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mbn_marl.planning.motion import PAIR_ROOM, Motion, Separation, solve_motion
from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.replay import Replay, Stage
from mbn_marl.planning.surroundings import surroundings
from mbn_marl.planning.team import Route

ROUNDS = 12
"""Linearisations of the distances before an attempt is given up."""
WATCH = 1.5
"""Pairs closer than this many safety distances are kept apart from the next round on."""
GRIDS = (0.0, 1e-6, 1e-4, 1e-2)
"""A force so close to none or to all of it is rounded to that: such motions are exact."""


@dataclass(frozen=True)
class Verified:
    """Actions (T, n, 2) float32 that end in success, and the episode that they make."""

    actions: NDArray[np.float32]
    replay: Replay


def coordinate(
    problem: Problem, stage: Stage, steps: int, routes: Sequence[Route], deadline: float
) -> Verified | None:
    """Motions of ``steps`` steps along the routes, verified, or ``None`` if none was found.

    The distances between robots, and the field where it is not convex, are linearised about the
    last round's motions.
    """
    separations: dict[tuple[int, int, int], Separation] = {}
    random = np.random.default_rng(0)
    visits = [list(zip(route.visits.steps, route.order, strict=True)) for route in routes]
    paths = np.stack(
        [_padded(start, route, steps) for start, route in zip(problem.starts, routes, strict=True)]
    )
    for _ in range(ROUNDS):
        places = surroundings(problem, paths)
        motion = solve_motion(problem, steps, visits, places, list(separations.values()))
        if motion is None:
            return None
        verified = verify(stage, motion)
        if verified is not None:
            return verified
        close = list(close_pairs(problem, motion.paths, random))
        if (problem.convex and not close) or time.monotonic() > deadline:
            return None
        paths = motion.paths
        separations.update({(pair.i, pair.j, pair.step): pair for pair in close})
    return None


def _padded(start: Floats, route: Route, steps: int) -> Floats:
    """(steps, 2): the route's path, and its last point from then on."""
    path = np.concatenate([start[None], route.visits.path])[: steps + 1]
    return np.concatenate([path[1:], np.repeat(path[-1:], steps + 1 - len(path), axis=0)])


def verify(stage: Stage, motion: Motion) -> Verified | None:
    """Replay the motion's actions, and again with forces snapped to none and all."""
    for grid in GRIDS:
        actions = snap(motion.actions, grid)
        replay = stage.replay(actions)
        if replay.success and not replay.wall_hits:
            return Verified(actions[: replay.steps], replay)
    return None


def snap(actions: NDArray[np.float32], grid: float) -> NDArray[np.float32]:
    """The actions, those within ``grid`` of a whole number rounded to it."""
    whole = np.round(actions)
    return np.where(np.abs(actions - whole) <= grid, whole, actions).astype(np.float32)


def close_pairs(
    problem: Problem, paths: Floats, random: np.random.Generator
) -> Iterator[Separation]:
    """Pairs of robots that come close, with the direction in which they are apart.

    If no pair comes closer than the safety distance, there is nothing to keep apart.
    """
    least = problem.config.safety_distance
    for i, j in combinations(range(problem.n), 2):
        apart = paths[i] - paths[j]
        distance = np.hypot(apart[:, 0], apart[:, 1])
        if distance.min() >= least + 0.5 * PAIR_ROOM:
            continue
        crossing = random.normal(size=2)
        for k in np.flatnonzero(distance < WATCH * least):
            direction = apart[k] if distance[k] > 0.1 * least else crossing
            x, y = (direction / np.hypot(*direction)).tolist()
            yield Separation(i, j, int(k) + 1, (x, y))
