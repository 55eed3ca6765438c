"""The linear program of one robot that passes stops in a given order, and its safe dual bound.

Each axis is a double integrator. In L steps from velocity v to velocity v' it moves by at most
``tau * sum_{s=1..L} min(top, v + rise s, v' + fall (L - s))``, and by anything down to the mirror
image of that. So for all integers ``a, b >= 0`` with ``a + b <= L`` the displacement is at most

    tau * (a v + b v' + rise a (a+1) / 2 + fall b (b-1) / 2 + top (L - a - b)),

which is linear in v, v' **and L**, and with all such a, b exactly the maximum. Positions, velocities
and times at the stops are therefore the variables of a small linear program whose cuts hold as long
as ``a + b`` is at most the least length of the leg, and which is exact once the times are fixed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import highspy
import numpy as np
from numpy.typing import NDArray

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
class Stop:
    """Where a robot has to be at some step of a window.

    Attributes:
        centre: of the disc, units.
        radius: of the disc; ``None`` for a stop that only has to lie in the field.
        first: the earliest step.
        last: the latest step.
        gap: the least number of steps since the stop before, or since step 0.
    """

    centre: tuple[float, float]
    radius: float | None
    first: int
    last: int
    gap: int = 0


@dataclass(frozen=True)
class Solved:
    """The optimum of a relaxation.

    Attributes:
        bound: a proved lower bound of the least inflation of the discs, units.
        inflation: the least inflation found.
        points: (k, 5): x, y, vx, vy and time at the stops.
    """

    bound: float
    inflation: float
    points: Floats


@dataclass(frozen=True)
class Cut:
    """A row ``coefficients @ x <= limit`` that holds while leg ``leg`` has ``least`` steps."""

    columns: tuple[int, ...]
    values: tuple[float, ...]
    limit: float
    leg: int = 0
    least: int = 0


@dataclass
class Relaxation:
    """One robot's linear program, with the cuts that have been found so far.

    Attributes:
        start: where the robot rests at step 0.
        drive: what moves it.
        region: the convex set that holds every stop.
        stops: in order, with their windows.
        cuts: every cut found so far.
    """

    start: tuple[float, float]
    drive: Drive
    region: Region
    stops: tuple[Stop, ...]
    cuts: list[Cut] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Begin with a few tangents of every disc."""
        if not self.cuts:
            for k, stop in enumerate(self.stops):
                if stop.radius is not None:
                    for turn in range(FIRST_TANGENTS):
                        angle = 2.0 * math.pi * turn / FIRST_TANGENTS
                        self.cuts.append(self._tangent(k, math.cos(angle), math.sin(angle)))

    def within(self, windows: list[tuple[int, int]]) -> Relaxation:
        """The same program, its cuts shared, with other windows."""
        stops = tuple(
            replace(stop, first=first, last=last)
            for stop, (first, last) in zip(self.stops, windows, strict=True)
        )
        return replace(self, stops=stops)

    def with_via(self, step: int) -> Relaxation:
        """With one more stop, anywhere in the field, at ``step``; all times are fixed already."""
        fixed = (replace(stop, gap=0) for stop in self.stops)
        stops = sorted(
            (*fixed, Stop(self.start, None, step, step)), key=lambda stop: stop.first
        )
        return Relaxation(self.start, self.drive, self.region, tuple(stops))

    # -- the linear program ------------------------------------------------------------------------

    def solve(self, highs: highspy.Highs, enough: float) -> Solved:
        """The least inflation of the discs, or a proof that it is more than ``enough``."""
        least = [self._least(k) for k in range(len(self.stops))]
        valid = [cut for cut in self.cuts if cut.least <= least[cut.leg]]
        rows = self._rows(least) + valid
        program = _Program(highs, self._columns(), rows)
        for _ in range(MOST_ROUNDS):
            solution, bound = program.run()
            points = solution[:-1].reshape(-1, PER_STOP)
            if bound > enough:
                break
            fresh = self._broken(points, float(solution[-1]), least)
            if not fresh:
                break
            self.cuts.extend(fresh)
            program.add(fresh)
        return Solved(bound, float(solution[-1]), points)

    def _least(self, k: int) -> int:
        """The fewest steps that leg k can have."""
        before = self.stops[k - 1].last if k else 0
        return max(self.stops[k].first - before, self.stops[k].gap)

    def _columns(self) -> tuple[Floats, Floats]:
        """Bounds of the columns."""
        top, region = self.drive.top, self.region
        low: list[float] = []
        high: list[float] = []
        for stop in self.stops:
            low += [*region.low, -top, -top, stop.first]
            high += [*region.high, top, top, stop.last]
        radii = [stop.radius for stop in self.stops if stop.radius is not None]
        most = math.dist(region.low, region.high)
        return np.array([*low, -min(radii, default=0.0)]), np.array([*high, most])

    def _rows(self, least: list[int]) -> list[Cut]:
        """What holds from the beginning: time, velocities, the field, the plainest cuts."""
        rows = []
        for k, stop in enumerate(self.stops):
            base, before = PER_STOP * k, PER_STOP * (k - 1)
            if k:
                rows.append(Cut((before + TIME, base + TIME), (1.0, -1.0), float(-least[k])))
            for axis in (0, 1):
                for sign in (1.0, -1.0):
                    rate = (self.drive.rise if sign > 0 else self.drive.fall)[axis]
                    if k:
                        columns = (
                            base + VX + axis, before + VX + axis, base + TIME, before + TIME,
                        )  # fmt: skip
                        rows.append(Cut(columns, (sign, -sign, -rate, rate), 0.0))
                    else:
                        rows.append(Cut((base + VX + axis, base + TIME), (sign, -rate), 0.0))
                    for a, b in _first_pairs(least[k]):
                        rows.append(self._reach(k, axis, sign, a, b))
            for normal, offset in zip(self.region.normals, self.region.offsets, strict=True):
                reach = stop.radius
                if reach is None or normal @ stop.centre + reach > offset:
                    rows.append(Cut((base, base + 1), (normal[0], normal[1]), float(offset)))
        return rows

    def _tangent(self, k: int, gx: float, gy: float) -> Cut:
        """The disc of stop k lies behind its tangent in the direction (gx, gy)."""
        (cx, cy), radius = self.stops[k].centre, self.stops[k].radius
        assert radius is not None
        base = PER_STOP * k
        columns = (base, base + 1, PER_STOP * len(self.stops))
        return Cut(columns, (gx, gy, -1.0), gx * cx + gy * cy + radius)

    def _reach(self, k: int, axis: int, sign: float, a: int, b: int) -> Cut:
        """The displacement of leg k, in the direction ``sign``, is at most that of the pair."""
        top, tau = self.drive.top, self.drive.tau
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
        return Cut(tuple(columns), tuple(values), limit, k, a + b)

    # -- separation --------------------------------------------------------------------------------

    def _broken(self, points: Floats, inflation: float, least: list[int]) -> list[Cut]:
        """The cuts that a solution breaks."""
        fresh = []
        rows = points.tolist()
        before = (*self.start, 0.0, 0.0, 0.0)
        top, tau = self.drive.top, self.drive.tau
        for k, (stop, now) in enumerate(zip(self.stops, rows, strict=True)):
            if stop.radius is not None:
                dx, dy = now[0] - stop.centre[0], now[1] - stop.centre[1]
                distance = math.hypot(dx, dy)
                if distance > stop.radius + inflation + OFF:
                    fresh.append(self._tangent(k, dx / distance, dy / distance))
            length = now[TIME] - before[TIME]
            for axis in (0, 1):
                for sign in (1.0, -1.0):
                    rise, fall = self.drive.rise[axis], self.drive.fall[axis]
                    if sign < 0:
                        rise, fall = fall, rise
                    v, w = sign * before[VX + axis], sign * now[VX + axis]
                    a, b = _tightest(v, w, rise, fall, top, least[k])
                    most = (
                        a * v + b * w + rise * a * (a + 1) / 2.0 + fall * b * (b - 1) / 2.0
                        + top * (length - a - b)
                    )  # fmt: skip
                    if sign * (now[axis] - before[axis]) / tau > most + OFF / tau:
                        fresh.append(self._reach(k, axis, sign, a, b))
            before = now
        return fresh


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
        self.highs = highs
        self.low, self.high = bounds
        self.width = len(self.low)
        self.matrix, self.limits = _dense(rows, self.width)
        program = highspy.HighsLp()
        program.num_col_, program.num_row_ = self.width, len(rows)
        self.cost = np.zeros(self.width)
        self.cost[-1] = 1.0
        program.col_cost_, program.col_lower_, program.col_upper_ = self.cost, self.low, self.high
        program.row_lower_ = np.full(len(rows), -highspy.kHighsInf)
        program.row_upper_ = self.limits
        start, index, value = _sparse(rows)
        program.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
        program.a_matrix_.start_ = np.append(start, len(index)).astype(np.int32)
        program.a_matrix_.index_, program.a_matrix_.value_ = index, value
        highs.passModel(program)

    def add(self, rows: list[Cut]) -> None:
        """Add rows."""
        matrix, limits = _dense(rows, self.width)
        self.matrix = np.concatenate([self.matrix, matrix])
        self.limits = np.concatenate([self.limits, limits])
        start, index, value = _sparse(rows)
        low = np.full(len(rows), -highspy.kHighsInf)
        self.highs.addRows(len(rows), low, limits, len(index), start, index, value)

    def run(self) -> tuple[Floats, float]:
        """The solution, and a lower bound of the optimum that holds whatever the solver did.

        Any multipliers ``y <= 0`` of the rows give a bound: the optimum is at least
        ``limits @ y`` plus the least of ``(cost - y A) x`` over the columns' bounds.
        """
        self.highs.run()
        solution = self.highs.getSolution()
        y = np.minimum(np.array(solution.row_dual), 0.0)
        rest = self.cost - y @ self.matrix
        bound = self.limits @ y + np.minimum(rest * self.low, rest * self.high).sum()
        return np.array(solution.col_value), float(bound)


def _dense(rows: list[Cut], width: int) -> tuple[Floats, Floats]:
    matrix = np.zeros((len(rows), width))
    for row, cut in zip(matrix, rows, strict=True):
        row[list(cut.columns)] = cut.values
    return matrix, np.array([cut.limit for cut in rows])


def _sparse(
    rows: list[Cut],
) -> tuple[NDArray[np.int32], NDArray[np.int32], Floats]:
    lengths = np.array([len(cut.columns) for cut in rows])
    start = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int32)
    index = np.array([column for cut in rows for column in cut.columns], np.int32)
    return start, index, np.array([value for cut in rows for value in cut.values])


def make_solver() -> highspy.Highs:
    """A quiet simplex solver on one thread."""
    highs = highspy.Highs()
    for name, value in (
        ("output_flag", False),
        ("presolve", "off"),
        ("solver", "simplex"),
        ("threads", 1),
    ):
        highs.setOptionValue(name, value)
    return highs
