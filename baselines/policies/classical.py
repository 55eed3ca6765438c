"""Policies without learning: greedy ones, and those that follow a plan."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from baselines.policies.policy import Policy
from mbn_marl.config import NavigationConfig, make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.engine.mdp.disturbances import OF_ACTIONS, OF_SIGHT
from mbn_marl.episode.recorder import find_engine
from mbn_marl.errors import MbnError
from mbn_marl.field import Field

if TYPE_CHECKING:  # the planner's packages are an extra
    from mbn_marl.planning import Plan
    from mbn_marl.planning.greedy import Greedy
    from mbn_marl.planning.problem import Problem
    from mbn_marl.planning.replanning import Replanner, Replay, Tracker

    Controller = Greedy | Tracker | Replanner | Replay

Empty = tuple[int, ...]
# The names of these policies, and what they want of the environment.
CLASSICAL: Mapping[str, Mapping[str, Any]] = {
    **{"greedy": {}, "planner": {}, "replan": {}, "open-loop": {}},
    **{name: {"observation": "lidar_local"} for name in ("greedy-local", "blind")},
}
# Settings that ``replan`` does not plan with: it finds out.
UNSEEN = ("wind", "gust", "gust_time", "failures", *OF_ACTIONS, *OF_SIGHT)


class NoPlanError(MbnError):
    """The planner found no plan in time."""


class ControllerPolicy(Policy):
    """A controller for each world, from ``begin``; worlds share one while they are the same."""

    observes = "state"

    def __init__(self, problem: Problem, begin: Callable[[Empty], Controller]) -> None:
        self.problem, self.begin = problem, begin
        self._of_world: list[Controller | None] = []

    def fit(self, engine: BatchEngine) -> Policy:
        one = copy(self)
        one._of_world = []
        return one

    def act_in(self, world: Any, observations: Any, *, deterministic: bool = True) -> Any:
        # The state does not say which ROIs are empty.
        empty = find_engine(world).decoys[:, : self.problem.m]
        return self._act(np.atleast_2d(world.state()), empty)

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Return actions (worlds, n, 2) for states (worlds, 4n+1), or (worlds, 5n+1) with flags."""
        return self._act(seen, np.zeros((len(seen), self.problem.m), bool))

    def _act(self, seen: np.ndarray, empty: NDArray[np.bool_]) -> np.ndarray:
        n, m = self.problem.n, self.problem.m
        positions = seen[:, : 2 * n].reshape(-1, n, 2)
        velocities = seen[:, 2 * n : 4 * n].reshape(-1, n, 2)
        codes = seen[:, -1].astype(np.int64)
        visited = (codes[:, None] >> np.arange(m - 1, -1, -1) & 1).astype(bool) | empty
        failed = np.zeros((len(seen), n), bool)
        if seen.shape[1] > 4 * n + 1:
            failed = seen[:, 4 * n : -1] > 0
        fresh = ~velocities.any(axis=(1, 2)) & (codes == 0)
        before = self._of_world + [None] * (len(seen) - len(self._of_world))
        actions = np.empty((len(seen), n, 2), np.float32)
        chosen: dict[tuple[int, bytes], tuple[Controller, NDArray[np.float32]]] = {}
        for world, row in enumerate(seen):
            last = None if fresh[world] else before[world]
            key = id(last), row.tobytes() + visited[world].tobytes()
            if key not in chosen:
                state = positions[world], velocities[world], visited[world], failed[world]
                rois = tuple(np.flatnonzero(empty[world]).tolist())
                controller = self.begin(rois) if last is None else copy(last)
                chosen[key] = controller, controller.act(*state)
            before[world], actions[world] = chosen[key]
        self._of_world = before
        return actions

    def draws(self, *, deterministic: bool) -> bool:
        return False


def make_classical(name: str, field: Field, settings: Mapping[str, Any]) -> Policy:
    from mbn_marl.planning import plan
    from mbn_marl.planning.greedy import Greedy
    from mbn_marl.planning.planner import WORK_LIMIT
    from mbn_marl.planning.problem import make_problem
    from mbn_marl.planning.replanning import Replanner, Replay, Tracker

    none = {"decoys": 0, "empty_rois": ()}  # the engine knows which ROIs are empty
    config = make_config({**settings, **none})
    problem = make_problem(field, config, closed_loop=name not in ("planner", "open-loop"))
    if name in ("greedy-local", "blind"):
        from baselines.policies.greedy_local import GreedyLocal

        return GreedyLocal(problem, config, blind=name == "blind")
    if name == "greedy":
        return ControllerPolicy(problem, lambda _: Greedy(problem))
    hidden = UNSEEN if name == "replan" else ()
    known = [name for name in NavigationConfig.model_fields if name not in hidden]

    @cache
    def planned(empty: Empty) -> Plan:
        given = {name: getattr(problem.config, name) for name in known}
        limit = WORK_LIMIT if field.start_kinds else None
        found = plan(field, visited=empty, work_limit=limit, **given)
        if found.makespan is None and name != "replan":
            raise NoPlanError(f"{field.name}: no plan was found within the time limit")
        return found

    if config == make_config(settings):
        planned(())
    controls: dict[str, type[Tracker | Replay]] = {"planner": Tracker, "open-loop": Replay}
    control = controls.get(name, Replanner)
    return ControllerPolicy(problem, lambda empty: control(problem, planned(empty)))
