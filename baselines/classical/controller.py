"""Policies without learning: the greedy controller, and the planner in closed loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from baselines.evaluation.policy import Policy
from mbn_marl.config import make_config
from mbn_marl.errors import MbnError, unknown
from mbn_marl.field import Field
from mbn_marl.planning import Plan, plan
from mbn_marl.planning.greedy import Greedy
from mbn_marl.planning.problem import Floats, Problem, make_problem
from mbn_marl.planning.tracking import Tracker

CLASSICAL = ("greedy", "planner")
"""The names of these policies."""
Controller = Greedy | Tracker


class ControllerPolicy:
    """A controller for each world, which ``begin`` makes of its starts (n, 2); equal ones share."""

    observes: Literal["observations", "state"] = "state"
    samples = False

    def __init__(self, problem: Problem, begin: Callable[[Floats], Controller]) -> None:
        self.problem, self.begin = problem, begin
        self._groups: dict[bytes, Controller] = {}
        self._of_world: list[bytes] = []

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Return actions (worlds, n, 2) for states (worlds, 4n+1); nothing is sampled."""
        n, m = self.problem.n, self.problem.m
        positions = seen[:, : 2 * n].reshape(-1, n, 2)
        velocities = seen[:, 2 * n : 4 * n].reshape(-1, n, 2)
        codes = seen[:, -1].astype(np.int64)
        visited = (codes[:, None] >> np.arange(m - 1, -1, -1) & 1).astype(bool)
        self._of_world += [b""] * (len(seen) - len(self._of_world))
        fresh = ~velocities.any(axis=(1, 2)) & (codes == 0)
        begun = set()
        actions = np.empty((len(seen), n, 2), np.float32)
        chosen: dict[bytes, NDArray[np.float32]] = {}
        for world, row in enumerate(seen):
            if fresh[world] or not self._of_world[world]:
                key = self._of_world[world] = row.tobytes()
                if key not in begun:
                    self._groups[key] = self.begin(positions[world].astype(float))
                    begun.add(key)
            key = self._of_world[world]
            if key not in chosen:
                state = positions[world], velocities[world], visited[world]
                chosen[key] = self._groups[key].act(*state)
            actions[world] = chosen[key]
        return actions


def make_classical(
    name: str, field: Field, settings: Mapping[str, Any], *, time_limit: float = 60.0
) -> Policy:
    """Return one of :data:`CLASSICAL` for a field; the planner may take ``time_limit`` seconds.

    Raises:
        MbnError: there is no such policy, or the planner found no plan.
    """
    problem = make_problem(field, make_config(settings), closed_loop=name == "greedy")
    if name == "greedy":
        return ControllerPolicy(problem, lambda positions: Greedy(problem, positions))
    if name != "planner":
        raise MbnError(f"{name}: {unknown('policy', name, CLASSICAL)}")
    found = plan(field, time_limit=time_limit, **settings)
    return ControllerPolicy(problem, lambda _: make_tracker(found, settings))


def make_tracker(found: Plan, settings: Mapping[str, Any]) -> Tracker:
    """Return a tracker that follows a plan for one episode, under the settings it was made for.

    Raises:
        MbnError: no plan was found.
    """
    if found.makespan is None:
        raise MbnError(f"{found.field.name}: no plan was found within the time limit")
    return Tracker(make_problem(found.field, make_config(settings)), found)
