"""A team that follows a plan, and plans again whenever the world leaves it."""

from __future__ import annotations

import itertools
import math
from copy import copy
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from mbn_marl.engine.snapshot import FloatArray
from mbn_marl.planning.greedy import Greedy
from mbn_marl.planning.legs import proved_legs
from mbn_marl.planning.motion import coordinate
from mbn_marl.planning.orders import OutOfTimeError
from mbn_marl.planning.partition import FEW_ROIS
from mbn_marl.planning.planner import Plan
from mbn_marl.planning.problem import CALM, Floats, Problem
from mbn_marl.planning.shield import GUST_SHARE, Flags, Weather, ways_of_failed
from mbn_marl.planning.team import Team, make_guide

TUBE = 3.0
"""A plan is followed while every robot is within this of its place, along each axis, in units."""
CARE = ((GUST_SHARE, 0.3), (0.8, 0.1), (1.0, 0.0))
"""Shares of the force to plan with in gusts, and room to discs, walls and each other, in ROI radii.

The first with which there is a plan is used.
"""
STRIDE, TRIES = 1.05, 16
"""Makespans are tried from the bound of single legs on, each this many times the one before."""
PARTITIONS = 2
"""Partitions of the ROIs that are tried at one makespan."""
TIME_LIMIT = 3.0
"""Of one plan, in seconds; the slowest of the catalogue's took 1.3."""
POSITION_GAIN, VELOCITY_GAIN = 0.3, 0.9
"""Gains of a quick, well-damped loop: change of velocity per lag in position and velocity."""
EXACT = 1e-3
"""Deviations below this, in units, are rounding and are not corrected."""
RESERVE = 0.9
"""Share of the force left by the wind that a slower reference uses; the loop has the rest."""
SLOWEST = 0.2
PATIENCE = 20
"""Steps of the greedy controller where no plan was found, before the next try."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The motions of all robots from now on, for T steps; failed ones too."""

    path: Floats  # (T + 1, n, 2), units
    speeds: Floats  # (T + 1, n, 2), units/step
    efforts: Floats  # (T, n, 2), the actions if there were no wind
    due: NDArray[np.int64]  # (m,), the step at which each ROI is closest
    works: Flags  # (n,)
    weather: Weather  # for which it was made

    def holds(
        self, step: int, places: Floats, visited: Flags, works: Flags, weather: Weather
    ) -> bool:
        """Return whether the world is as it was to be after ``step`` steps."""
        steady = np.abs(weather.push - self.weather.push).max() < CALM
        return bool(
            step < len(self.efforts)
            and np.array_equal(works, self.works)
            and np.abs(self.path[step] - places).max() <= TUBE
            and not np.any((step > self.due) & ~visited)
            and weather.gusty == self.weather.gusty
            and (weather.gusty or steady)
        )


class Replanner:
    """Controls one team through one episode, from a plan for the problem without wind.

    A copy continues from the same state.
    """

    def __init__(self, problem: Problem, found: Plan) -> None:
        self.problem, self.weather = problem, Weather(problem.wind)
        self.before: tuple[Floats, Floats] | None = None  # velocities and actions of the last step
        self.rest = Greedy(problem)  # for where there is no plan
        self.step = 0
        works = np.ones(problem.n, bool)
        first = self._motion(found.trail, np.zeros((problem.n, 2)), works)
        self.motion: Motion | None = replace(first, efforts=found.actions.astype(float))

    def act(
        self,
        positions: FloatArray,
        velocities: FloatArray,
        visited: Flags,
        failed: Flags | None = None,
    ) -> NDArray[np.float32]:
        """Return actions (n, 2) in [-1, 1]; arguments as for :meth:`Greedy.act`."""
        places, speeds = np.asarray(positions, float), np.asarray(velocities, float)
        works = np.ones(self.problem.n, bool) if failed is None else ~failed
        if self.before is not None:
            self.weather = self.weather.after(self.problem, *self.before, speeds, works)
        now = self.step, places, visited, works, self.weather
        if not (self.motion.holds(*now) if self.motion else self.step < PATIENCE):
            self.motion, self.step = self._plan(places, speeds, visited, works), 0
            self.rest = Greedy(self.problem, self.weather)
        if self.motion is None:
            self.rest = copy(self.rest)
            actions = self.rest.act(places, speeds, visited, failed)
        else:
            actions = self._follow(self.motion, places, speeds)
        self.step += 1
        self.before = speeds, actions.astype(float)
        return actions

    def _follow(self, motion: Motion, places: Floats, speeds: Floats) -> NDArray[np.float32]:
        forces, k = self.problem.forces, self.step
        wanted = motion.efforts[k] - self.weather.push / forces
        lag, slip = motion.path[k] - places, motion.speeds[k] - speeds
        return corrected(self.problem, wanted, lag, slip) * motion.works[:, None]

    def _plan(self, places: Floats, speeds: Floats, visited: Flags, works: Flags) -> Motion | None:
        left = np.flatnonzero(~visited)
        if not works.any() or not 0 < len(left) <= FEW_ROIS:
            return None
        ways = ways_of_failed(self.problem, places, speeds, works, self.weather.push)
        for share, margin in CARE if self.weather.gusty else CARE[-1:]:
            whole = self.weather.problem(self.problem, share)
            rest = replace(
                whole.only(left.tolist()),
                starts=places[works],
                velocities=speeds[works],
                mine=whole.mine[works][:, left],
                forces=whole.forces[works],
                tops=whole.tops[works],
                others=np.array([*ways.values()]) if ways else whole.others,
            )
            paths = search(rest, margin * rest.config.roi_radius)
            if paths is not None:
                path = np.repeat(places[None], paths.shape[1] + 1, axis=0)
                path[1:, works] = paths.swapaxes(0, 1)
                path[1:, list(ways)] = rest.others_for(paths.shape[1]).swapaxes(0, 1)
                return self._motion(path, speeds, works)
        return None

    def _motion(self, path: Floats, speeds: Floats, works: Flags) -> Motion:
        after = np.diff(path, axis=0) / self.problem.config.tau
        reached = np.concatenate([speeds[None], after])
        efforts = np.diff(reached, axis=0) / self.problem.forces
        far = nearest(self.problem, path)
        return Motion(path, reached, efforts, far.argmin(axis=0), works, self.weather)


def nearest(problem: Problem, path: Floats) -> Floats:
    """Return the least distances, (T, m), from each ROI to robots that may visit it, units.

    ``path`` has the robots' positions, (T, n, 2), units.
    """
    apart = np.linalg.norm(path[:, :, None] - problem.rois, axis=-1)
    return np.asarray(np.where(problem.mine, apart, np.inf).min(axis=1))


def search(problem: Problem, margin: float) -> Floats | None:
    """Return paths (n, T, 2) of a short plan, units, or ``None``.

    Where it can, it keeps a ``margin`` to the discs, the walls and other robots, in units.
    """
    area = problem.area.buffer(-margin, join_style="mitre")
    if not isinstance(area, shapely.Polygon) or area.is_empty:
        return None
    config = problem.config
    room = {
        "roi_radius": config.roi_radius - margin,
        "safety_distance": config.safety_distance + margin,
    }
    inner = replace(problem, area=area, config=config.model_copy(update=room))
    deadline, horizon = problem.clock(0) + TIME_LIMIT, config.max_steps
    if problem.convex:
        team = Team(inner, proved_legs(inner, 0.0, horizon), 0.0, horizon, deadline)
    else:
        team = make_guide(inner, horizon, deadline)
    steps = team.least_makespan()
    try:
        for _ in range(TRIES):
            if steps > horizon or problem.clock(0) > deadline:
                break
            for routes in itertools.islice(team.solutions(steps), PARTITIONS):
                verify = partial(_verified, problem)
                if (paths := coordinate(inner, verify, steps, routes, deadline)) is not None:
                    return paths
            steps = max(steps + 1, math.ceil(STRIDE * steps))
    except OutOfTimeError:
        pass
    return None


def _verified(problem: Problem, paths: Floats, _: NDArray[np.float32]) -> Floats | None:
    """Return the paths (n, T, 2) if they stay in the area, visit every ROI, and nobody collides."""
    config = problem.config
    ways = np.concatenate([paths, problem.others_for(paths.shape[1])])
    i, j = np.triu_indices(len(ways), 1)
    own = i < problem.n  # pairs of robots in the way are not the team's
    apart = np.linalg.norm(ways[i[own]] - ways[j[own]], axis=-1)
    near = nearest(problem, paths.swapaxes(0, 1)).min(axis=0)
    good = (
        shapely.intersects_xy(problem.area, paths[..., 0], paths[..., 1]).all()
        and np.all(apart >= config.safety_distance)
        and np.all(near <= config.roi_radius)
    )
    return paths if good else None


def corrected(problem: Problem, actions: Floats, lag: Floats, slip: Floats) -> NDArray[np.float32]:
    """Return actions that also make up for a lag in position and a slip in velocity, (n, 2)."""
    lag, slip = (np.where(np.abs(one) < EXACT, 0.0, one) for one in (lag, slip))
    change = POSITION_GAIN * lag / problem.config.tau + VELOCITY_GAIN * slip
    return np.clip(actions + change / problem.forces, -1.0, 1.0).astype(np.float32)


class Tracker:
    """Follows a plan for one team through one episode; a greedy controller visits what is left.

    The first step reveals the wind. In another wind than the problem's, the plan is followed more
    slowly, as the remaining force requires, still with a step at every planned visit.
    """

    def __init__(self, problem: Problem, plan: Plan) -> None:
        self.problem, self.plan = problem, plan
        self.step = 0
        self.rest: Greedy | None = None
        self._follow(np.arange(len(plan.trail), dtype=float))
        self.actions: Floats = plan.actions.astype(float)

    def act(
        self, positions: FloatArray, velocities: FloatArray, visited: Flags, failed: Flags
    ) -> NDArray[np.float32]:
        """Return actions (n, 2) in [-1, 1]; arguments as for :meth:`Greedy.act`."""
        problem, k = self.problem, self.step
        self.step += 1
        if k == 1:
            self._notice_wind(velocities)
        if k + 1 >= len(self.path):
            self.rest = Greedy(problem) if self.rest is None else copy(self.rest)
            return self.rest.act(positions, velocities, visited, failed)
        lag, slip = self.path[k] - positions, self.speeds[k] - velocities
        return corrected(problem, self.actions[k], lag, slip)

    def _follow(self, times: Floats) -> None:
        steps = np.arange(len(self.plan.trail), dtype=float)
        self.path: Floats = CubicSpline(steps, self.plan.trail)(times)
        moved = np.diff(self.path, axis=0, prepend=self.path[:1])
        self.speeds: Floats = moved / self.problem.config.tau
        changes = np.diff(self.speeds, axis=0) - self.problem.wind
        self.actions = changes / self.problem.forces

    def _notice_wind(self, velocities: FloatArray) -> None:
        """After the first step, slow the plan down to what the wind allows."""
        planned = self.problem
        wind = (velocities - self.plan.actions[0] * planned.forces).mean(axis=0)
        if np.abs(wind - planned.wind).max() < CALM:
            return
        self.problem = planned.in_wind(wind)
        used = np.abs(np.diff(self.speeds, axis=0)).max(axis=0)
        left = RESERVE * (planned.forces - np.abs(self.problem.wind))
        share = float(np.min(left / np.maximum(used, 1e-9)))
        pace = min(max(share, 0.0) ** 0.5, 1.0)
        self._follow(self._times(max(pace, SLOWEST)))

    def _times(self, pace: float) -> Floats:
        """Return the plan's times, slower from step 1 on, with a step at each visit."""
        marks = np.unique([0, 1, *self.plan.visit_steps, len(self.plan.trail) - 1])
        times = [np.array([0.0])]
        for first, last in itertools.pairwise(marks.tolist()):
            count = int(np.ceil((last - first) / (1.0 if first == 0 else pace)))
            times.append(np.linspace(first, last, count + 1)[1:])
        return np.concatenate(times)


class Replay:
    """Takes a plan's actions, then none, whatever happens. A copy continues from the same state."""

    def __init__(self, problem: Problem, plan: Plan) -> None:
        self.actions, self.step = plan.actions, 0

    def act(self, *state: FloatArray | Flags) -> NDArray[np.float32]:
        k, self.step = self.step, self.step + 1
        return self.actions[k] if k < len(self.actions) else np.zeros_like(self.actions[0])
