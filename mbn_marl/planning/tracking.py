"""A plan in closed loop: it is followed from any positions, in any wind."""

from __future__ import annotations

import itertools
from copy import copy

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from mbn_marl.engine.snapshot import FloatArray
from mbn_marl.planning.greedy import Greedy
from mbn_marl.planning.planner import Plan
from mbn_marl.planning.problem import Floats, Problem

POSITION_GAIN, VELOCITY_GAIN = 0.3, 0.9
"""Gains of a quick, well-damped loop: change of velocity per lag in position and velocity."""
EXACT = 1e-3
"""Deviations below this, in units, are rounding and are not corrected."""
RESERVE = 0.9
"""Share of the force left by the wind that a slower reference uses; the loop has the rest."""
SLOWEST = 0.2


def corrected(problem: Problem, actions: Floats, lag: Floats, slip: Floats) -> NDArray[np.float32]:
    """Return actions (n, 2) that also make up for a lag and a slip.

    These are by how much positions and velocities fall short of what was planned, (n, 2) each,
    units and units/step.
    """
    lag, slip = (np.where(np.abs(one) < EXACT, 0.0, one) for one in (lag, slip))
    change = POSITION_GAIN * lag / problem.config.tau + VELOCITY_GAIN * slip
    return np.clip(actions + change / problem.forces, -1.0, 1.0).astype(np.float32)


class Tracker:
    """Follows a plan for one team through one episode; a greedy controller visits what is left.

    The first step reveals the wind. In another wind than the planned one, the plan is followed more
    slowly, as the remaining force requires, still with a step at every planned visit.

    Args:
        problem: the instance, with the wind that the plan was made for.
        plan: a plan with a makespan.
    """

    def __init__(self, problem: Problem, plan: Plan) -> None:
        self.problem, self.plan = problem, plan
        self.step = 0
        self.rest: Greedy | None = None
        self._follow(np.arange(len(plan.trail), dtype=float))
        self.actions: Floats = plan.actions.astype(float)

    def act(
        self,
        positions: FloatArray,
        velocities: FloatArray,
        visited: NDArray[np.bool_],
        failed: NDArray[np.bool_],
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
        """Make the plan's positions at ``times``, in steps of the plan, the reference."""
        steps = np.arange(len(self.plan.trail), dtype=float)
        self.path: Floats = CubicSpline(steps, self.plan.trail)(times)
        moved = np.diff(self.path, axis=0, prepend=self.path[:1])
        self.speeds: Floats = moved / self.problem.config.tau
        changes = np.diff(self.speeds, axis=0) - self.problem.wind
        self.actions = changes / self.problem.forces

    def _notice_wind(self, velocities: FloatArray) -> None:
        """After the first step, slow the plan down to what the wind allows."""
        planned = self.problem
        self.problem = planned.with_wind(velocities, self.plan.actions[0])
        if self.problem is planned:
            return
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
