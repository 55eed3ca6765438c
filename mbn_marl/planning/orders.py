"""Whether one robot can pass discs in a given order: branch and bound on the steps of its visits."""

from __future__ import annotations

from dataclasses import dataclass

import highspy
import numpy as np

from mbn_marl.planning.problem import Drive, Floats
from mbn_marl.planning.relaxation import PER_STOP, TIME, VX, Region, Relaxation, Stop

ROOM = 0.02
"""Discs passed with this much to spare, in units, are good enough to stop looking for better."""
MOST_VIAS = 60


@dataclass(frozen=True)
class Visits:
    """Steps at which a robot can visit discs.

    Attributes:
        steps: one for each disc, in order.
        inflation: the least inflation of the discs at these steps, units; negative is room.
        path: (steps[-1], 2): the positions after each step, in the hull.
    """

    steps: tuple[int, ...]
    inflation: float
    path: Floats


@dataclass
class Search:
    """Decides for one robot whether discs can be passed in order, in windows of steps.

    Attributes:
        start: where it rests at step 0.
        drive: what moves it.
        region: the convex set that it must not leave.
        slack: discs may be missed by this much, in units: what rounding can do.
        highs: the solver.
    """

    start: tuple[float, float]
    drive: Drive
    region: Region
    slack: float
    highs: highspy.Highs

    def possible(self, stops: tuple[Stop, ...]) -> bool:
        """Whether the relaxation allows the windows; ``False`` is a proof that none can."""
        gaps = [stop.gap for stop in stops]
        tight = _propagate([(stop.first, stop.last) for stop in stops], gaps)
        if tight is None:
            return False
        relaxation = self._relaxation(stops).within(tight)
        return relaxation.solve(self.highs, self.slack).bound <= self.slack

    def visits(self, stops: tuple[Stop, ...]) -> Visits | None:
        """Steps for the stops, within their windows; ``None`` is a proof that there are none."""
        best: Visits | None = None
        root, gaps = self._relaxation(stops), [stop.gap for stop in stops]
        nodes = [[(stop.first, stop.last) for stop in stops]]
        while nodes:
            windows = _propagate(nodes.pop(), gaps)
            if windows is None:
                continue
            enough = self.slack if best is None else min(self.slack, best.inflation - 1e-3)
            relaxation = root.within(windows)
            solved = relaxation.solve(self.highs, enough)
            if solved.bound > enough:
                continue
            if all(first == last for first, last in windows):
                found = self._follow(relaxation, enough)
                if found is not None:
                    best = found
                    if best.inflation <= -ROOM:
                        return best
            else:
                nodes.extend(_split(windows, solved.points[:, TIME]))
        return best

    def _relaxation(self, stops: tuple[Stop, ...]) -> Relaxation:
        return Relaxation(self.start, self.drive, self.region, stops)

    def _follow(self, relaxation: Relaxation, enough: float) -> Visits | None:
        """With all times fixed: keep the whole path in the region, step by step where needed."""
        steps = tuple(stop.first for stop in relaxation.stops)
        for _ in range(MOST_VIAS):
            solved = relaxation.solve(self.highs, enough)
            if solved.bound > enough:
                return None
            path = interpolate(self.start, self.drive, solved.points)
            outside = (path @ self.region.normals.T - self.region.offsets).max(axis=1, initial=-1.0)
            worst = int(outside.argmax()) if len(outside) else 0
            if len(outside) == 0 or outside[worst] <= 1e-4:
                break
            relaxation = relaxation.with_via(worst + 1)
        return Visits(steps, solved.inflation, path)


def _propagate(windows: list[tuple[int, int]], gaps: list[int]) -> list[tuple[int, int]] | None:
    """The windows as narrow as their order and the gaps make them; ``None`` if one is empty."""
    offsets = np.cumsum(gaps)
    firsts = np.maximum.accumulate([first for first, _ in windows] - offsets) + offsets
    lasts = np.array([last for _, last in windows]) - offsets
    lasts = np.minimum.accumulate(lasts[::-1])[::-1] + offsets
    if np.any(firsts > lasts):
        return None
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def _split(windows: list[tuple[int, int]], times: Floats) -> list[list[tuple[int, int]]]:
    """Two halves of the widest window; the one where the relaxation has its time comes last."""
    widths = [last - first for first, last in windows]
    k = int(np.argmax(widths))
    first, last = windows[k]
    middle = min(max(int(np.floor(times[k] + 0.5)), first), last - 1)
    low, high = list(windows), list(windows)
    low[k], high[k] = (first, middle), (middle + 1, last)
    return [high, low] if times[k] <= middle + 0.5 else [low, high]


def interpolate(start: tuple[float, float], drive: Drive, points: Floats) -> Floats:
    """The positions after every step of a motion through ``points``, (k, 5) as in a relaxation."""
    path = [np.zeros((0, 2))]
    before = np.array([*start, 0.0, 0.0, 0.0])
    for now in points:
        length = round(now[TIME] - before[TIME])
        if length > 0:
            moves = np.stack([_moves(drive, axis, length, before, now) for axis in (0, 1)], axis=1)
            path.append(before[:2] + drive.tau * np.cumsum(moves, axis=0))
        before = now
    return np.concatenate(path)


def _moves(drive: Drive, axis: int, length: int, before: Floats, now: Floats) -> Floats:
    """Velocities of one axis in a leg, between the fastest and the slowest of its ends."""
    s = np.arange(1, length + 1)
    v, w = before[VX + axis], now[VX + axis]
    rise, fall, top = drive.rise[axis], drive.fall[axis], drive.top
    most = np.minimum(np.minimum(v + rise * s, w + fall * (length - s)), top)
    least = np.maximum(np.maximum(v - fall * s, w - rise * (length - s)), -top)
    wanted = (now[axis] - before[axis]) / drive.tau
    spread = float((most - least).sum())
    share = (wanted - float(least.sum())) / spread if spread > 1e-12 else 0.0
    return least + min(max(share, 0.0), 1.0) * (most - least)


assert PER_STOP == TIME + 1
