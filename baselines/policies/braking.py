"""Robots that can brake clear of each other if all do so, by what each one observes."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.engine import BatchEngine
from mbn_marl.engine.mdp.entities import SCALES
from mbn_marl.engine.mdp.observations import Entry
from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.shield import MARGIN, Flags

# The share of a safety distance that robots keep from the middle between two of them.
BERTH = 1.03
# Directions (degrees) and shares of the wanted velocity to try in turn, then directions to leave.
TURNS = ((0, 1.0), (0, 0.5), (0, 0.25), (60, 0.5), (-60, 0.5), (100, 0.5), (-100, 0.5), (0, 0.0))
ESCAPES = np.radians(np.arange(8) * 45.0)
ESCAPE_SHARE = 0.5  # of the speed limit


class Braking:
    """Reads rows of an observation; chooses velocities from which robots can brake.

    They brake inside the field and, in each step, on their side of the middle between where two
    robots were if both braked now: buffered Voronoi cells (Zhou et al., 2017) of braking robots.
    ``entities`` does not show a robot its place, so walls are not tested there. A wall stops a
    robot sooner than it brakes, so another one can then hit it. So can robots that see each other
    too late to brake.
    """

    def __init__(self, problem: Problem, table: Iterable[Entry], team: int) -> None:
        self.problem = problem
        at = {entry.name: entry.offset for entry in table}
        self._soft = "own_x" not in at
        self._walled = not self._soft
        axes = (*(("near_x", "near_y") if self._soft else ("dx", "dy")), "dvx", "dvy")
        others = [[at[f"other_{k}_{axis}"] for axis in axes] for k in range(1, team)]
        self._others = np.array(others, int).reshape(-1, 4)
        self._own = [] if self._soft else [at["own_x"], at["own_y"]]
        self._motion = [at["own_vx"], at["own_vy"]]
        self._arena = np.array(problem.field.arena)
        corners = (
            problem.field.vertices if "roi_0_ux" in at else np.array([[0.0, 0.0], self._arena])
        )
        self._centre = (corners.min(0) + corners.max(0)) / 2.0
        self._top = problem.config.top_speed
        # All brake with the least force of the team: none knows which of the others has more.
        self._brake = problem.forces.min(0)
        # If the field's team is not the largest, teams vary, and unequal limits are refused.
        self._forces = np.resize(problem.forces, (team, 2))
        self._limits = np.resize([drive.top for drive in problem.drives], (team, 1))
        shapely.prepare(problem.area)

    def _read(self, rows: Floats) -> tuple[Floats, Floats, Floats, Floats, Flags]:
        """Return places, velocities, those of the others, and which of them are seen.

        A robot that does not see its place is at 0.
        """
        offsets, turns = np.split(rows[:, self._others], 2, axis=-1)
        there: Flags = (offsets != 0.0).any(-1)
        speed = rows[:, self._motion] * self._top
        if self._soft:
            place = np.zeros((len(rows), 2))
            offsets = SCALES[0] * offsets / (1.0 - np.abs(offsets))
        else:
            place = self._centre + rows[:, self._own] * self._arena / 2.0
            offsets = offsets * self._arena
        moves = speed[:, None] + turns * 2.0 * self._top
        return place, speed, place[:, None] + offsets, moves, there

    def _choose(
        self,
        place: Floats,
        speed: Floats,
        wanted: Floats,
        others: Floats,
        moves: Floats,
        there: Flags,
        robots: NDArray[np.int64],
    ) -> Floats:
        """Return the change of each row's velocity: the first after which its robot can brake."""
        change = -np.clip(speed, -self._brake, self._brake)
        force, top = self._forces[robots], self._limits[robots]
        # Two robots in sight of each other derive the same middles. If both choices keep to their
        # sides, they and the brakings after them are apart in each step. The rest of those is what
        # both would do if they braked in the next step: so braking passes again, and none collide.
        rest = self._way(place, self._braked(speed))
        middle = self._way(others, self._braked(moves)) - rest[:, None]
        apart = np.maximum(np.linalg.norm(middle, axis=-1), 1e-9)
        toward = middle / apart[..., None]
        room = (apart - BERTH * self.problem.config.safety_distance) / 2.0
        room[~there] = np.inf
        rows = np.arange(len(place))
        turns = [(share * np.exp(1j * np.radians(angle)), 0.0) for angle, share in TURNS]
        turns += [(0.0, ESCAPE_SHARE * np.exp(1j * angle)) for angle in ESCAPES]
        for turn, own in turns:
            asked = turn * (wanted[rows] @ np.array([1.0, 1.0j])) + own * top[rows, 0]
            aim = np.stack([asked.real, asked.imag], -1)
            step = np.clip(aim - speed[rows], -force[rows], force[rows])
            way = self._way(place[rows], np.clip(speed[rows] + step, -top[rows], top[rows]))
            beside = np.einsum("rkta,rta->rkt", toward[rows], way - rest[rows])
            safe = (beside <= room[rows]).all((1, 2))
            safe &= self._inside(way.reshape(-1, 2)).reshape(len(rows), -1).all(1)
            change[rows[safe]] = step[safe]
            rows = rows[~safe]
            if not len(rows):
                break
        return change

    def _braked(self, speed: Floats) -> Floats:
        slower: Floats = speed - np.clip(speed, -self._brake, self._brake)
        return slower

    def _way(self, place: Floats, speed: Floats) -> Floats:
        """Return (.., T, 2): places after this step at ``speed``, and while braking after it."""
        way = []
        for _ in range(int(np.ceil(self._top / self._brake.min())) + 1):
            place = place + speed * self.problem.config.tau
            speed = self._braked(speed)
            way.append(place)
        return np.stack(way, -2)

    def _inside(self, places: Floats) -> Flags:
        if not self._walled:
            return np.ones(len(places), bool)
        if self.problem.convex:
            normals, limits = self.problem.half_planes
            return np.asarray((places @ normals.T <= limits + 1e-6).all(-1), bool)
        return np.asarray(shapely.intersects_xy(self.problem.area, *places.T), bool)


class OwnShield(Braking):
    """Replaces actions after which robots could no longer brake; each by its own row alone.

    Where fields vary, robots do not know theirs, so walls are not tested there either.
    """

    def __init__(self, problem: Problem, engine: BatchEngine) -> None:
        inner = problem.area.buffer(-MARGIN, join_style="mitre")
        super().__init__(replace(problem, area=inner), engine.observation_table, engine.n_robots)
        self._walled &= len(engine.fields) == 1

    def act(self, actions: NDArray[np.float32], seen: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions (worlds, n, 2) for observations (worlds, n, size)."""
        sight = self._read(seen.reshape(-1, seen.shape[-1]).astype(float))
        robots = np.arange(len(sight[0])) % actions.shape[1]
        force = self._forces[robots]
        asked = np.clip(actions.reshape(-1, 2), -1.0, 1.0) * force
        place, speed, others, moves, there = sight
        change = self._choose(place, speed, speed + asked, others, moves, there, robots)
        same = (np.abs(change - asked) < 1e-9).all(-1, keepdims=True)
        taken = np.where(same, actions.reshape(-1, 2), change / force)
        return taken.reshape(actions.shape).astype(np.float32)
