"""Plans in which robots wait for each other: who goes first through a narrow door.

Each robot has the path that it would take alone. In an order of the robots, each takes the earliest
way along its path, with waits, that keeps clear of those before it. The motion starts from there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from contextlib import suppress
from operator import or_

import numpy as np
import shapely

from mbn_marl.planning.motion import PAIR_ROOM, coordinate, meet
from mbn_marl.planning.orders import OutOfTimeError, Visits
from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.replay import Playback, Player
from mbn_marl.planning.roadmap import moved_into
from mbn_marl.planning.team import Route, Team

PARTITIONS = 6
"""Partitions of the ROIs that are tried at one makespan."""
ORDERS = 1000
"""Orders of the robots that are tried for one partition of the ROIs."""
PACES = (1.0, 1.03, 1.06, 1.12, 1.25, 1.5)
"""Lengths of the motions that are tried, in those of the waits, which need no time to brake."""
FAR = 3.0
"""Robots that pass each other within so many safety distances keep to their sides."""
LANES = (0.6, -0.6, 0.0)
"""Paths are moved to the right by so much where there is room, in safety distances: robots that
meet in the open pass each other."""
AHEAD, DRIFT = 3, 1.5
"""The steps that tell directions; how quickly a path moves aside, in units a step."""
YIELDS = 0.7
"""Robots that rest at their starts or after their visits may be so much closer, in safety
distances: they are moved aside."""
LATEST = 4
"""Waits up to this many times longer than the longest path are looked for."""


def quickest(team: Team, routes: Sequence[Route]) -> list[Route]:
    """Return the quickest route of each robot through its ROIs."""
    quick = []
    for i, route in enumerate(routes):
        mask = sum(1 << j for j in route.order)
        tries = (team.route(i, mask, steps) for steps in itertools.count(team.least(i, mask)))
        quick.append(next(found for found in tries if found is not None))
    return quick


def waits(
    problem: Problem, ways: Sequence[Floats], most: int, deadline: float
) -> list[list[int]] | None:
    """Return each robot's place on its way after each step, or ``None`` if none are clear.

    The ways (L + 1, 2) begin at the starts, in units. The robots are at their ends after at most
    ``most`` steps, as soon as possible.
    """
    n, least = problem.n, problem.config.safety_distance + PAIR_ROOM
    horizon = min(LATEST * max(map(len, ways)), most)
    near = {}
    for i, j in itertools.permutations(range(n), 2):
        apart = np.hypot(*(ways[j][:, None] - ways[i]).transpose(2, 0, 1))
        apart[[0, -1]] += YIELDS * problem.config.safety_distance
        apart[:, [0, -1]] += YIELDS * problem.config.safety_distance
        near[i, j] = _bits(apart < least)
    random, best = np.random.default_rng(0), None
    order, seen = sorted(range(n), key=lambda i: -len(ways[i])), set[tuple[int, ...]]()
    for _ in range(ORDERS):
        if problem.clock(0) > deadline:
            break
        if tuple(order) in seen:
            order = random.permutation(n).tolist()
        seen.add(tuple(order))
        placed: dict[int, list[int]] = {}
        for i in order:
            taken = [(near[i, j], way) for j, way in placed.items()]
            way = _along(len(ways[i]), taken, horizon)
            if way is None:
                order = [i, *(j for j in order if j != i)]
                break
            placed[i] = way
        else:
            best = [placed[i] for i in range(n)]
            horizon = max(map(_end, best)) - 1
    return best


def _beside(problem: Problem, path: Floats, lane: float) -> Floats:
    """Return a path (L + 1, 2) moved to the right by ``lane`` units where walls leave room."""
    padded = np.pad(path, ((AHEAD, AHEAD), (0, 0)), "edge")
    along = padded[2 * AHEAD :] - padded[: -2 * AHEAD]
    right = np.stack([along[:, 1], -along[:, 0]], axis=1)
    right /= np.maximum(np.hypot(*right.T), 1e-9)[:, None]
    room = shapely.distance(problem.area.boundary, shapely.points(path))
    steps = np.abs(np.subtract.outer(*[np.arange(len(path))] * 2))
    room[0] = 0.0  # and from there on it grows slowly
    room = np.clip((room + DRIFT * steps).min(axis=1), 0.0, abs(lane))
    return moved_into(problem.area, path + np.sign(lane) * room[:, None] * right)


def _bits(rows: np.ndarray) -> list[int]:
    packed = np.packbits(rows, axis=1, bitorder="little")
    return [int.from_bytes(row.tobytes(), "little") for row in packed]


def _end(way: Sequence[int]) -> int:
    return way.index(way[-1])


def _along(
    length: int, taken: Sequence[tuple[list[int], list[int]]], most: int
) -> list[int] | None:
    """Return the place on a path after 0 to ``most`` steps, at its end as soon as possible.

    Places are bits. It waits as early as it can: robots rest at their starts.
    """
    closed = [0] * (most + 1)
    for near, way in taken:
        closed = list(map(or_, closed, map(near.__getitem__, way)))
    reached = [1 & ~closed[0]]
    for step in range(1, most + 1):
        reached.append((reached[-1] | reached[-1] << 1) & ~closed[step])
    last, end = length - 1, most + 1
    while end > 0 and not closed[end - 1] >> last & 1:
        end -= 1
    while end <= most and not reached[end] >> last & 1:
        end += 1
    if end > most:
        return None
    way = [last] * (most + 1 - end)
    at = last
    for step in range(end - 1, -1, -1):
        at -= at > 0 and bool(reached[step] >> at - 1 & 1)
        way.append(at)
    return way[::-1]


def _paced(route: Route, way: Sequence[int], path: Floats, before: int, steps: int) -> Route:
    """Return a route that is at place ``way[k]`` of its path after k of ``before`` steps.

    It takes ``steps`` for these.
    """
    places = path[list(way)]
    times = np.linspace(0, before, steps + 1)[1:]
    moved = [np.interp(times, np.arange(len(places)), axis) for axis in places.T]
    due = (way.index(step) * steps / before for step in route.visits.steps)
    visits = tuple(min(max(round(step), 1), steps) for step in due)
    return Route(route.order, Visits(visits, 0.0, np.stack(moved, axis=1)))


def wait(
    problem: Problem, player: Player, guide: Team, bound: int, most: int, deadline: float
) -> Playback | None:
    """Return a verified plan of at most ``most`` steps in which robots wait for each other.

    It is ``None`` if none was found, or if the first routes keep the robots apart without waits.
    """
    best = None
    with suppress(OutOfTimeError):
        for steps in range(bound, most + 1):
            tried = False
            for routes in itertools.islice(guide.solutions(steps), PARTITIONS):
                if steps > most or not meet(problem, routes, steps):
                    return best
                if found := take_turns(problem, player, guide, routes, most, deadline):
                    best, most = found, len(found.actions) - 1
                tried = True
            if tried:
                break
    return best


def take_turns(
    problem: Problem,
    player: Player,
    team: Team,
    routes: Sequence[Route],
    most: int,
    deadline: float,
) -> Playback | None:
    """Return a verified plan of at most ``most`` steps through the ROIs of the routes."""
    quick, tries = quickest(team, routes), []
    both = zip(problem.starts, quick, strict=True)
    paths = [np.concatenate([start[None], route.visits.path]) for start, route in both]
    for lane in LANES:
        ways = [_beside(problem, path, lane * problem.config.safety_distance) for path in paths]
        if (places := waits(problem, ways, most, deadline)) is not None:
            length = max(map(_end, places))
            tries += [(math.ceil(pace * length), length, places, ways) for pace in PACES]
    for steps, length, places, ways in sorted(tries, key=lambda one: one[0]):
        if steps > most or problem.clock(0) > deadline:
            break
        slower = [
            _paced(route, place, way, length, steps)
            for route, place, way in zip(quick, places, ways, strict=True)
        ]
        if found := coordinate(problem, player.verify, steps, slower, deadline, FAR):
            return found
    return None
