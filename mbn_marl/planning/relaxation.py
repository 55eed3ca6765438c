"""The linear program of one robot that passes stops in a given order, and its safe dual bound.

Each axis is a double integrator. In L steps from velocity v to velocity v' it moves by at most
``tau * sum_{s=1..L} min(top, v + rise s, v' + fall (L - s))``, and by anything down to the mirror
image of that. So for all integers ``a, b >= 0`` with ``a + b <= L`` the displacement is at most

    tau * (a v + b v' + rise a (a+1) / 2 + fall b (b-1) / 2 + top (L - a - b)),

which is linear in v, v' **and L**, and with all such a, b exactly the maximum. Positions,
velocities and times at the stops are therefore the variables of a small linear program whose cuts
hold as long as ``a + b`` is at most the least length of the leg, and which is exact once the times
are fixed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import highspy
import numpy as np

from mbn_marl.planning.problem import Drive, Floats

PER_STOP = 5
X, VX, TIME = 0, 2, 4
"""Columns of a stop: x, y, vx, vy, t. The last column of all is the inflation of the discs."""
OFF = 1e-5
"""A cut is added where it is broken by more than this, in units."""
FIRST_TANGENTS = 8
MOST_ROUNDS = 60


@dataclass(frozen=True, eq=False)
class Region:
    """A bounded convex set of the plane, ``normals @ p <= offsets``.

    Attributes:
        normals: (k, 2) unit vectors.
        offsets: (k,), units.
        low: (2,), the least coordinates in the set or below.
        high: (2,), the greatest or above.
    """

    normals: Floats
    offsets: Floats
    low: tuple[float, float]
    high: tuple[float, float]


@dataclass(frozen=True)
class Disc:
    """What a robot has to be within: a disc, or with radius ``None`` just the region."""

    centre: tuple[float, float]
    radius: float | None


@dataclass(frozen=True)
class Windows:
    """When the stops may be, in steps: leg k leads from stop k - 1, or from step 0, to stop k.

    Attributes:
        first: the earliest step of each stop.
        last: the latest.
        least: the fewest steps of each leg.
        most: the most.
    """

    first: tuple[int, ...]
    last: tuple[int, ...]
    least: tuple[int, ...]
    most: tuple[int, ...]

    @property
    def fixed(self) -> bool:
        """Whether nothing is left to choose."""
        return self.least == self.most

    def tightened(self) -> Windows | None:
        """The windows as narrow as they make each other; ``None`` if there is no choice left."""
        first, last = list(self.first), list(self.last)
        before = 0
        for k, least in enumerate(self.least):
            before = first[k] = max(first[k], before + least)
        for k in range(len(last) - 2, -1, -1):
            last[k] = min(last[k], last[k + 1] - self.least[k + 1])
        before = 0
        for k, most in enumerate(self.most):
            before = last[k] = min(last[k], before + most)
        if any(one > other for one, other in zip(first, last, strict=True)):
            return None
        ends, starts = [0, *last], [0, *first]
        fewest = tuple(max(a, f - e) for a, f, e in zip(self.least, first, ends, strict=False))
        longest = tuple(min(b, e - f) for b, e, f in zip(self.most, last, starts, strict=False))
        if any(one > other for one, other in zip(fewest, longest, strict=True)):
            return None
        return Windows(tuple(first), tuple(last), fewest, longest)

    def split(self, leg: int, least: int) -> tuple[Windows, Windows]:
        """The choices with fewer than ``least`` steps in a leg, and those with as many or more."""
        fewer = (*self.most[:leg], least - 1, *self.most[leg + 1 :])
        more = (*self.least[:leg], least, *self.least[leg + 1 :])
        return replace(self, most=fewer), replace(self, least=more)


def at_steps(steps: Sequence[int]) -> Windows:
    """Windows with no choice."""
    chosen = tuple(steps)
    legs = tuple(b - a for a, b in zip((0, *chosen), chosen, strict=False))
    return Windows(chosen, chosen, legs, legs)


@dataclass(frozen=True)
class Cut:
    """A row ``coefficients @ x <= limit``, which holds wherever it has been found, and deeper."""

    columns: tuple[int, ...]
    values: tuple[float, ...]
    limit: float


@dataclass(frozen=True, eq=False)
class Solved:
    """The optimum of a relaxation.

    Attributes:
        bound: a proved lower bound of the least inflation of the discs, units.
        inflation: the least inflation found.
        points: (k, 5): x, y, vx, vy and time at the stops.
        cuts: those that bind.
    """

    bound: float
    inflation: float
    points: Floats
    cuts: list[Cut]


@dataclass(frozen=True, eq=False)
class Relaxation:
    """One robot's linear program.

    Attributes:
        start: where the robot rests at step 0.
        drive: what moves it.
        region: the convex set that holds every stop.
        discs: of the stops, in order.
    """

    start: tuple[float, float]
    drive: Drive
    region: Region
    discs: tuple[Disc, ...]

    def with_via(self, place: int) -> Relaxation:
        """With one more stop, anywhere in the region, before the stop ``place``."""
        via = Disc(self.start, None)
        return replace(self, discs=(*self.discs[:place], via, *self.discs[place:]))

    def tangents(self) -> list[Cut]:
        """A few tangents of every disc, to begin with."""
        angles = [2.0 * math.pi * turn / FIRST_TANGENTS for turn in range(FIRST_TANGENTS)]
        return [
            self._tangent(k, math.cos(angle), math.sin(angle))
            for k, disc in enumerate(self.discs)
            if disc.radius is not None
            for angle in angles
        ]

    # -- the linear program ------------------------------------------------------------------------

    def solve(
        self, highs: highspy.Highs, windows: Windows, cuts: list[Cut], enough: float
    ) -> Solved:
        """The least inflation of the discs, or a proof that it is more than ``enough``.

        Args:
            highs: the solver.
            windows: when the stops may be.
            cuts: cuts to begin with: tangents, or what wider windows left.
            enough: stop as soon as the bound exceeds this.
        """
        rows = self._rows(windows)
        fixed = len(rows)
        program = _Program(highs, self._columns(windows), rows + cuts)
        for _ in range(MOST_ROUNDS):
            solution, bound = program.run()
            points = solution[:-1].reshape(-1, PER_STOP)
            if bound > enough:
                break
            fresh = self._broken(points, float(solution[-1]), windows)
            if not fresh:
                break
            program.add(fresh)
        return Solved(bound, float(solution[-1]), points, program.binding(fixed))

    def excess(self, points: Floats, lengths: Sequence[int]) -> Floats:
        """(k,): by how much a solution moves too far, in each leg, if that had ``lengths``."""
        before = np.array([*self.start, 0.0, 0.0, 0.0])
        far = np.zeros(len(points))
        for k, (now, length) in enumerate(zip(points, lengths, strict=True)):
            for axis in (0, 1):
                v, w = before[VX + axis], now[VX + axis]
                least, most = velocities(self.drive, axis, length, v, w)
                moved = (now[axis] - before[axis]) / self.drive.tau
                far[k] += max(moved - most.sum(), least.sum() - moved, 0.0)
                far[k] += max(w - v - self.drive.rise[axis] * length, 0.0)
                far[k] += max(v - w - self.drive.fall[axis] * length, 0.0)
            before = now
        return far

    def _columns(self, windows: Windows) -> tuple[Floats, Floats]:
        """Bounds of the columns."""
        region = self.region
        low: list[float] = []
        high: list[float] = []
        for first, last in zip(windows.first, windows.last, strict=True):
            slowest = [-self._top(axis, -1.0, last) for axis in (0, 1)]
            fastest = [self._top(axis, 1.0, last) for axis in (0, 1)]
            low += [*region.low, *slowest, first]
            high += [*region.high, *fastest, last]
        radii = [disc.radius for disc in self.discs if disc.radius is not None]
        most = math.dist(region.low, region.high)
        return np.array([*low, -min(radii, default=0.0)]), np.array([*high, most])

    def _top(self, axis: int, sign: float, step: int) -> float:
        """The highest speed by a step, from rest at step 0."""
        rate = (self.drive.rise if sign > 0 else self.drive.fall)[axis]
        return min(self.drive.top, rate * step)

    def _rows(self, windows: Windows) -> list[Cut]:
        """What holds from the beginning: time, velocities, the field, the plainest cuts."""
        rows = []
        for k, disc in enumerate(self.discs):
            base, before = PER_STOP * k, PER_STOP * (k - 1)
            if k:
                times = (before + TIME, base + TIME)
                rows.append(Cut(times, (1.0, -1.0), float(-windows.least[k])))
                rows.append(Cut(times, (-1.0, 1.0), float(windows.most[k])))
            for axis in (0, 1):
                for sign in (1.0, -1.0):
                    rate = (self.drive.rise if sign > 0 else self.drive.fall)[axis]
                    columns, values = [base + VX + axis, base + TIME], [sign, -rate]
                    if k:
                        columns += [before + VX + axis, before + TIME]
                        values += [-sign, rate]
                    rows.append(Cut(tuple(columns), tuple(values), 0.0))
                    for a, b in _first_pairs(windows.least[k]):
                        rows.append(self._reach(k, axis, sign, a, b, windows.last[k]))
            for normal, offset in zip(self.region.normals, self.region.offsets, strict=True):
                if disc.radius is None or normal @ disc.centre + disc.radius > offset:
                    rows.append(Cut((base, base + 1), (normal[0], normal[1]), float(offset)))
        return rows

    def _tangent(self, k: int, gx: float, gy: float) -> Cut:
        """The disc of stop k lies behind its tangent in the direction (gx, gy)."""
        (cx, cy), radius = self.discs[k].centre, self.discs[k].radius
        assert radius is not None
        base = PER_STOP * k
        columns = (base, base + 1, PER_STOP * len(self.discs))
        return Cut(columns, (gx, gy, -1.0), gx * cx + gy * cy + radius)

    def _reach(self, k: int, axis: int, sign: float, a: int, b: int, last: int) -> Cut:
        """The displacement of leg k, in the direction ``sign``, is at most that of the pair."""
        top, tau = self._top(axis, sign, last), self.drive.tau
        rise, fall = self.drive.rise[axis], self.drive.fall[axis]
        if sign < 0:
            rise, fall = fall, rise
        base, before = PER_STOP * k, PER_STOP * (k - 1)
        columns = [base + axis, base + VX + axis, base + TIME]
        values = [sign / tau, -sign * b, -top]
        limit = rise * a * (a + 1) / 2.0 + fall * b * (b - 1) / 2.0 - top * (a + b)
        if k:
            columns += [before + axis, before + VX + axis, before + TIME]
            values += [-sign / tau, -sign * a, top]
        else:
            limit += sign * self.start[axis] / tau
        return Cut(tuple(columns), tuple(values), limit)

    # -- separation --------------------------------------------------------------------------------

    def _broken(self, points: Floats, inflation: float, windows: Windows) -> list[Cut]:
        """The cuts that a solution breaks."""
        fresh = []
        rows = points.tolist()
        before = [*self.start, 0.0, 0.0, 0.0]
        for k, (disc, now) in enumerate(zip(self.discs, rows, strict=True)):
            if disc.radius is not None:
                dx, dy = now[0] - disc.centre[0], now[1] - disc.centre[1]
                distance = math.hypot(dx, dy)
                if distance > disc.radius + inflation + OFF:
                    fresh.append(self._tangent(k, dx / distance, dy / distance))
            for axis in (0, 1):
                for sign in (1.0, -1.0):
                    pair = self._broken_pair(axis, sign, before, now, windows, k)
                    if pair is not None:
                        fresh.append(self._reach(k, axis, sign, *pair, windows.last[k]))
            before = now
        return fresh

    def _broken_pair(
        self, axis: int, sign: float, before: list[float], now: list[float], w: Windows, k: int
    ) -> tuple[int, int] | None:
        """The pair whose cut a leg breaks the most, or ``None``."""
        rise, fall = self.drive.rise[axis], self.drive.fall[axis]
        if sign < 0:
            rise, fall = fall, rise
        top = self._top(axis, sign, w.last[k])
        v, u = sign * before[VX + axis], sign * now[VX + axis]
        a, b = _tightest(v, u, rise, fall, top, w.least[k])
        ramps = rise * a * (a + 1) / 2.0 + fall * b * (b - 1) / 2.0
        most = a * v + b * u + ramps + top * (now[TIME] - before[TIME] - a - b)
        moved = sign * (now[axis] - before[axis])
        return (a, b) if moved > self.drive.tau * most + OFF else None


def velocities(drive: Drive, axis: int, length: int, v: float, w: float) -> tuple[Floats, Floats]:
    """The lowest and the highest velocities after each step of a leg from velocity v to w."""
    s = np.arange(1, length + 1)
    rise, fall, top = drive.rise[axis], drive.fall[axis], drive.top
    most = np.minimum(np.minimum(v + rise * s, w + fall * (length - s)), top)
    least = np.maximum(np.maximum(v - fall * s, w - rise * (length - s)), -top)
    return least, most


def _first_pairs(least: int) -> set[tuple[int, int]]:
    half = least // 2
    return {(0, 0), (least, 0), (least - half, half)}


def _tightest(v: float, w: float, rise: float, fall: float, top: float, n: int) -> tuple[int, int]:
    """The pair (a, b), ``a + b <= n``, whose cut is the tightest at the velocities v and w."""
    a = n if rise <= 0.0 else min(max(math.ceil((top - v) / rise) - 1, 0), n)
    b = n if fall <= 0.0 else min(max(math.ceil((top - w) / fall), 0), n)
    if a + b > n:
        both = rise + fall
        even = math.floor((w - v + fall * n) / both) if both > 0.0 else a
        a = min(max(even, n - b, 0), a)
        b = n - a
    return a, b


class _Program:
    """A linear program ``min inflation`` in HiGHS, rows added as they are found."""

    def __init__(
        self, highs: highspy.Highs, bounds: tuple[Floats, Floats], rows: list[Cut]
    ) -> None:
        self.highs, self.rows = highs, rows
        self.low, self.high = bounds
        width = len(self.low)
        self.cost = np.zeros(width)
        self.cost[-1] = 1.0
        program = highspy.HighsLp()
        program.num_col_, program.num_row_ = width, len(rows)
        program.col_cost_, program.col_lower_, program.col_upper_ = self.cost, self.low, self.high
        self.matrix = _Matrix(rows)
        program.row_lower_ = np.full(len(rows), -highspy.kHighsInf)
        program.row_upper_ = self.matrix.limits
        program.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
        program.a_matrix_.start_ = np.append(self.matrix.start, len(self.matrix.index))
        program.a_matrix_.index_, program.a_matrix_.value_ = self.matrix.index, self.matrix.value
        highs.passModel(program)

    def add(self, rows: list[Cut]) -> None:
        """Add rows."""
        self.rows = self.rows + rows
        fresh = _Matrix(rows)
        low = np.full(len(rows), -highspy.kHighsInf)
        self.highs.addRows(
            len(rows), low, fresh.limits, len(fresh.index), fresh.start, fresh.index, fresh.value
        )
        self.matrix = self.matrix.above(fresh)

    def run(self) -> tuple[Floats, float]:
        """The solution, and a lower bound of the optimum that holds whatever the solver did.

        Any multipliers ``y <= 0`` of the rows give a bound: the optimum is at least
        ``limits @ y`` plus the least of ``(cost - y A) x`` over the columns' bounds.
        """
        self.highs.run()
        solution = self.highs.getSolution()
        self.y = y = np.minimum(np.array(solution.row_dual), 0.0)
        rest = self.cost - self.matrix.weighted(y, len(self.cost))
        bound = self.matrix.limits @ y + np.minimum(rest * self.low, rest * self.high).sum()
        return np.array(solution.col_value), float(bound)

    def binding(self, first: int) -> list[Cut]:
        """The rows from ``first`` on that hold the optimum."""
        return [self.rows[k] for k in np.flatnonzero(self.y[first:]) + first]


class _Matrix:
    """Rows as HiGHS takes them."""

    def __init__(self, rows: list[Cut]) -> None:
        lengths = [len(cut.columns) for cut in rows]
        self.start = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int32)
        self.row = np.repeat(np.arange(len(rows)), lengths)
        self.index = np.array([column for cut in rows for column in cut.columns], np.int32)
        self.value = np.array([value for cut in rows for value in cut.values])
        self.limits = np.array([cut.limit for cut in rows])

    def above(self, other: _Matrix) -> _Matrix:
        """Both, the other's rows below."""
        both = _Matrix([])
        both.row = np.concatenate([self.row, other.row + len(self.limits)])
        both.index = np.concatenate([self.index, other.index])
        both.value = np.concatenate([self.value, other.value])
        both.limits = np.concatenate([self.limits, other.limits])
        return both

    def weighted(self, weights: Floats, width: int) -> Floats:
        """The sum of the rows, weighted."""
        return np.asarray(np.bincount(self.index, weights[self.row] * self.value, width), float)


def make_solver() -> highspy.Highs:
    """A quiet simplex solver on one thread."""
    highs = highspy.Highs()  # type: ignore[no-untyped-call]
    for name, value in (
        ("output_flag", False),
        ("presolve", "off"),
        ("solver", "simplex"),
        ("threads", 1),
    ):
        highs.setOptionValue(name, value)
    return highs
