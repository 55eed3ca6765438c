"""From routes to a verified plan: collision-free motions of the team."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mbn_marl.planning.motion import PAIR_ROOM, Separation, solve_motion
from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.surroundings import surroundings
from mbn_marl.planning.team import Route

ROUNDS = 12
"""Linearisations of the distances in one attempt."""
WATCH = 1.5
"""Pairs closer than this many safety distances are kept apart from the next round on."""

T = TypeVar("T")
Verify = Callable[[Floats, NDArray[np.float32]], T | None]
"""A plan from paths (n, T, 2), units, and actions (T, n, 2), if it holds."""


def coordinate(
    problem: Problem, verify: Verify[T], steps: int, routes: Sequence[Route], deadline: float
) -> T | None:
    """Return a verified plan of ``steps`` steps along the routes, ``None`` if none was found.

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
        paths, actions = motion
        if (verified := verify(paths, actions)) is not None:
            return verified
        close = list(close_pairs(problem, paths, random))
        if (problem.convex and not close) or time.monotonic() > deadline:
            return None
        separations.update({(pair.i, pair.j, pair.step): pair for pair in close})
    return None


def _padded(start: Floats, route: Route, steps: int) -> Floats:
    """Return (steps, 2): the route's path, then its last point."""
    path = np.concatenate([start[None], route.visits.path])[: steps + 1]
    return np.concatenate([path[1:], np.repeat(path[-1:], steps + 1 - len(path), axis=0)])


def close_pairs(
    problem: Problem, paths: Floats, random: np.random.Generator
) -> Iterator[Separation]:
    """Yield the pairs of robots that come too close, each step with a direction to separate them.

    Pairs that never come closer than the safety distance are skipped.
    """
    least = problem.config.safety_distance
    ways = np.concatenate([paths, problem.others_for(paths.shape[1])])
    for i, j in combinations(range(len(ways)), 2):
        if i >= problem.n:
            break
        apart = ways[i] - ways[j]
        distance = np.hypot(apart[:, 0], apart[:, 1])
        if distance.min() >= least + 0.5 * PAIR_ROOM:
            continue
        crossing = random.normal(size=2)
        for k in np.flatnonzero(distance < WATCH * least):
            direction = apart[k] if distance[k] > 0.1 * least else crossing
            x, y = (direction / np.hypot(*direction)).tolist()
            yield Separation(i, j, int(k) + 1, (x, y))
