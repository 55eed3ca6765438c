"""The motions of all robots for given steps of the visits: a convex program.

The robots spend the least effort and keep some room to discs, walls and each other where they can.
Every constraint but the dynamics has a priced shortfall, so that there is always a solution for
the next linearisation to start from.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import clarabel
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from mbn_marl.planning.problem import Floats, Problem

DISC_ROOM, FIELD_ROOM, PAIR_ROOM = 0.05, 0.02, 0.05
"""Room that the program pays for, in units; rounding needs a hundredth of it."""
EFFORT = 1e-3
PRICE = 100.0
"""Price of a unit of missing room; effort is priced per squared full force and step."""
DRIFT = 0.03
"""Share of the force with which idle robots drift, since standing still costs a revisit."""

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


def solve_motion(
    problem: Problem,
    steps: int,
    visits: Sequence[Sequence[tuple[int, int]]],
    places: Sequence[Sequence[HalfPlanes]],
    separations: Sequence[Separation],
) -> tuple[Floats, NDArray[np.float32]] | None:
    """Return the motions of least effort in ``steps`` steps, or ``None`` if the solver failed.

    They are (n, T, 2), the positions after each step, units, and (T, n, 2), actions in [-1, 1].
    ``visits`` has for each robot pairs of a step (1 to T) and the ROI to visit then; ``places`` has
    for each robot and step the convex set to be in; a single set is for all steps.
    """
    program = _ConicProgram(problem, steps, len(separations))
    for i in range(problem.n):
        program.drive(i)
        program.stay(i, places[i])
        program.visit(i, visits[i])
    program.separate(separations)
    solution = program.solve()
    return None if solution is None else program.motion(solution)


class _ConicProgram:
    """Collects rows ``A x + s = b``; the columns are the robots' offsets, rooms, shortfalls."""

    def __init__(self, problem: Problem, steps: int, shortfalls: int) -> None:
        self.problem, self.steps = problem, steps
        self.block = 2 * steps
        self.rooms = problem.n * self.block
        self.shortfalls = self.rooms + 2 * problem.n
        self.width = self.shortfalls + shortfalls
        self.linear: list[Sparse] = []
        self.limits: list[Floats] = []
        self.cones: list[Sparse] = []
        self.cone_limits: list[Floats] = []
        self.speed, self.change = _differences(steps)

    def drive(self, i: int) -> None:
        """Limit velocity, force and rooms.

        A wind that is stronger than the force leaves a robot at the speed limit at its speed.
        """
        problem, tau = self.problem, self.problem.config.tau
        top = np.full(self.block, problem.drives[i].top * tau)
        force = np.repeat(problem.forces[i], self.steps) * tau
        push = np.repeat(problem.wind, self.steps) * tau
        first = self._first_change(i)
        for rows, limits in (
            (self.speed, top),
            (-self.speed, top),
            (self.change, np.maximum(force + push, 0.0) + first),
            (-self.change, np.maximum(force - push, 0.0) - first),
        ):
            self.linear.append(_shift(rows, i * self.block, self.width))
            self.limits.append(limits)
        self._append([[0, 1]], [self._rooms(i)], [[1.0, 1.0]], [DISC_ROOM, FIELD_ROOM])

    def stay(self, i: int, places: Sequence[HalfPlanes]) -> None:
        """Keep robot i in its places after every step, with room."""
        if len(places) == 1:
            places = [*places] * self.steps
        normals, offsets = (np.concatenate(parts) for parts in zip(*places, strict=True))
        steps = np.repeat(np.arange(self.steps), [len(limits) for _, limits in places])
        rows, base = np.arange(len(steps)), i * self.block + steps
        columns = [base, base + self.steps, np.full(len(base), self._rooms(i)[1])]
        limits = offsets - normals @ self.problem.starts[i]
        self._append([rows] * 3, columns, [*normals.T, np.ones(len(base))], limits)

    def visit(self, i: int, visits: Sequence[tuple[int, int]]) -> None:
        """Keep robot i within an ROI's disc at the step of each visit, with room."""
        radius = self.problem.config.roi_radius
        for step, j in visits:
            base = i * self.block + step - 1
            columns = [self._rooms(i)[0], base, base + self.steps]
            rows = sp.csr_matrix(([1.0, -1.0, -1.0], ([0, 1, 2], columns)), (3, self.width))
            self.cones.append(rows)
            offset = self.problem.starts[i] - self.problem.rois[j]
            self.cone_limits.append(np.array([radius, *offset]))

    def separate(self, separations: Sequence[Separation]) -> None:
        """Keep pairs of robots apart, at a price for each shortfall."""
        count = len(separations)
        if not count:
            return
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

    def solve(self) -> Floats | None:
        """Return the optimum, or ``None`` if the solver failed."""
        limits = np.concatenate(self.limits + self.cone_limits)
        lines = sum(len(one) for one in self.limits)
        kinds = [clarabel.NonnegativeConeT(lines)]
        kinds += [clarabel.SecondOrderConeT(3)] * len(self.cones)
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        rows = sp.vstack(self.linear + self.cones, format="csc")
        solver = clarabel.DefaultSolver(*self._cost(), rows, limits, kinds, settings)
        solution = solver.solve()
        solved = ("Solved", "AlmostSolved", "InsufficientProgress", "MaxIterations")
        if str(solution.status) not in solved:
            return None
        x = np.array(solution.x)
        return x if np.all(np.isfinite(x)) else None

    def motion(self, x: Floats) -> tuple[Floats, NDArray[np.float32]]:
        """Return the solution as paths and actions."""
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
        """Return (2T,): what robot i's velocity at the start adds to the second differences."""
        first = np.zeros((2, self.steps))
        first[:, 0] = self.problem.velocities[i] * self.problem.config.tau
        return first.ravel()

    def _append(self, rows: Parts, columns: Parts, values: Parts, limits: ArrayLike) -> None:
        """Add linear rows, given by the parts of their entries."""
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        self.limits.append(np.asarray(limits))
        self.linear.append(sp.csr_matrix(entries, (len(self.limits[-1]), self.width)))

    def _rooms(self, i: int) -> list[int]:
        """Return the columns of robot i's room in discs and in the field."""
        return [self.rooms + 2 * i, self.rooms + 2 * i + 1]

    def _span(self, i: int) -> slice:
        return slice(i * self.block, (i + 1) * self.block)


@functools.lru_cache(maxsize=8)
def _differences(steps: int) -> tuple[Sparse, Sparse]:
    """Return first and second differences (2T, 2T) of both axes' offsets from rest at 0."""
    one: Sparse = sp.eye_array(steps, format="csr") - sp.eye_array(steps, k=-1, format="csr")
    return sp.block_diag([one, one], format="csr"), sp.block_diag([one @ one] * 2, format="csr")


def _shift(rows: Sparse, first: int, width: int) -> Sparse:
    csr = rows.tocsr()
    return sp.csr_matrix((csr.data, csr.indices + first, csr.indptr), (csr.shape[0], width))
