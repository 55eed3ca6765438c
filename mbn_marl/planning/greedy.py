"""The classical baseline: greedy assignment and a point-to-point controller that can always brake.

Each robot moves straight to the next corner or ROI, as fast as it can still stop there. It takes an
action only if it could then brake to rest inside the field and apart from the others, if they brake
too. Every step shows what the wind does.
"""

from __future__ import annotations

import math

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.engine.snapshot import FloatArray
from mbn_marl.planning.foresight import FORESEEN, Weather, ways_of_failed
from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.roadmap import Roadmap, make_roadmap

CLEARANCES = (4.0, 2.0, 1.0, 0.3, 0.0)
"""Clearances to try between paths and walls, in units; the first that closes no path is used."""
STIR = 0.05
"""Share of the force with which idle robots stir, since standing still costs a revisit."""
STIRS = np.random.default_rng(0).uniform(-STIR, STIR, (4096, 2))
BERTH = 1.05
"""How far paths stay away from robots that are parked, in safety distances."""
NOWHERE: Floats = np.zeros((0, 2))
TURNS = (0.0, 60.0, -60.0, 120.0, -120.0)
"""Directions to try in turn, in degrees from the wanted one."""
ESCAPES = np.array([(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0) if x or y])
"""Directions in which a robot leaves the way of one that has failed and does not stop."""


class Greedy:
    """Controls one team through one episode. A copy goes on from the same state.

    Args:
        problem: the instance; its ``starts`` do not matter.
        weather: what the team knows of the wind; by default the instance's.
    """

    def __init__(self, problem: Problem, weather: Weather | None = None) -> None:
        self.instance = self.problem = problem
        self.weather = weather or Weather(problem.wind)
        self.settled: tuple[bytes, ...] = ()  # for which robots the queues are
        self.before: tuple[Floats, Floats] | None = None  # velocities and actions of the last step
        self.stirred = 0
        shapely.prepare(problem.area)

    def act(
        self,
        positions: FloatArray,
        velocities: FloatArray,
        visited: NDArray[np.bool_],
        failed: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float32]:
        """Return actions (n, 2) in [-1, 1]; those of failed robots are 0.

        Args:
            positions: (n, 2), units.
            velocities: (n, 2), units/step.
            visited: (m,), which ROIs have been visited.
            failed: (n,), which robots have failed; ``None``: none has.
        """
        places, speeds = np.asarray(positions, float), np.asarray(velocities, float)
        works = np.ones(self.problem.n, bool) if failed is None else ~failed
        self._look(speeds, works)
        plans = self._plans(places, speeds, works)
        self._settle(places, visited, works, plans)
        actions = np.zeros((self.problem.n, 2), np.float32)
        for i in np.flatnonzero(works).tolist():
            others = [plan for j, plan in plans.items() if j != i]
            wishes = self._wishes(i, places[i], visited)
            change, plans[i] = self._choose(i, places[i], speeds[i], wishes, others)
            force = (change - self.weather.push) / self.instance.forces[i]
            actions[i] = np.clip(force, -1.0, 1.0)
        self.before = speeds, actions.astype(float)
        return actions

    def _look(self, velocities: Floats, works: NDArray[np.bool_]) -> None:
        """Find out from the last step what the wind does."""
        if self.before is not None:
            self.weather = self.weather.after(self.instance, *self.before, velocities, works)
            self.problem = self.weather.problem(self.instance)

    def _plans(
        self, positions: Floats, velocities: Floats, works: NDArray[np.bool_]
    ) -> dict[int, Floats]:
        """Return the ways (k, 2) of all robots that have not vanished if those that work brake."""
        ways = ways_of_failed(self.instance, positions, velocities, works, self.weather.push)
        for i in np.flatnonzero(works).tolist():
            ways[i] = self._coast(i, positions[i], velocities[i])
        return ways

    def _settle(
        self,
        positions: Floats,
        visited: NDArray[np.bool_],
        works: NDArray[np.bool_],
        plans: dict[int, Floats],
    ) -> None:
        """Assign the ROIs to the robots that work; repeat it when one fails or comes to rest."""
        ways = [plan for i, plan in plans.items() if not works[i]]
        resting = [way[-1] for way in ways if np.array_equal(way[-1], way[-2])]
        parked = np.array(resting).reshape(-1, 2)
        if (key := (works.tobytes(), parked.tobytes())) == self.settled:
            return
        self.settled = key
        self.roadmap = clear_roadmap(self.problem, positions, parked)
        self.queues = assign(self.roadmap, works, visited)

    def _wishes(self, i: int, position: Floats, visited: NDArray[np.bool_]) -> list[Floats]:
        """Return the velocities for robot i to try, the best first."""
        left = [j for j in self.queues[i] if not visited[j]]
        if not left:
            stir = STIRS[self.stirred % len(STIRS)] * self.problem.forces[i]
            self.stirred += 1
            return [stir, -stir]
        goal = self.problem.n + left[0]
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
        for _ in range(FORESEEN):
            velocity = np.clip(velocity + self._within_force(i, -velocity), -top, top)
            position = position + velocity * self.problem.config.tau
            path.append(position)
            if not velocity.any():
                break
        return np.array(path)

    def _choose(
        self, i: int, place: Floats, speed: Floats, wishes: list[Floats], others: list[Floats]
    ) -> tuple[Floats, Floats]:
        """Return the change of robot i's velocity, and its way if it brakes after that.

        It is the first after which it can brake clear of walls and of the ``others``' ways; if a
        failed robot leaves none, the one that keeps the farthest away.
        """
        top = self.problem.drives[i].top
        best, widest = (self._within_force(i, -speed), self._coast(i, place, speed)), -1.0
        for wanted in (*wishes, np.zeros(2), *(0.5 * top * ESCAPES)):
            change = self._within_force(i, wanted - speed)
            velocity = np.clip(speed + change, -top, top)
            position = place + velocity * self.problem.config.tau
            path = np.concatenate([position[None], self._coast(i, position, velocity)])
            room = self._room(path, others)
            if room > widest:
                best, widest = (change, path), room
            if room >= self.problem.config.safety_distance * 1.01:
                break
        return best

    def _room(self, path: Floats, others: list[Floats]) -> float:
        """Return how close a path comes to the other paths, in units; -1 if it leaves the field."""
        if not np.all(shapely.intersects_xy(self.problem.area, path[:, 0], path[:, 1])):
            return -1.0
        room = np.inf
        for other in others:
            steps = np.arange(max(len(path), len(other)))
            mine = path[np.minimum(steps, len(path) - 1)]
            apart = mine - other[np.minimum(steps, len(other) - 1)]
            room = min(room, float(np.min(np.hypot(apart[:, 0], apart[:, 1]))))
        return room


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


def assign(
    roadmap: Roadmap, works: NDArray[np.bool_], visited: NDArray[np.bool_]
) -> list[list[int]]:
    """Return a queue of ROIs for each robot; the earliest possible visit is always added next.

    Robots that do not work (n,) have none, ROIs that have been visited (m,) are in none.
    """
    n = len(works)
    at, walked = list(range(n)), np.zeros(n)
    queues: list[list[int]] = [[] for _ in range(n)]
    left = set(np.flatnonzero(~visited).tolist()) if works.any() else set()
    while left:
        total, i, j = min(
            (walked[i] + roadmap.lengths[at[i], n + j], i, j)
            for i in range(n)
            if works[i]
            for j in left
        )
        queues[i].append(j)
        at[i], walked[i] = n + j, total
        left.remove(j)
    return queues


def _turn(vector: Floats, angle: float) -> Floats:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])
