"""All robots' motions, once it is decided when each ROI is visited: a convex program.

The robots spend as little effort as they can; discs, field and distances have room to spare where
there is room. Everything hard but the dynamics has a priced shortfall, so that there is always a
solution, from which the next linearisation can go on.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import clarabel
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mbn_marl.planning.problem import Floats, Problem

DISC_ROOM, FIELD_ROOM, PAIR_ROOM = 0.05, 0.02, 0.05
"""Room that is worth having, in units; rounding needs a hundredth of it."""
EFFORT = 1e-3
PRICE = 100.0
"""Of a unit of missing room; effort is priced per squared full force and step."""
DRIFT = 0.03
"""Robots with nothing to do still stir by so much of their force: standing costs a revisit."""

Sparse = Any
"""A sparse matrix in rows."""

HalfPlanes = tuple[Floats, Floats]
"""``normals @ p <= offsets``: (k, 2) and (k,)."""


@dataclass(frozen=True)
class Separation:
    """Robots ``i`` and ``j`` keep their distance at ``step`` along ``normal``, from j to i."""

    i: int
    j: int
    step: int
    normal: tuple[float, float]


@dataclass(frozen=True)
class Motion:
    """A solution.

    Attributes:
        paths: (n, T, 2): positions after each step, units.
        actions: (T, n, 2) float32 in [-1, 1].
        missing: the largest shortfall of a disc, the field or a distance, in units.
    """

    paths: Floats
    actions: NDArray[np.float32]
    missing: float


def solve_motion(
    problem: Problem,
    steps: int,
    visits: Sequence[Sequence[tuple[int, int]]],
    places: Sequence[Sequence[HalfPlanes]],
    separations: Sequence[Separation],
) -> Motion | None:
    """The motions of least effort.

    Args:
        problem: the instance.
        steps: T, at least 1.
        visits: for each robot, pairs of a step (1 to T) and the ROI that it visits then.
        places: for each robot and step, the convex set to be in; one set stands for all steps.
        separations: linearised distances.

    Returns:
        The motions, or ``None`` if the solver gave up.
    """
    program = _Program(problem, steps)
    for i in range(problem.n):
        program.drive(i)
        program.stay(i, places[i])
        program.visit(i, visits[i])
    program.separate(separations)
    solution = program.solve()
    return None if solution is None else program.motion(solution)


class _Program:
    """Collects rows ``A x + s = b`` for Clarabel: the robots' offsets, rooms, then shortfalls."""

    def __init__(self, problem: Problem, steps: int) -> None:
        self.problem, self.steps = problem, steps
        self.block = 2 * steps
        self.rooms = problem.n * self.block
        self.width = self.rooms + 2 * problem.n
        self.linear: list[Sparse] = []
        self.limits: list[Floats] = []
        self.cones: list[Sparse] = []
        self.cone_limits: list[Floats] = []
        self.shortfalls = 0
        self.speed, self.change = _differences(steps)

    def drive(self, i: int) -> None:
        """Limits of velocity and force; the rooms' limits.

        Against a wind that is stronger than the force, a robot at the speed limit keeps its speed.
        """
        problem, tau = self.problem, self.problem.config.tau
        top = np.full(self.block, problem.config.v_clip * tau)
        force = np.repeat(problem.forces[i], self.steps) * tau
        push = np.repeat(problem.wind, self.steps) * tau
        self._add(i, self.speed, top)
        self._add(i, -self.speed, top)
        self._add(i, self.change, np.maximum(force + push, 0.0))
        self._add(i, -self.change, np.maximum(force - push, 0.0))
        pick = sp.csr_matrix(([1.0, 1.0], ([0, 1], self._rooms(i))), (2, self.width))
        self.linear.append(pick)
        self.limits.append(np.array([DISC_ROOM, FIELD_ROOM]))

    def stay(self, i: int, places: Sequence[HalfPlanes]) -> None:
        """Stay in the field after every step, with room."""
        rows, columns, values, limits = [], [], [], []
        start = self.problem.starts[i]
        count = 0
        for step in range(self.steps):
            normals, offsets = places[min(step, len(places) - 1)]
            k = np.arange(count, count + len(offsets))
            base = i * self.block + step
            rows += [k, k, k]
            columns += [
                np.full(len(k), base),
                np.full(len(k), base + self.steps),
                np.full(len(k), self._rooms(i)[1]),
            ]
            values += [normals[:, 0], normals[:, 1], np.ones(len(k))]
            limits.append(offsets - normals @ start)
            count += len(k)
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        self.linear.append(sp.csr_matrix(entries, (count, self.width)))
        self.limits.append(np.concatenate(limits))

    def visit(self, i: int, visits: Sequence[tuple[int, int]]) -> None:
        """Be within an ROI's disc at a step, with room."""
        radius = self.problem.config.roi_radius
        for step, j in visits:
            base = i * self.block + step - 1
            columns = [self._rooms(i)[0], base, base + self.steps]
            rows = sp.csr_matrix(([1.0, -1.0, -1.0], ([0, 1, 2], columns)), (3, self.width))
            self.cones.append(rows)
            offset = self.problem.starts[i] - self.problem.rois[j]
            self.cone_limits.append(np.array([radius, *offset]))

    def separate(self, separations: Sequence[Separation]) -> None:
        """Keep pairs of robots apart, at a price where that is impossible."""
        self.shortfalls = count = len(separations)
        if not count:
            return
        rows, columns, values, limits = [], [], [], []
        least = self.problem.config.safety_distance + PAIR_ROOM
        for k, pair in enumerate(separations):
            normal = np.array(pair.normal)
            for robot, sign in ((pair.i, -1.0), (pair.j, 1.0)):
                base = robot * self.block + pair.step - 1
                rows += [k, k]
                columns += [base, base + self.steps]
                values += [sign * normal[0], sign * normal[1]]
            rows.append(k)
            columns.append(self.width + k)
            values.append(-1.0)
            apart = self.problem.starts[pair.i] - self.problem.starts[pair.j]
            limits.append(normal @ apart - least)
        total = self.width + count
        self.linear.append(sp.csr_matrix((values, (rows, columns)), (count, total)))
        self.limits.append(np.array(limits))
        none = sp.csr_matrix(
            (-np.ones(count), (np.arange(count), np.arange(self.width, total))), (count, total)
        )
        self.linear.append(none)
        self.limits.append(np.zeros(count))

    def solve(self) -> Floats | None:
        """The optimum, or ``None``."""
        total = self.width + self.shortfalls
        matrices = [_widen(rows, total) for rows in self.linear + self.cones]
        limits = np.concatenate(self.limits + self.cone_limits)
        lines = sum(len(one) for one in self.limits)
        kinds = [clarabel.NonnegativeConeT(lines)]
        kinds += [clarabel.SecondOrderConeT(3)] * len(self.cones)
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        square, linear = self._cost(total)
        solver = clarabel.DefaultSolver(
            square, linear, sp.vstack(matrices, format="csc"), limits, kinds, settings
        )
        solution = solver.solve()
        solved = ("Solved", "AlmostSolved", "InsufficientProgress", "MaxIterations")
        if str(solution.status) not in solved:
            return None
        x = np.array(solution.x)
        return x if np.all(np.isfinite(x)) else None

    def motion(self, x: Floats) -> Motion:
        """The solution as paths and actions."""
        problem, n, steps = self.problem, self.problem.n, self.steps
        offsets = x[: self.rooms].reshape(n, 2, steps).transpose(0, 2, 1)
        changes = np.stack([self.change @ x[self._span(i)] for i in range(n)])
        forces = changes.reshape(n, 2, steps) / problem.config.tau - problem.wind[:, None]
        actions = forces / problem.forces[:, :, None]
        rooms = x[self.rooms : self.width]
        missing = max(0.0, -float(rooms.min()), float(x[self.width :].max(initial=0.0)))
        return Motion(
            paths=problem.starts[:, None] + offsets,
            actions=np.clip(actions.transpose(2, 0, 1), -1.0, 1.0).astype(np.float32),
            missing=missing,
        )

    def _cost(self, total: int) -> tuple[Sparse, Floats]:
        """Effort about a small random drift, and the prices."""
        problem = self.problem
        random = np.random.default_rng(0)
        blocks, linear = [], np.zeros(total)
        for i in range(problem.n):
            scale = 1.0 / (np.repeat(problem.forces[i], self.steps) * problem.config.tau)
            push = np.repeat(problem.wind, self.steps) * problem.config.tau
            scaled = sp.diags(scale) @ self.change
            wanted = random.uniform(-DRIFT, DRIFT, self.block) + push * scale
            blocks.append(EFFORT * 2.0 * (scaled.T @ scaled))
            linear[self._span(i)] = -EFFORT * 2.0 * (scaled.T @ wanted)
        rest = total - self.rooms
        square = sp.block_diag([*blocks, sp.csc_matrix((rest, rest))], format="csc")
        linear[self.rooms : self.width] = -PRICE
        linear[self.width :] = PRICE
        return sp.triu(square, format="csc"), linear

    def _add(self, i: int, rows: Sparse, limits: Floats) -> None:
        self.linear.append(_shift(rows, i * self.block, self.width))
        self.limits.append(limits)

    def _rooms(self, i: int) -> list[int]:
        """The columns of robot i's room in discs and in the field."""
        return [self.rooms + 2 * i, self.rooms + 2 * i + 1]

    def _span(self, i: int) -> slice:
        return slice(i * self.block, (i + 1) * self.block)


@functools.lru_cache(maxsize=8)
def _differences(steps: int) -> tuple[Sparse, Sparse]:
    """First and second differences of offsets from rest at 0, for both axes, (2T, 2T)."""
    one: Sparse = sp.eye_array(steps, format="csr") - sp.eye_array(steps, k=-1, format="csr")
    return sp.block_diag([one, one], format="csr"), sp.block_diag([one @ one] * 2, format="csr")


def _shift(rows: Sparse, first: int, width: int) -> Sparse:
    csr = rows.tocsr()
    return sp.csr_matrix((csr.data, csr.indices + first, csr.indptr), (csr.shape[0], width))


def _widen(rows: Sparse, width: int) -> Sparse:
    return sp.csr_matrix((rows.data, rows.indices, rows.indptr), (rows.shape[0], width))
