"""The classical baseline: greedy assignment and a point-to-point controller that can always brake.

Each robot moves straight to the next corner or ROI, as fast as it can still stop there. It takes an
action only if it could then brake to rest inside the field and apart from the others, if they brake
too. The first step reveals the wind.
"""

from __future__ import annotations

import math

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.engine.snapshot import FloatArray
from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.roadmap import Roadmap, make_roadmap

CLEARANCES = (4.0, 2.0, 1.0, 0.3, 0.0)
"""Clearances to try between paths and walls, in units; the first that closes no path is used."""
STIR = 0.05
"""Share of the force with which idle robots stir, since standing still costs a revisit."""
LONGEST_BRAKE = 60
TURNS = (0.0, 60.0, -60.0, 120.0, -120.0)
"""Directions to try in turn, in degrees from the wanted one."""


class Greedy:
    """Controls one team through one episode.

    Args:
        problem: the instance.
        positions: (n, 2), where the robots start, which need not be the field's starts, units.
    """

    def __init__(self, problem: Problem, positions: Floats) -> None:
        self.problem = problem
        self.roadmap = clear_roadmap(problem, positions)
        self.queues = assign(self.roadmap, problem.n, problem.m)
        self.steps = 0
        self.from_rest: NDArray[np.float32] | None = None
        self.random = np.random.default_rng(0)
        self.polygon = problem.field.polygon
        shapely.prepare(self.polygon)

    def act(
        self, positions: FloatArray, velocities: FloatArray, visited: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """Return actions (n, 2) in [-1, 1].

        Args:
            positions: (n, 2), units.
            velocities: (n, 2), units/step.
            visited: (m,), which ROIs have been visited.
        """
        positions, velocities = positions.astype(float), velocities.astype(float)
        if self.from_rest is not None:
            self.problem = self.problem.with_wind(velocities, self.from_rest)
            self.from_rest = None
        plans = [self._coast(i, positions[i], velocities[i]) for i in range(self.problem.n)]
        actions = np.zeros((self.problem.n, 2), np.float32)
        for i in range(self.problem.n):
            top = self.problem.drives[i].top
            others = plans[:i] + plans[i + 1 :]
            for wanted in self._wishes(i, positions[i], velocities[i], visited):
                change = self._within_force(i, wanted - velocities[i])
                velocity = np.clip(velocities[i] + change, -top, top)
                position = positions[i] + velocity * self.problem.config.tau
                path = np.concatenate([position[None], self._coast(i, position, velocity)])
                if self._free(path, others):
                    break
            else:
                change = self._within_force(i, -velocities[i])
                path = plans[i]
            plans[i] = path
            force = (change - self.problem.wind) / self.problem.forces[i]
            actions[i] = np.clip(force, -1.0, 1.0)
        if self.steps == 0 and not velocities.any():
            self.from_rest = actions
        self.steps += 1
        return actions

    def _wishes(
        self, i: int, position: Floats, velocity: Floats, visited: NDArray[np.bool_]
    ) -> list[Floats]:
        """Return the velocities for robot i to try, the best first."""
        queue = self.queues[i]
        while queue and visited[queue[0]]:
            queue.pop(0)
        if not queue:
            stir = self.random.uniform(-STIR, STIR, 2) * self.problem.forces[i]
            return [stir, -stir]
        goal = self.problem.n + queue[0]
        wanted = self._speed(i, self.roadmap.toward(position, goal) - position)
        turned = [_turn(wanted, math.radians(angle)) for angle in TURNS]
        return [wanted, 0.5 * wanted, 0.25 * wanted, *(0.5 * one for one in turned[1:])]

    def _speed(self, i: int, offset: Floats) -> Floats:
        """Return the highest velocity along ``offset`` from which robot i can stop at its end."""
        tau = self.problem.config.tau
        brake = np.maximum(self.problem.forces[i] - np.abs(self.problem.wind), 1e-3)
        far = np.abs(offset) / tau
        speed = 0.5 * (np.sqrt(brake**2 + 8.0 * brake * far) - brake)
        speed = np.minimum(speed, self.problem.drives[i].top)
        scale = np.min(speed[far > 1e-9] / far[far > 1e-9], initial=1.0)
        return np.asarray(offset / tau * scale)

    def _within_force(self, i: int, change: Floats) -> Floats:
        """Return the possible change of velocity that is nearest to ``change``."""
        force, wind = self.problem.forces[i], self.problem.wind
        return np.clip(change, wind - force, wind + force)

    def _coast(self, i: int, position: Floats, velocity: Floats) -> Floats:
        """Return (k, 2): robot i's positions while it brakes; the last one is where it rests."""
        path, top = [], self.problem.drives[i].top
        for _ in range(LONGEST_BRAKE):
            velocity = np.clip(velocity + self._within_force(i, -velocity), -top, top)
            position = position + velocity * self.problem.config.tau
            path.append(position)
            if not velocity.any():
                break
        return np.array(path)

    def _free(self, path: Floats, others: list[Floats]) -> bool:
        """Return whether a path stays in the field and away from the other paths."""
        if not np.all(shapely.intersects_xy(self.polygon, path[:, 0], path[:, 1])):
            return False
        least = self.problem.config.safety_distance * 1.01
        for other in others:
            steps = np.arange(max(len(path), len(other)))
            mine = path[np.minimum(steps, len(path) - 1)]
            apart = mine - other[np.minimum(steps, len(other) - 1)]
            if np.min(np.hypot(apart[:, 0], apart[:, 1])) < least:
                return False
        return True


def clear_roadmap(problem: Problem, positions: Floats) -> Roadmap:
    """Return the roadmap of the robots, then the ROIs, clear of walls where possible."""
    places = np.concatenate([positions, problem.rois])
    for clearance in CLEARANCES:
        area = problem.field.polygon.buffer(-clearance, join_style="mitre")
        if area.is_empty:
            continue
        roadmap = make_roadmap(area, places)
        if np.all(np.isfinite(roadmap.lengths[: len(places), : len(places)])):
            return roadmap
    return make_roadmap(problem.field.polygon, places)


def assign(roadmap: Roadmap, n: int, m: int) -> list[list[int]]:
    """Return a queue of ROIs for each robot; the earliest possible visit is always added next."""
    at, walked = list(range(n)), np.zeros(n)
    queues: list[list[int]] = [[] for _ in range(n)]
    left = set(range(m))
    while left:
        total, i, j = min(
            (walked[i] + roadmap.lengths[at[i], n + j], i, j) for i in range(n) for j in left
        )
        queues[i].append(j)
        at[i], walked[i] = n + j, total
        left.remove(j)
    return queues


def _turn(vector: Floats, angle: float) -> Floats:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])
