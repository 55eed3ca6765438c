"""The decentralised greedy policy: each robot acts on its observation, the map and its memory."""

from copy import deepcopy
from dataclasses import replace
from typing import Any, Self

import numpy as np
import shapely
from numpy.typing import NDArray

from baselines.policies.braking import Braking
from baselines.policies.policy import Policy
from mbn_marl.config import NavigationConfig
from mbn_marl.engine.mdp.observations import observation_table
from mbn_marl.planning.greedy import STIRS, clear_roadmap
from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.roadmap import Roadmap, moved_into
from mbn_marl.planning.shield import Flags

# Nothing is known before the first step of an episode.
UNKNOWN = -1
# Robots slower than this share of the speed limit for so many steps are held up.
SLOW, PATIENCE = 0.1, 5
# Robot i then leaves those within so many safety distances, for 1 + i times so many steps.
CROWD, LEAVE = 3.0, 6


class GreedyLocal(Braking, Policy):
    """Go to the first ROI of a greedy assignment to the robots in sight, and be able to brake.

    A robot assigns the ROIs that it believes to be left to itself and the robots that it observes,
    the earliest visit first. It does so again when its beliefs or the robots in sight change. It
    observes ``lidar_local``; the map, without the starts of other robots, is known, and the kinds
    of all robots. A ``blind`` one ignores the other robots. If ROIs are hidden, robots without any
    go to the nearest part of the field that neither they nor, as far as they know, those that tell
    them have seen. If walls leave no room to pass each other, kinds of robots take turns: those
    with no ROI keep away from others, or go back to their starts if their turn is over.
    """

    def __init__(
        self, problem: Problem, settings: NavigationConfig, *, blind: bool = False
    ) -> None:
        config, arena = problem.config, problem.field.arena
        kinds = bool(problem.field.roi_kinds)
        table = observation_table(config, problem.n, problem.m, arena, kinds=kinds)
        super().__init__(problem, table, problem.n)
        self._blind, self._heard = blind, settings.comm_radius
        self._parts, self._near = np.zeros((0, 2)), np.zeros(0)
        if settings.hidden_rois:
            self._parts, self._near = parts(problem, min(config.sensing_radius, max(arena)))
        # The least number of those of ROIs that are left is that of the kind whose turn it is.
        self._turns = np.zeros(problem.m)
        if kinds and not problem.convex:
            self._turns = np.array([-1 if k is None else k for k in problem.field.roi_kinds])
        homes = problem.starts[: problem.n if self._turns.any() else 0]
        self._places = np.concatenate([problem.rois, self._parts, homes])
        at = {entry.name: entry.offset for entry in table}
        self._visited = [at[f"roi_{j}_visited"] for j in range(problem.m)]
        self._roadmap: Roadmap | None = None
        if not problem.convex:
            self._roadmap = clear_roadmap(replace(problem, rois=self._places), problem.rois[:0])
        self._robots = np.arange(problem.n)
        # The ROIs that robots may visit, in the order in which each observes them.
        self._mine = problem.mine[[[i, *np.delete(self._robots, i)] for i in self._robots]]
        self.reset()

    def reset(self, worlds: np.ndarray | None = None) -> None:
        if worlds is None:
            self._target = np.zeros((0, 0), int)
        elif len(self._target):
            self._target[worlds], self._beliefs[worlds] = UNKNOWN, UNKNOWN
            self._swept[worlds], self._still[worlds] = False, 0

    def of_robot(self, robot: int, robots: int) -> Self:
        one = deepcopy(self)
        one._robots = np.array([robot])
        return one

    def draws(self, *, deterministic: bool) -> bool:
        return False

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Return actions (worlds, k, 2) for observations (worlds, k, size) of k of the robots."""
        if self._target.shape != seen.shape[:2]:
            self._target = np.full(seen.shape[:2], UNKNOWN)
            self._beliefs = np.full((*seen.shape[:2], self.problem.m + self.problem.n - 1), UNKNOWN)
            self._swept = np.zeros((*seen.shape[:2], len(self._parts)), bool)
            self._still = np.zeros(seen.shape[:2], int)
            self._steps = 0
        rows = seen.reshape(-1, seen.shape[-1]).astype(float)
        place, speed, others, moves, there = self._read(rows)
        there &= not self._blind
        left = rows[:, self._visited] < 0.5
        robots = self._robots[np.arange(len(rows)) % len(self._robots)]
        target = self._targets(robots, place, others, there, left)
        wanted = self._wanted(robots, place, speed, target)
        if self._turns.any():
            slow = SLOW * self._limits[robots, 0]
            held = (target != UNKNOWN) & (np.abs(speed).max(1) < slow)
            held &= np.abs(wanted).max(1) > slow
            leaves = self._leaves(robots, held) | (target == UNKNOWN)
            away = self._away(place[leaves], others[leaves], there[leaves])
            wanted[leaves] = self._limits[robots[leaves]] * away
        changes = self._choose(place, speed, wanted, others, moves, there, robots)
        self._steps += 1
        actions: np.ndarray = (changes / self._forces[robots]).reshape(*seen.shape[:2], 2)
        return actions.astype(np.float32)

    def _targets(
        self, robots: NDArray[Any], place: Floats, others: Floats, there: Flags, left: Flags
    ) -> NDArray[Any]:
        target, beliefs = self._target.reshape(-1), np.concatenate([left, there], 1).astype(int)
        known = self._beliefs.reshape(beliefs.shape)
        # Two idle robots may each have left one ROI to the other, so they assign in each step.
        idle = (target == UNKNOWN) & left.any(1)
        stale = np.flatnonzero((known != beliefs).any(1) | idle)
        known[stale] = beliefs[stale]
        if len(stale):
            turn = left & (self._turns == np.where(left, self._turns, np.inf).min(1)[:, None])
            able = turn[stale, None] & self._mine[robots[stale]]
            target[stale] = self._assigned(place[stale], others[stale], there[stale], able)
        if len(self._parts):
            self._sweep(place, others, there, target)
        elif self._turns.any():
            over = ~(left & self._mine[robots, 0]).any(1)
            target[over] = self.problem.m + robots[over]
        return target

    def _sweep(self, place: Floats, others: Floats, there: Flags, target: NDArray[Any]) -> None:
        """Note the parts that are seen; send robots without an ROI to one that is not."""
        swept, m = self._swept.reshape(len(place), -1), self.problem.m
        own = np.linalg.norm(self._parts - place[:, None], axis=-1)
        far = np.linalg.norm(self._parts - others[:, :, None], axis=-1)
        heard = there & (np.linalg.norm(others - place[:, None], axis=-1) <= self._heard)
        swept |= (own <= self._near) | ((far <= self._near) & heard[..., None]).any(1)
        swept[swept.all(1)] = False  # what was there has not been heard of: once more
        reached = (target >= m) & swept[np.arange(len(place)), np.maximum(target - m, 0)]
        target[reached] = UNKNOWN
        idle = target == UNKNOWN
        # A part that another robot in sight is nearer to is the last choice.
        taken = ((far < own[:, None]) & there[..., None]).any(1)
        ways = own + np.where(taken, np.linalg.norm(self._arena), 0.0)
        target[idle] = m + np.where(swept, np.inf, ways).argmin(1)[idle]

    def _assigned(self, place: Floats, others: Floats, there: Flags, able: Flags) -> NDArray[Any]:
        """Return the first ROI of each row's own robot in its greedy assignment, or -1."""
        rows, rois = np.arange(len(place)), self.problem.rois
        at = np.concatenate([place[:, None], others], 1)
        walked = np.where(np.concatenate([np.ones_like(there[:, :1]), there], 1), 0.0, np.inf)
        first = np.full(len(place), UNKNOWN)
        for _ in range(len(rois)):
            ways = np.linalg.norm(at[:, :, None] - rois, axis=-1) + walked[..., None]
            ways[~able] = np.inf
            robot, roi = np.divmod(ways.reshape(len(rows), -1).argmin(1), len(rois))
            length = ways[rows, robot, roi]
            found = np.isfinite(length)
            mine = found & (robot == 0) & (first == UNKNOWN)
            first[mine] = roi[mine]
            at[rows[found], robot[found]] = rois[roi[found]]
            walked[rows[found], robot[found]] = length[found]
            able[rows[found], :, roi[found]] = False
            if ((first != UNKNOWN) | ~found).all():
                break
        return first

    def _wanted(
        self, robots: NDArray[Any], place: Floats, speed: Floats, target: NDArray[Any]
    ) -> Floats:
        """Return the highest velocities toward the targets from which robots can stop there."""
        goes, tau = target != UNKNOWN, self.problem.config.tau
        goal = self._places[target]
        if self._roadmap is not None:
            for row in np.flatnonzero(goes):
                goal[row] = self._roadmap.toward(place[row], int(target[row]))
        offset = (goal - place) / tau
        far, brake = np.abs(offset), self._brake
        stops = 0.5 * (np.sqrt(brake**2 + 8.0 * brake * far) - brake)
        limit = np.minimum(stops, self._limits[robots])
        scale = np.where(far > 1e-9, limit / np.maximum(far, 1e-9), 1.0).min(1, keepdims=True)
        # Without an ROI robots stir, since to rest on a visited one has a cost.
        rests = ~speed.any(1, keepdims=True)
        stir = STIRS[self._steps % len(STIRS)] * brake * rests
        wanted: Floats = np.where(goes[:, None], offset * np.minimum(scale, 1.0), stir)
        return wanted

    def _leaves(self, robots: NDArray[Any], held: Flags) -> Flags:
        """Return which robots leave the others, since they were held up."""
        still = self._still.reshape(-1)  # steps held up, or, below 0, steps to leave
        still[:] = np.where(held | (still < 0), still + 1, 0)
        over = still > PATIENCE
        still[over] = -LEAVE * (1 + robots[over])
        leaves: Flags = still < 0
        return leaves

    def _away(self, place: Floats, others: Floats, there: Flags) -> Floats:
        """Return directions away from the robots nearby."""
        offset = place[:, None] - others
        far = np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1e-9)
        near = there[..., None] & (far < CROWD * self.problem.config.safety_distance)
        push = np.where(near, offset / far**2, 0.0).sum(1)
        away: Floats = push / np.maximum(np.linalg.norm(push, axis=1, keepdims=True), 1e-9)
        return away


def parts(problem: Problem, radius: float) -> tuple[Floats, Floats]:
    """Return the middles (k, 2) of parts of the field, and within what (k,) robots see all of one.

    Robots see as far as ``radius``, units.
    """
    side = radius / 4.0
    corners, half = problem.field.vertices, side / np.sqrt(2.0)
    lines = [
        np.arange(low + side / 2.0, high + side / 2.0, side)
        for low, high in zip(corners.min(0), corners.max(0), strict=True)
    ]
    grid = np.stack(np.meshgrid(*lines), -1).reshape(-1, 2)
    squares = shapely.box(*(grid - side / 2.0).T, *(grid + side / 2.0).T)
    grid = grid[shapely.intersects(problem.area, squares)]
    middles = moved_into(problem.area, grid)
    return middles, radius - half - np.linalg.norm(middles - grid, axis=-1)
