"""Estimates of the wind, and of where failed robots will be."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.planning.problem import CALM, Floats, Problem

Flags = NDArray[np.bool_]

FORESEEN = 60
"""Steps in which a robot that never rests is foreseen."""
TINY = 1e-200
"""Below any change of velocity; units/step per step."""
DISTURBED = 0.1
"""Pushes on robots that differ by more than this, units/step per step, are not the wind's."""
GUST_MEMORY = 10
"""Steps without wind that the mean of pushes in gusts begins with."""
GUST_SHARE = 0.6
"""Share of the force to count on in gusts; the rest is for holding out against them."""


@dataclass(frozen=True, eq=False)
class Weather:
    """The pushes on the team so far, estimated from its changes of velocity."""

    push: Floats  # (2,), in the last step, units/step per step
    gusty: bool = False  # whether it has changed
    count: int = 0
    total: Floats = field(default_factory=lambda: np.zeros(2))  # (2,), the sum of all pushes

    def after(
        self,
        problem: Problem,
        before: Floats,
        actions: Floats,
        now: Floats,
        works: Flags,
    ) -> Weather:
        """Return the weather after a step with ``actions`` from velocities ``before`` to ``now``.

        All are (n, 2); ``works`` (n,) leaves out robots that have failed. Robots at rest or at the
        speed limit show nothing: a wall may have stopped them.
        """
        tops = np.array([[drive.top] for drive in problem.drives])
        shown = works[:, None] & (np.abs(now) < tops) & now.any(axis=1, keepdims=True)
        found, push = now - before - actions * problem.forces, self.push.copy()
        for axis in (0, 1):
            pushes = found[shown[:, axis], axis]
            if len(pushes) and np.ptp(pushes) < DISTURBED:
                push[axis] = np.median(pushes)
        if np.abs(push - self.push).max() < CALM:
            push = self.push
        gusty = self.gusty or (self.count > 0 and push is not self.push)
        return Weather(push, gusty, self.count + 1, self.total + push)

    def problem(self, problem: Problem, share: float = GUST_SHARE) -> Problem:
        """Return the instance to plan for: in gusts with their mean, and a share of the force."""
        if not self.gusty:
            return problem.in_wind(self.push)
        mean = self.total / (self.count + GUST_MEMORY)
        return problem.in_wind(mean, share)


def ways_of_failed(
    problem: Problem, places: Floats, speeds: Floats, works: Flags, push: Floats
) -> dict[int, Floats]:
    """Return where the robots that have failed, but not vanished, will be.

    Args:
        problem: the instance, with its failures.
        places: (n, 2), of all robots, units.
        speeds: (n, 2), units/step.
        works: (n,), which have not failed.
        push: (2,), of the wind, units/step per step.

    Returns:
        By robot (k, 2), units: the positions after the next k steps, until all of them rest, or
        FORESEEN of robots that coast.
    """
    kind = problem.config.failures.kind if problem.config.failures else "brake"
    failed = ~works & (kind != "vanish")
    steps = FORESEEN
    if kind == "brake":
        steps = steps_to_rest(speeds[failed], problem.forces[failed], problem.config.max_steps)
    numbers = np.flatnonzero(failed).tolist()
    return {i: _way(problem, i, kind, places[i], speeds[i], push, steps) for i in numbers}


def steps_to_rest(velocities: Floats, slower: Floats, most: int) -> int:
    """Return a number of steps after which all velocities are 0, or the episode has ended.

    Args:
        velocities: (..., 2), units/step.
        slower: (..., 2), >= 0: by as much the velocities fall in each step.
        most: the steps of an episode.
    """
    needed = np.abs(velocities) / np.maximum(slower, TINY)
    return math.floor(min(float(needed.max(initial=0.0)), most)) + 2


def _way(
    problem: Problem, i: int, kind: str, place: Floats, speed: Floats, push: Floats, steps: int
) -> Floats:
    force, top = problem.forces[i], problem.drives[i].top
    way = np.empty((steps, 2))
    for k in range(steps):
        braked = speed - np.clip(speed, -force, force)
        speed = np.clip(speed + push, -top, top) if kind == "coast" else braked
        ahead = place + speed * problem.config.tau
        if shapely.intersects_xy(problem.area, *ahead):
            place = ahead
        else:
            speed = np.zeros(2)
        way[k] = place
    return way
