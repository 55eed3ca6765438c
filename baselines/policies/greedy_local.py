"""The decentralised greedy policy: each robot acts on its observation, the map and its memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from baselines.policies.policy import Policy
from mbn_marl.engine.mdp.observations import observation_table
from mbn_marl.planning.greedy import STIRS, clear_roadmap
from mbn_marl.planning.problem import Problem

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# The share of a safety distance that robots keep from the middle between two of them.
BERTH = 1.03
# Directions (degrees) and shares of the wanted velocity to try in turn, then directions to leave.
TURNS = ((0, 1.0), (0, 0.5), (0, 0.25), (60, 0.5), (-60, 0.5), (100, 0.5), (-100, 0.5), (0, 0.0))
ESCAPES = np.radians(np.arange(8) * 45.0)
ESCAPE_SHARE = 0.5  # of the speed limit
# Nothing is known before the first step of an episode.
UNKNOWN = -1


class GreedyLocal(Policy):
    """Go to the first ROI of a greedy assignment to the robots in sight, and be able to brake.

    A robot assigns the ROIs that it believes to be left to itself and the robots that it observes,
    the earliest visit first. It does so again when its beliefs or the robots in sight change. It
    takes the first velocity from which it can brake inside the field and its buffered Voronoi cell
    (Zhou et al., 2017), whatever the others do. It observes ``lidar_local``; the map, without the
    starts of other robots, is known. A ``blind`` one ignores the other robots.
    """

    def __init__(self, problem: Problem, *, blind: bool = False) -> None:
        self.problem, self._blind = problem, blind
        config, arena = problem.config, np.array(problem.field.arena)
        table = observation_table(config, problem.n, problem.m, problem.field.arena)
        at = {entry.name: entry.offset for entry in table}
        self._own = [at[name] for name in ("own_x", "own_y", "own_vx", "own_vy")]
        axes = ("dx", "dy", "dvx", "dvy")
        others = [[at[f"other_{k}_{axis}"] for axis in axes] for k in range(1, problem.n)]
        self._others = np.array(others, int).reshape(-1, 4)
        self._visited = [at[f"roi_{j}_visited"] for j in range(problem.m)]
        corners = problem.field.vertices
        self._centre, self._half = (corners.min(0) + corners.max(0)) / 2.0, arena / 2.0
        self._arena, self._top = arena, config.top_speed
        self._force = problem.forces.min(0)
        self._roadmap = None if problem.convex else clear_roadmap(problem, problem.rois[:0])
        shapely.prepare(problem.area)
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
        place = self._centre + rows[:, self._own[:2]] * self._half
        speed = rows[:, self._own[2:]] * self._top
        offsets = rows[:, self._others]
        there: Flags = (offsets != 0.0).any(-1) & (not self._blind)
        others = place[:, None] + offsets[..., :2] * self._arena
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

    def _choose(
        self, place: Floats, speed: Floats, wanted: Floats, others: Floats, there: Flags
    ) -> Floats:
        """Return the change of each row's velocity: the first from which it can brake."""
        change = -np.clip(speed, -self._force, self._force)
        rows = np.arange(len(place))
        turns = [(share * np.exp(1j * np.radians(angle)), 0.0) for angle, share in TURNS]
        turns += [(0.0, ESCAPE_SHARE * self._top * np.exp(1j * angle)) for angle in ESCAPES]
        for turn, own in turns:
            asked = turn * (wanted[rows] @ np.array([1.0, 1.0j])) + own
            aim = np.stack([asked.real, asked.imag], -1)
            step = np.clip(aim - speed[rows], -self._force, self._force)
            after = np.clip(speed[rows] + step, -self._top, self._top)
            safe = self._can_brake(place[rows], after, others[rows], there[rows])
            change[rows[safe]] = step[safe]
            rows = rows[~safe]
            if not len(rows):
                break
        return change

    def _can_brake(self, place: Floats, speed: Floats, others: Floats, there: Flags) -> Flags:
        middle = others - place[:, None]
        apart = np.maximum(np.linalg.norm(middle, axis=-1), 1e-9)
        room = np.where(there, (apart - BERTH * self.problem.config.safety_distance) / 2.0, np.inf)
        toward, now, good = middle / apart[..., None], place.copy(), np.ones(len(place), bool)
        while good.any():
            now = now + speed * self.problem.config.tau
            good &= self._inside(now)
            good &= (np.einsum("rka,ra->rk", toward, now - place) <= room).all(1)
            if not speed[good].any():
                break
            speed = speed - np.clip(speed, -self._force, self._force)
        return good

    def _inside(self, places: Floats) -> Flags:
        if self.problem.convex:
            normals, limits = self.problem.half_planes
            return np.asarray((places @ normals.T <= limits + 1e-6).all(-1), bool)
        return np.asarray(shapely.intersects_xy(self.problem.area, *places.T), bool)
