"""The classical baseline: greedy assignment and a point-to-point controller that can always brake.

Each robot moves straight to the next corner or ROI, as fast as it can still stop there, and takes
an action only if it could then brake (:class:`~mbn_marl.planning.shield.Cautious`).
"""

from __future__ import annotations

import math

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.engine.snapshot import FloatArray
from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.roadmap import Roadmap, make_roadmap
from mbn_marl.planning.shield import Cautious, Flags, Weather, around

CLEARANCES = (4.0, 2.0, 1.0, 0.3, 0.0)
"""Clearances to try between paths and walls, in units; the first that closes no path is used."""
STIR = 0.05
"""Share of the force with which idle robots stir, since standing still costs a revisit."""
STIRS = np.random.default_rng(0).uniform(-STIR, STIR, (4096, 2))
BERTH = 1.05
"""The distance of paths from parked robots, in safety distances."""
NOWHERE: Floats = np.zeros((0, 2))


class Greedy(Cautious):
    """Controls one team through one episode. A copy continues from the same state."""

    def __init__(self, problem: Problem, weather: Weather | None = None) -> None:
        super().__init__(problem, weather)
        self.settled: tuple[bytes, ...] = ()  # for which robots the queues are
        self.stirred = 0

    def act(
        self,
        positions: FloatArray,
        velocities: FloatArray,
        visited: Flags,
        failed: Flags | None = None,
    ) -> NDArray[np.float32]:
        """Return actions (n, 2) in [-1, 1]; those of failed robots are 0.

        Args:
            positions: (n, 2), units.
            velocities: (n, 2), units/step.
            visited: (m,), which ROIs have been visited.
            failed: (n,), which robots have failed; ``None``: none has.
        """
        places, speeds, works, plans = self._look(positions, velocities, failed)
        self._settle(places, visited, works, plans)
        actions = np.zeros((self.problem.n, 2), np.float32)
        for i in np.flatnonzero(works).tolist():
            changes = self._toward(i, speeds[i], self._wishes(i, places[i], visited))
            change, plans[i] = self._choose(i, places[i], speeds[i], changes, plans)
            actions[i] = self._action(i, change)
        self.before = speeds, actions.astype(float)
        return actions

    def _settle(
        self, positions: Floats, visited: Flags, works: Flags, plans: dict[int, Floats]
    ) -> None:
        """Assign the ROIs to the robots that work; repeat it when one fails or comes to rest."""
        ways = [plan for i, plan in plans.items() if not works[i]]
        resting = [way[-1] for way in ways if np.array_equal(way[-1], way[-2])]
        parked = np.array(resting).reshape(-1, 2)
        if (key := (works.tobytes(), parked.tobytes())) == self.settled:
            return
        self.settled = key
        self.roadmap = clear_roadmap(self.problem, positions, parked)
        self.queues = assign(self.roadmap, works, visited, self.problem.mine)

    def _wishes(self, i: int, position: Floats, visited: Flags) -> list[Floats]:
        left = [j for j in self.queues[i] if not visited[j]]
        if not left:
            stir = STIRS[self.stirred % len(STIRS)] * self.problem.forces[i]
            self.stirred += 1
            return [stir, -stir]
        goal = self.problem.n + left[0]
        return around(self._speed(i, self.roadmap.toward(position, goal) - position))

    def _speed(self, i: int, offset: Floats) -> Floats:
        """Return the highest velocity along ``offset`` from which robot i can stop at its end."""
        tau = self.problem.config.tau
        brake = np.maximum(self.problem.forces[i] - np.abs(self.problem.wind), 1e-3)
        far = np.abs(offset) / tau
        speed = 0.5 * (np.sqrt(brake**2 + 8.0 * brake * far) - brake)
        speed = np.minimum(speed, self.problem.drives[i].top)
        scale = np.min(speed[far > 1e-9] / far[far > 1e-9], initial=1.0)
        return np.asarray(offset / tau * scale)


def clear_roadmap(problem: Problem, positions: Floats, parked: Floats = NOWHERE) -> Roadmap:
    """Return the roadmap of the robots, then the ROIs, clear of walls and ``parked`` if possible.

    ``parked`` (k, 2) is where robots stand in the way, units.
    """
    places = np.concatenate([positions, problem.rois])
    outer = BERTH * problem.config.safety_distance / math.cos(math.pi / 16.0)
    taken = shapely.union_all(shapely.buffer(shapely.points(parked), outer, quad_segs=4))
    for clearance in CLEARANCES:
        area = problem.area.buffer(-clearance, join_style="mitre").difference(taken)
        if area.is_empty:
            continue
        roadmap = make_roadmap(area, places)
        if np.all(np.isfinite(roadmap.lengths[: len(places), : len(places)])):
            return roadmap
    return make_roadmap(problem.area, places)


def assign(roadmap: Roadmap, works: Flags, visited: Flags, mine: Flags) -> list[list[int]]:
    """Return a queue of ROIs for each robot; the earliest possible visit is always added next.

    ``mine`` (n, m): whether a robot may visit an ROI.
    """
    n = len(works)
    at, walked = list(range(n)), np.zeros(n)
    queues: list[list[int]] = [[] for _ in range(n)]
    able = works[:, None] & mine & ~visited
    while able.any():
        options = np.argwhere(able).tolist()
        total, i, j = min((walked[i] + roadmap.lengths[at[i], n + j], i, j) for i, j in options)
        queues[i].append(j)
        at[i], walked[i] = n + j, total
        able[:, j] = False
    return queues
