"""The motions of all robots for given steps of the visits: a convex program.

The robots spend the least effort and keep some room to discs, walls and each other where they can.
Every constraint but the dynamics has a priced shortfall, so that there is always a solution for
the next linearisation to start from.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, TypeVar

import clarabel
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.roadmap import moved_into
from mbn_marl.planning.team import Route

DISC_ROOM, FIELD_ROOM, PAIR_ROOM = 0.05, 0.02, 0.05
"""Room that the program pays for, in units; rounding needs a hundredth of it."""
EFFORT = 1e-3
PRICE = 100.0
"""Price of a unit of missing room; effort is priced per squared full force and step."""
ASIDE = 0.1
"""Points are moved this far from the walls first, in units."""
MOST_PLANES = 40
ROUNDS = 12
"""Linearisations of the distances in one attempt."""
FEWER = 4
"""Those of an attempt that begins with routes that keep the robots apart."""
WORK = 8
"""A motion of so many steps of robots takes as much time as a linear program of a route."""
WATCH = 1.5
"""Pairs closer than this many safety distances are kept apart from the next round on."""
DRIFT = 0.03
"""Share of the force with which idle robots drift, since standing still costs a revisit."""

T = TypeVar("T")
Verify = Callable[[Floats, NDArray[np.float32]], T | None]
"""A plan from paths (n, T, 2), units, and actions (T, n, 2), if it holds."""
Sparse = Any
"""A sparse matrix of rows."""
Parts = Sequence[ArrayLike]
HalfPlanes = tuple[Floats, Floats]
"""``normals @ p <= offsets``: (k, 2) and (k,)."""


@dataclass(frozen=True)
class Separation:
    """Robots ``i`` and ``j`` keep their distance at ``step`` along ``normal``, from j to i.

    From n on, j is one of the problem's ``others``, whose way is known.
    """

    i: int
    j: int
    step: int
    normal: tuple[float, float]


class _ConicProgram:
    """Collects rows ``A x + s = b``; the columns are the robots' offsets, rooms, shortfalls.

    ``visits`` has for each robot pairs of a step (1 to T) and the ROI to visit then; ``places`` has
    for each robot and step the convex set to be in; a single set is for all steps.
    """

    def __init__(
        self,
        problem: Problem,
        steps: int,
        visits: Sequence[Sequence[tuple[int, int]]],
        places: Sequence[Sequence[HalfPlanes]],
        separations: Sequence[Separation],
    ) -> None:
        self.problem, self.steps = problem, steps
        self.block = 2 * steps
        self.rooms = problem.n * self.block
        self.shortfalls = self.rooms + 2 * problem.n
        self.width = self.shortfalls + len(separations)
        self.linear: list[tuple[Sparse, Floats]] = []  # rows of ``A``, and ``b``
        self.cones: list[tuple[Sparse, Floats]] = []
        self.speed, self.change = _differences(steps)
        for i in range(problem.n):
            self._add_robot(i, places[i], visits[i])
        if separations:
            self._separate(separations)

    def _add_robot(
        self, i: int, places: Sequence[HalfPlanes], visits: Sequence[tuple[int, int]]
    ) -> None:
        """Limit robot i's velocity and force; keep it in its places and in the visits' discs.

        A wind that is stronger than the force leaves a robot at the speed limit at its speed.
        """
        problem, steps, tau = self.problem, self.steps, self.problem.config.tau
        left, disc_room = i * self.block, self.rooms + 2 * i
        top = np.full(self.block, problem.drives[i].top * tau)
        force = np.repeat(problem.forces[i], steps) * tau
        push = np.repeat(problem.wind, steps) * tau
        first = self._first_change(i)
        for rows, limits in (
            (self.speed, top),
            (-self.speed, top),
            (self.change, np.maximum(force + push, 0.0) + first),
            (-self.change, np.maximum(force - push, 0.0) - first),
        ):
            entries = rows.data, rows.indices + left, rows.indptr
            self.linear.append((sp.csr_matrix(entries, (self.block, self.width)), limits))
        rooms = [disc_room, disc_room + 1]
        self._append([[0, 1]], [rooms], [[1.0, 1.0]], [DISC_ROOM, FIELD_ROOM])
        places = [*places] * steps if len(places) == 1 else places
        normals, offsets = (np.concatenate(parts) for parts in zip(*places, strict=True))
        x = left + np.repeat(np.arange(steps), [len(limits) for _, limits in places])
        columns = [x, x + steps, np.full(len(x), disc_room + 1)]
        limits = offsets - normals @ problem.starts[i]
        self._append([np.arange(len(x))] * 3, columns, [*normals.T, np.ones(len(x))], limits)
        for step, j in visits:
            at = [disc_room, left + step - 1, left + steps + step - 1]
            row = sp.csr_matrix(([1.0, -1.0, -1.0], ([0, 1, 2], at)), (3, self.width))
            offset = problem.starts[i] - problem.rois[j]
            self.cones.append((row, np.array([problem.config.roi_radius, *offset])))

    def _separate(self, separations: Sequence[Separation]) -> None:
        count = len(separations)
        n, starts, others = self.problem.n, self.problem.starts, self.problem.others_for(self.steps)
        normals = np.array([pair.normal for pair in separations])
        moves = np.array([pair.j < n for pair in separations])
        ends = np.array([(pair.i, pair.j if pair.j < n else pair.i) for pair in separations])
        origins = np.array(
            [starts[p.j] if p.j < n else others[p.j - n, p.step - 1] for p in separations]
        )
        base = ends * self.block + np.array([[pair.step - 1] for pair in separations])
        spare, one = self.shortfalls + np.arange(count), -np.ones(count)
        columns = [base[:, 0], base[:, 0] + self.steps, base[:, 1], base[:, 1] + self.steps, spare]
        apart = starts[ends[:, 0]] - origins
        least = self.problem.config.safety_distance + PAIR_ROOM
        limits = (normals * apart).sum(axis=1) - least
        pulls = [*-normals.T, *(normals * moves[:, None]).T, one]
        self._append([np.arange(count)] * 5, columns, pulls, limits)
        self._append([np.arange(count)], [spare], [one], np.zeros(count))

    def solve(self) -> tuple[Floats, NDArray[np.float32]] | None:
        """Return the motions of least effort, or ``None`` if the solver failed.

        They are (n, T, 2), the positions after each step, units, and (T, n, 2), actions in [-1, 1].
        """
        rows, limits = zip(*self.linear, *self.cones, strict=True)
        kinds = [clarabel.NonnegativeConeT(sum(len(one) for _, one in self.linear))]
        kinds += [clarabel.SecondOrderConeT(3)] * len(self.cones)
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        parts = sp.vstack(rows, format="csc"), np.concatenate(limits), kinds
        solution = clarabel.DefaultSolver(*self._cost(), *parts, settings).solve()
        x = np.array(solution.x)
        solved = ("Solved", "AlmostSolved", "InsufficientProgress", "MaxIterations")
        if str(solution.status) not in solved or not np.all(np.isfinite(x)):
            return None
        problem, n, steps = self.problem, self.problem.n, self.steps
        offsets = x[: self.rooms].reshape(n, 2, steps).transpose(0, 2, 1)
        changes = np.stack([self.change @ x[self._span(i)] for i in range(n)])
        changes -= np.stack([self._first_change(i) for i in range(n)])
        forces = changes.reshape(n, 2, steps) / problem.config.tau - problem.wind[:, None]
        actions = (forces / problem.forces[:, :, None]).transpose(2, 0, 1)
        return problem.starts[:, None] + offsets, np.clip(actions, -1.0, 1.0).astype(np.float32)

    def _cost(self) -> tuple[Sparse, Floats]:
        """Return the quadratic and linear cost: effort about a small random drift, and prices."""
        problem = self.problem
        random = np.random.default_rng(0)
        blocks, linear = [], np.zeros(self.width)
        for i in range(problem.n):
            scale = 1.0 / (np.repeat(problem.forces[i], self.steps) * problem.config.tau)
            push = np.repeat(problem.wind, self.steps) * problem.config.tau
            scaled = sp.diags(scale) @ self.change
            wanted = random.uniform(-DRIFT, DRIFT, self.block) + push * scale
            blocks.append(EFFORT * 2.0 * (scaled.T @ scaled))
            wanted += self._first_change(i) * scale
            linear[self._span(i)] = -EFFORT * 2.0 * (scaled.T @ wanted)
        rest = self.width - self.rooms
        square = sp.block_diag([*blocks, sp.csc_matrix((rest, rest))], format="csc")
        linear[self.rooms : self.shortfalls] = -PRICE
        linear[self.shortfalls :] = PRICE
        return sp.triu(square, format="csc"), linear

    def _first_change(self, i: int) -> Floats:
        first = np.zeros((2, self.steps))
        first[:, 0] = self.problem.velocities[i] * self.problem.config.tau
        return first.ravel()

    def _append(self, rows: Parts, columns: Parts, values: Parts, limits: ArrayLike) -> None:
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        limits = np.asarray(limits)
        self.linear.append((sp.csr_matrix(entries, (len(limits), self.width)), limits))

    def _span(self, i: int) -> slice:
        return slice(i * self.block, (i + 1) * self.block)


@functools.lru_cache(maxsize=8)
def _differences(steps: int) -> tuple[Sparse, Sparse]:
    """Return first and second differences (2T, 2T) of both axes' offsets from rest at 0."""
    one: Sparse = sp.eye_array(steps, format="csr") - sp.eye_array(steps, k=-1, format="csr")
    return sp.block_diag([one, one], format="csr"), sp.block_diag([one @ one] * 2, format="csr")


def surroundings(problem: Problem, paths: Floats) -> list[list[HalfPlanes]]:
    """Return a convex part of the field for each robot and step, around ``paths`` (n, T, 2)."""
    if problem.convex:
        return [[problem.half_planes]] * len(paths)
    inner = problem.area.buffer(-ASIDE, join_style="mitre")
    area = problem.area if inner.is_empty else inner
    centres = moved_into(area, paths.reshape(-1, 2))
    pieces = [_piece(problem.walls, centre) for centre in centres]
    steps = paths.shape[1]
    return [pieces[i * steps : (i + 1) * steps] for i in range(len(paths))]


def _piece(edges: Floats, centre: Floats) -> HalfPlanes:
    """Return half-planes that contain ``centre`` and no wall; each one touches the nearest wall."""
    starts, ends = edges[:, :2] - centre, edges[:, 2:] - centre
    normals: list[Floats] = []
    offsets: list[float] = []
    while len(starts) and len(normals) < MOST_PLANES:
        along = ends - starts
        square = np.maximum(np.einsum("ij,ij->i", along, along), 1e-18)
        share = np.clip(-np.einsum("ij,ij->i", starts, along) / square, 0.0, 1.0)
        nearest = starts + share[:, None] * along
        distance = np.hypot(nearest[:, 0], nearest[:, 1])
        k = int(np.argmin(distance))
        normal = nearest[k] / max(distance[k], 1e-12)
        normals.append(normal)
        offsets.append(float(distance[k]))
        starts, ends = _in_front(starts, ends, normal, float(distance[k]))
    found = np.array(normals)
    return found, np.array(offsets) + found @ centre


def _in_front(starts: Floats, ends: Floats, normal: Floats, offset: float) -> tuple[Floats, Floats]:
    a, b = starts @ normal - offset, ends @ normal - offset
    kept = np.minimum(a, b) < -1e-7
    starts, ends, a, b = starts[kept], ends[kept], a[kept], b[kept]
    share = np.clip(a / np.where(a == b, 1.0, a - b), 0.0, 1.0)[:, None]
    crossing = starts + share * (ends - starts)
    return (
        np.where((a > 0.0)[:, None], crossing, starts),
        np.where((b > 0.0)[:, None], crossing, ends),
    )


def coordinate(
    problem: Problem,
    verify: Verify[T],
    steps: int,
    routes: Sequence[Route],
    deadline: float,
    far: float | None = None,
) -> T | None:
    """Return a verified plan of ``steps`` steps along the routes, ``None`` if none was found.

    The distances between robots, and the field where it is not convex, are linearised about the
    last round's motions. With ``far`` the routes keep the robots apart, and the motion keeps to
    their sides wherever two are closer than ``far`` safety distances.
    """
    separations: dict[tuple[int, int, int], Separation] = {}
    random = np.random.default_rng(0)
    visits = [list(zip(route.visits.steps, route.order, strict=True)) for route in routes]
    paths = padded(problem, routes, steps)
    close = [*close_pairs(problem, paths, random, far)] if far else []
    for _ in range(FEWER if far else ROUNDS):
        separations.update({(pair.i, pair.j, pair.step): pair for pair in close})
        places = surroundings(problem, paths)
        program = _ConicProgram(problem, steps, visits, places, list(separations.values()))
        if (motion := program.solve()) is None:
            return None
        paths, actions = motion
        if (verified := verify(paths, actions)) is not None:
            return verified
        close = list(close_pairs(problem, paths, random))
        if (problem.convex and not close) or problem.clock(problem.n * steps // WORK) > deadline:
            return None
    return None


def meet(problem: Problem, routes: Sequence[Route], steps: int) -> bool:
    """Return whether robots come too close to each other on their routes."""
    paths = padded(problem, routes, steps)
    return any(True for _ in close_pairs(problem, paths, np.random.default_rng(0)))


def padded(problem: Problem, routes: Sequence[Route], steps: int) -> Floats:
    """Return the paths, (n, T, 2), of robots that stay where their routes end."""
    paths = []
    for start, route in zip(problem.starts, routes, strict=True):
        path = np.concatenate([start[None], route.visits.path])[: steps + 1]
        paths.append(np.pad(path, ((0, steps + 1 - len(path)), (0, 0)), "edge")[1:])
    return np.stack(paths)


def close_pairs(
    problem: Problem, paths: Floats, random: np.random.Generator, far: float = 0.0
) -> Iterator[Separation]:
    """Yield the pairs of robots that come too close, each step with a direction to separate them.

    Pairs that never come closer than the safety distance, or than ``far`` of them, are skipped.
    """
    least = problem.config.safety_distance
    ways = np.concatenate([paths, problem.others_for(paths.shape[1])])
    for i, j in combinations(range(len(ways)), 2):
        if i >= problem.n:
            break
        apart = ways[i] - ways[j]
        distance = np.hypot(apart[:, 0], apart[:, 1])
        if distance.min() >= max(least + 0.5 * PAIR_ROOM, far * least):
            continue
        crossing = random.normal(size=2)
        for k in np.flatnonzero(distance < max(WATCH, far) * least):
            direction = apart[k] if distance[k] > 0.1 * least else crossing
            x, y = (direction / np.hypot(*direction)).tolist()
            yield Separation(i, j, int(k) + 1, (x, y))
