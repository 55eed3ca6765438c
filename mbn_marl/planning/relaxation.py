"""The linear program of one robot that passes stops in a given order.

Each axis is a double integrator. In L steps from velocity v to velocity v' it moves by at most
``tau * sum_{s=1..L} min(top, v + rise s, v' + fall (L - s))``, and by any distance between that
and its mirror image. So for all integers ``a, b >= 0`` with ``a + b <= L`` the displacement is at
most

    tau * (a v + b v' + rise a (a+1) / 2 + fall b (b-1) / 2 + top (L - a - b)),

which is linear in v, v' **and L**; the least of these bounds is exactly the maximum. Positions,
velocities and times at the stops are therefore the variables of a small linear program. Its cuts
hold while ``a + b`` is at most the least length of the leg, and it is exact for fixed times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import highspy
import numpy as np
import shapely

from mbn_marl.planning.linear_program import Cut, LinearProgram
from mbn_marl.planning.problem import Drive, Floats, Start, half_planes

PER_STOP = 5
X, VX, TIME = 0, 2, 4
"""Columns of a stop: x, y, vx, vy, t. The last column of the program is the discs' inflation."""
OFF = 1e-5
"""A cut is added where it is violated by more than this, in units."""
FIRST_TANGENTS = 8
MOST_ROUNDS = 60


@dataclass(frozen=True)
class StepWindows:
    """The steps that stops and legs may take; leg k ends at stop k, leg 0 begins at step 0."""

    first: tuple[int, ...]  # the earliest step of each stop
    last: tuple[int, ...]
    least: tuple[int, ...]  # the fewest steps of each leg
    most: tuple[int, ...]

    @property
    def fixed(self) -> bool:
        return self.least == self.most

    def tightened(self) -> StepWindows | None:
        """Return the windows with all mutual limits applied, ``None`` if they are empty."""
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
        return StepWindows(tuple(first), tuple(last), fewest, longest)

    def split(self, leg: int, least: int) -> tuple[StepWindows, StepWindows]:
        fewer = (*self.most[:leg], least - 1, *self.most[leg + 1 :])
        more = (*self.least[:leg], least, *self.least[leg + 1 :])
        return replace(self, most=fewer), replace(self, least=more)


def fixed_windows(steps: Sequence[int]) -> StepWindows:
    chosen = tuple(steps)
    legs = tuple(b - a for a, b in zip((0, *chosen), chosen, strict=False))
    return StepWindows(chosen, chosen, legs, legs)


@dataclass(frozen=True, eq=False)
class Region:
    """A bounded convex set of the plane, ``normals @ p <= offsets``, and bounds of coordinates."""

    normals: Floats  # (k, 2) unit vectors
    offsets: Floats  # (k,), units
    low: tuple[float, float]
    high: tuple[float, float]


def make_region(convex: shapely.Polygon, margin: float) -> Region:
    """Return a convex polygon with its edges moved outward by a margin, in units."""
    normals, offsets = half_planes(convex)
    low_x, low_y, high_x, high_y = convex.bounds
    low, high = (low_x - margin, low_y - margin), (high_x + margin, high_y + margin)
    return Region(normals, offsets + margin, low, high)


@dataclass(frozen=True, eq=False)
class Disc:
    """A stop: a disc to be in, or with radius ``None`` any place in the region, or in a part."""

    centre: tuple[float, float]
    radius: float | None
    part: Region | None = None


@dataclass(frozen=True, eq=False)
class Solved:
    """The optimum of a relaxation."""

    bound: float  # a proved lower bound of the least inflation of the discs, units
    inflation: float  # the least found
    points: Floats  # (k, 5): x, y, vx, vy and time at the stops
    cuts: list[Cut]  # the binding ones


@dataclass(frozen=True, eq=False)
class Relaxation:
    """One robot's linear program."""

    start: Start  # of the robot, at step 0
    drive: Drive
    region: Region  # contains every stop
    discs: tuple[Disc, ...]  # the stops, in order

    def with_via(self, place: int, part: Region | None) -> Relaxation:
        via = Disc(self.start[:2], None, part)
        return replace(self, discs=(*self.discs[:place], via, *self.discs[place:]))

    def tangents(self) -> list[Cut]:
        angles = [2.0 * math.pi * turn / FIRST_TANGENTS for turn in range(FIRST_TANGENTS)]
        return [
            self._tangent(k, math.cos(angle), math.sin(angle))
            for k, disc in enumerate(self.discs)
            if disc.radius is not None
            for angle in angles
        ]

    def solve(
        self, highs: highspy.Highs, windows: StepWindows, cuts: list[Cut], enough: float
    ) -> Solved:
        """Return the least inflation of the discs, or a proof that it is more than ``enough``.

        The first ``cuts`` are tangents, or the binding ones of wider windows.
        """
        rows = self._rows(windows)
        fixed = len(rows)
        program = LinearProgram(highs, self._columns(windows), rows + cuts)
        for _ in range(MOST_ROUNDS):
            solution, bound = program.run()
            points = solution[:-1].reshape(-1, PER_STOP)
            if bound > enough:
                break
            fresh = self._violated(points, float(solution[-1]), windows)
            if not fresh:
                break
            program.add(fresh)
        return Solved(bound, float(solution[-1]), points, program.binding(fixed))

    def excess(self, points: Floats, lengths: Sequence[int]) -> Floats:
        """Return (k,): by how much a solution overshoots each leg if the legs had ``lengths``."""
        before = np.array([*self.start, 0.0])
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

    def _columns(self, windows: StepWindows) -> tuple[Floats, Floats]:
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
        """Return the highest velocity along ``sign`` of an axis that is possible by a step."""
        rate, _ = self.drive.rates(axis, sign)
        return min(self.drive.top, sign * self.start[VX + axis] + rate * step)

    def _rows(self, windows: StepWindows) -> list[Cut]:
        """Return the first rows: times, velocities, the field, the simplest cuts."""
        rows = []
        for k, disc in enumerate(self.discs):
            base, before, least = PER_STOP * k, PER_STOP * (k - 1), windows.least[k]
            if k:
                times = (before + TIME, base + TIME)
                rows.append(Cut(times, (1.0, -1.0), float(-least)))
                rows.append(Cut(times, (-1.0, 1.0), float(windows.most[k])))
            for axis in (0, 1):
                for sign in (1.0, -1.0):
                    rate, _ = self.drive.rates(axis, sign)
                    columns, values = [base + VX + axis, base + TIME], [sign, -rate]
                    limit = 0.0 if k else sign * self.start[VX + axis]
                    if k:
                        columns += [before + VX + axis, before + TIME]
                        values += [-sign, rate]
                    rows.append(Cut(tuple(columns), tuple(values), limit))
                    for a, b in {(0, 0), (least, 0), (least - least // 2, least // 2)}:
                        rows.append(self._reach(k, axis, sign, a, b, windows.last[k]))
            normals, offsets = self.region.normals, self.region.offsets
            if disc.part is not None:
                normals = np.concatenate([normals, disc.part.normals])
                offsets = np.concatenate([offsets, disc.part.offsets])
            for normal, offset in zip(normals, offsets, strict=True):
                if disc.radius is None or normal @ disc.centre + disc.radius > offset:
                    rows.append(Cut((base, base + 1), (normal[0], normal[1]), float(offset)))
        return rows

    def _tangent(self, k: int, gx: float, gy: float) -> Cut:
        (cx, cy), radius = self.discs[k].centre, self.discs[k].radius
        assert radius is not None
        base = PER_STOP * k
        columns = (base, base + 1, PER_STOP * len(self.discs))
        return Cut(columns, (gx, gy, -1.0), gx * cx + gy * cy + radius)

    def _reach(self, k: int, axis: int, sign: float, a: int, b: int, last: int) -> Cut:
        """Return the bound that a pair (a, b) puts on the displacement of leg k along ``sign``."""
        top, tau = self._top(axis, sign, last), self.drive.tau
        rise, fall = self.drive.rates(axis, sign)
        base, before = PER_STOP * k, PER_STOP * (k - 1)
        columns = [base + axis, base + VX + axis, base + TIME]
        values = [sign / tau, -sign * b, -top]
        limit = rise * a * (a + 1) / 2.0 + fall * b * (b - 1) / 2.0 - top * (a + b)
        if k:
            columns += [before + axis, before + VX + axis, before + TIME]
            values += [-sign / tau, -sign * a, top]
        else:
            limit += sign * (self.start[axis] / tau + a * self.start[VX + axis])
        return Cut(tuple(columns), tuple(values), limit)

    def _violated(self, points: Floats, inflation: float, windows: StepWindows) -> list[Cut]:
        fresh = []
        rows = points.tolist()
        before = [*self.start, 0.0]
        for k, (disc, now) in enumerate(zip(self.discs, rows, strict=True)):
            if disc.radius is not None:
                dx, dy = now[0] - disc.centre[0], now[1] - disc.centre[1]
                distance = math.hypot(dx, dy)
                if distance > disc.radius + inflation + OFF:
                    fresh.append(self._tangent(k, dx / distance, dy / distance))
            for axis in (0, 1):
                for sign in (1.0, -1.0):
                    pair = self._violated_pair(axis, sign, before, now, windows, k)
                    if pair is not None:
                        fresh.append(self._reach(k, axis, sign, *pair, windows.last[k]))
            before = now
        return fresh

    def _violated_pair(
        self, axis: int, sign: float, before: list[float], now: list[float], w: StepWindows, k: int
    ) -> tuple[int, int] | None:
        rise, fall = self.drive.rates(axis, sign)
        top = self._top(axis, sign, w.last[k])
        v, u = sign * before[VX + axis], sign * now[VX + axis]
        a, b = _tightest(v, u, rise, fall, top, w.least[k])
        ramps = rise * a * (a + 1) / 2.0 + fall * b * (b - 1) / 2.0
        most = a * v + b * u + ramps + top * (now[TIME] - before[TIME] - a - b)
        moved = sign * (now[axis] - before[axis])
        return (a, b) if moved > self.drive.tau * most + OFF else None


def velocities(drive: Drive, axis: int, length: int, v: float, w: float) -> tuple[Floats, Floats]:
    """Return the lowest and highest velocities after each step of a leg from velocity v to w."""
    s = np.arange(1, length + 1)
    rise, fall, top = drive.rise[axis], drive.fall[axis], drive.top
    most = np.minimum(np.minimum(v + rise * s, w + fall * (length - s)), top)
    least = np.maximum(np.maximum(v - fall * s, w - rise * (length - s)), -top)
    return least, most


def _tightest(v: float, w: float, rise: float, fall: float, top: float, n: int) -> tuple[int, int]:
    """Return the pair (a, b), ``a + b <= n``, with the tightest cut at the velocities v and w."""
    a = n if rise <= 0.0 else min(max(math.ceil((top - v) / rise) - 1, 0), n)
    b = n if fall <= 0.0 else min(max(math.ceil((top - w) / fall), 0), n)
    if a + b > n:
        both = rise + fall
        even = math.floor((w - v + fall * n) / both) if both > 0.0 else a
        a = min(max(even, n - b, 0), a)
        b = n - a
    return a, b
