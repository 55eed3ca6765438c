"""The decentralised greedy policy: each robot acts on its observation, the map and its memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.policies.braking import Braking
from baselines.policies.policy import Policy
from mbn_marl.engine.mdp.observations import observation_table
from mbn_marl.planning.greedy import STIRS, clear_roadmap
from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.shield import Flags

# Nothing is known before the first step of an episode.
UNKNOWN = -1


class GreedyLocal(Braking, Policy):
    """Go to the first ROI of a greedy assignment to the robots in sight, and be able to brake.

    A robot assigns the ROIs that it believes to be left to itself and the robots that it observes,
    the earliest visit first. It does so again when its beliefs or the robots in sight change. It
    observes ``lidar_local``; the map, without the starts of other robots, is known. A ``blind`` one
    ignores the other robots.
    """

    def __init__(self, problem: Problem, *, blind: bool = False) -> None:
        config, arena = problem.config, problem.field.arena
        table = observation_table(config, problem.n, problem.m, arena)
        super().__init__(problem, table)
        self._blind = blind
        at = {entry.name: entry.offset for entry in table}
        self._visited = [at[f"roi_{j}_visited"] for j in range(problem.m)]
        self._roadmap = None if problem.convex else clear_roadmap(problem, problem.rois[:0])
        self.reset()

    def reset(self, worlds: np.ndarray | None = None) -> None:
        if worlds is None:
            self._target = np.zeros((0, 0), int)
        elif len(self._target):
            self._target[worlds], self._beliefs[worlds] = UNKNOWN, UNKNOWN

    def draws(self, *, deterministic: bool) -> bool:
        return False

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Return actions (worlds, k, 2) for observations (worlds, k, size) of k of the robots."""
        if self._target.shape != seen.shape[:2]:
            self._target = np.full(seen.shape[:2], UNKNOWN)
            self._beliefs = np.full((*seen.shape[:2], self.problem.m + self.problem.n - 1), UNKNOWN)
            self._steps = 0
        rows = seen.reshape(-1, seen.shape[-1]).astype(float)
        place, speed, others, there = self._read(rows)
        there &= not self._blind
        left = rows[:, self._visited] < 0.5
        target = self._targets(place, others, there, left)
        wanted = self._wanted(place, speed, target)
        changes = self._choose(place, speed, wanted, others, there)
        self._steps += 1
        actions: np.ndarray = (changes / self._force).reshape(*seen.shape[:2], 2)
        return actions.astype(np.float32)

    def _targets(self, place: Floats, others: Floats, there: Flags, left: Flags) -> NDArray[Any]:
        target, beliefs = self._target.reshape(-1), np.concatenate([left, there], 1).astype(int)
        known = self._beliefs.reshape(beliefs.shape)
        stale = np.flatnonzero((known != beliefs).any(1))
        known[stale] = beliefs[stale]
        if len(stale):
            target[stale] = self._assigned(place[stale], others[stale], there[stale], left[stale])
        return target

    def _assigned(self, place: Floats, others: Floats, there: Flags, left: Flags) -> NDArray[Any]:
        """Return the first ROI of each row's own robot in its greedy assignment, or -1."""
        rows, left, rois = np.arange(len(place)), left.copy(), self.problem.rois
        at = np.concatenate([place[:, None], others], 1)
        walked = np.where(np.concatenate([np.ones_like(there[:, :1]), there], 1), 0.0, np.inf)
        first = np.full(len(place), UNKNOWN)
        for _ in range(left.shape[1]):
            ways = np.linalg.norm(at[:, :, None] - rois, axis=-1) + walked[..., None]
            ways[~np.broadcast_to(left[:, None], ways.shape)] = np.inf
            robot, roi = np.divmod(ways.reshape(len(rows), -1).argmin(1), left.shape[1])
            length = ways[rows, robot, roi]
            found = np.isfinite(length)
            mine = found & (robot == 0) & (first == UNKNOWN)
            first[mine] = roi[mine]
            at[rows[found], robot[found]] = rois[roi[found]]
            walked[rows[found], robot[found]] = length[found]
            left[rows[found], roi[found]] = False
        return first

    def _wanted(self, place: Floats, speed: Floats, target: NDArray[Any]) -> Floats:
        """Return the highest velocities toward the targets from which robots can stop there."""
        goes, tau = target != UNKNOWN, self.problem.config.tau
        goal = self.problem.rois[target]
        if self._roadmap is not None:
            for row in np.flatnonzero(goes):
                goal[row] = self._roadmap.toward(place[row], int(target[row]))
        offset = (goal - place) / tau
        far, force = np.abs(offset), self._force
        limit = np.minimum(0.5 * (np.sqrt(force**2 + 8.0 * force * far) - force), self._top)
        scale = np.where(far > 1e-9, limit / np.maximum(far, 1e-9), 1.0).min(1, keepdims=True)
        # Without an ROI robots stir, since to rest on a visited one has a cost.
        rests = ~speed.any(1, keepdims=True)
        stir = STIRS[self._steps % len(STIRS)] * force * rests
        wanted: Floats = np.where(goes[:, None], offset * np.minimum(scale, 1.0), stir)
        return wanted
