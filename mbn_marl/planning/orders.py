"""Branch and bound on the steps at which one robot visits discs in a given order."""

from __future__ import annotations

import bisect
from collections.abc import Callable
from dataclasses import dataclass, replace

import highspy
import numpy as np

from mbn_marl.planning.problem import Drive, Floats, Start
from mbn_marl.planning.relaxation import (
    TIME,
    VX,
    Region,
    Relaxation,
    Solved,
    StepWindows,
    fixed_windows,
    velocities,
)

ROOM = 0.02
"""The search stops at visits with this much room inside the discs, in units."""
BETTER = 1e-3
"""Further visits are searched for only if they have this much more room, in units."""
OUTSIDE = 1e-4
"""Tolerance of the test that a path stays in the region, in units."""
MOST_VIAS = 30
"""Programs that keep one path out of the obstacles."""


class OutOfTimeError(Exception):
    """The time limit was reached."""


class UndecidedError(OutOfTimeError):
    """A search has too many branches to be finished."""


@dataclass(frozen=True)
class Visits:
    """Steps at which a robot can visit discs."""

    steps: tuple[int, ...]  # one for each disc, in order
    inflation: float  # the least of the discs at these steps, units; negative is room
    path: Floats  # (steps[-1], 2), the positions after each step, inside the hull, units


@dataclass
class Search:
    """Searches steps at which one robot can visit a relaxation's discs in order, within windows."""

    relaxation: Relaxation  # whose region must not be left
    obstacles: tuple[Region, ...]  # must not be entered
    slack: float  # allowance of the discs for rounding, in units
    highs: highspy.Highs
    deadline: float  # on the clock
    clock: Callable[[int], float]

    def possible(self, windows: StepWindows) -> bool:
        """Return whether the relaxation allows the windows; ``False`` is a proof that they fail."""
        tight = windows.tightened()
        if tight is None:
            return False
        tangents = self.relaxation.tangents()
        solved = self.relaxation.solve(self.highs, tight, tangents, self.slack)
        return solved.bound <= self.slack

    def visits(self, windows: StepWindows) -> Visits | None:
        """Return steps for the discs, within the windows; ``None`` is a proof that none exist."""
        best: Visits | None = None
        relaxation = self.relaxation
        nodes = [(windows, relaxation.tangents())]
        while nodes:
            wide, cuts = nodes.pop()
            tight = wide.tightened()
            if tight is None:
                continue
            if self.clock(1) > self.deadline:
                raise OutOfTimeError
            enough = self.slack if best is None else min(self.slack, best.inflation - BETTER)
            solved = relaxation.solve(self.highs, tight, cuts, enough)
            if solved.bound > enough:
                continue
            if tight.fixed:
                best = self._follow(tight, solved, enough) or best
                if best is not None and best.inflation <= -ROOM:
                    return best
            else:
                nodes.extend((part, solved.cuts) for part in _branch(relaxation, tight, solved))
        return best

    def _follow(self, windows: StepWindows, solved: Solved, enough: float) -> Visits | None:
        """Keep the whole path out of the obstacles, for fixed times, by further stops.

        A stop is beyond one of an obstacle's edges; all are tried. After :data:`MOST_VIAS` a path
        that may cross obstacles is returned: it is not proved that there is none.
        """
        nodes = [(self.relaxation, windows.first, solved)]
        for _ in range(MOST_VIAS):
            if self.clock(1) > self.deadline:
                raise OutOfTimeError
            relaxation, stops, solved = nodes.pop()
            path = interpolate(relaxation.start, relaxation.drive, solved.points)
            step, parts = self._crossing(path, stops)
            if not parts:
                break
            place = bisect.bisect(stops, step)
            stops = (*stops[:place], step, *stops[place:])
            for part in parts:
                longer = relaxation.with_via(place, part)
                found = longer.solve(self.highs, fixed_windows(stops), longer.tangents(), enough)
                if found.bound <= enough:
                    nodes.append((longer, stops, found))
            if not nodes:
                return None
        return Visits(windows.first, solved.inflation, path)

    def _crossing(self, path: Floats, stops: tuple[int, ...]) -> tuple[int, list[Region | None]]:
        """Return the step at which a path is the farthest outside, and where it may be instead.

        That is beyond one of an obstacle's edges, the nearest one last, or anywhere in the region.
        """
        region = self.relaxation.region
        beyond = [(path @ region.normals.T - region.offsets).max(axis=1, initial=-1.0)]
        beyond += [(one.offsets - path @ one.normals.T).min(axis=1) for one in self.obstacles]
        depth = np.array(beyond)
        depth[0, [stop - 1 for stop in stops]] = -1.0  # stops are in the region
        piece, worst = np.unravel_index(depth.argmax(), depth.shape)
        if depth[piece, worst] <= OUTSIDE:
            return 0, []
        if piece == 0:
            return int(worst) + 1, [None]
        return int(worst) + 1, _sides(self.obstacles[piece - 1], path[worst])


def _sides(obstacle: Region, point: Floats) -> list[Region | None]:
    """Return the half-planes beyond an obstacle's edges, that of the edge next to a point last."""
    order = np.argsort(obstacle.normals @ point - obstacle.offsets)
    return [
        replace(obstacle, normals=-obstacle.normals[[k]], offsets=-obstacle.offsets[[k]])
        for k in order
    ]


def _branch(
    relaxation: Relaxation, windows: StepWindows, solved: Solved
) -> tuple[StepWindows, StepWindows]:
    """Return two parts of the windows that exclude the solution, the likelier one last."""
    ends = solved.points[:, TIME]
    lengths = np.diff(ends, prepend=0.0)
    least, most = np.array(windows.least), np.array(windows.most)
    whole = np.clip(np.floor(lengths + 0.5).astype(int), least, most)
    choice = most > least
    excess = relaxation.excess(solved.points, whole.tolist())
    if not np.any(excess[choice] > 1e-9):
        excess = np.abs(lengths - whole) + 1e-3 * (most - least)
    leg = int(np.argmax(np.where(choice, excess, -1.0)))
    fewer, more = windows.split(leg, max(int(whole[leg]), int(least[leg]) + 1))
    return (fewer, more) if whole[leg] > least[leg] else (more, fewer)


def interpolate(start: Start, drive: Drive, points: Floats) -> Floats:
    """Return the positions after every step of a motion through a relaxation's ``points``."""
    path = [np.zeros((0, 2))]
    before = np.array([*start, 0.0])
    for now in points:
        length = round(now[TIME] - before[TIME])
        if length > 0:
            moves = np.stack([_moves(drive, axis, length, before, now) for axis in (0, 1)], axis=1)
            path.append(before[:2] + drive.tau * np.cumsum(moves, axis=0))
        before = now
    return np.concatenate(path)


def _moves(drive: Drive, axis: int, length: int, before: Floats, now: Floats) -> Floats:
    least, most = velocities(drive, axis, length, before[VX + axis], now[VX + axis])
    wanted = (now[axis] - before[axis]) / drive.tau
    spread = float((most - least).sum())
    share = (wanted - float(least.sum())) / spread if spread > 1e-12 else 0.0
    return least + min(max(share, 0.0), 1.0) * (most - least)
