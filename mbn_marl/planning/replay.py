"""The engine's word on a plan: its actions, replayed from the reset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.engine import BatchEngine, Snapshot
from mbn_marl.engine.snapshot import FloatArray
from mbn_marl.planning.problem import Floats, Problem


@dataclass(frozen=True)
class Replay:
    """What came of a plan.

    Attributes:
        success: every ROI was visited, without collision.
        steps: how long the episode lasted.
        return_: the team's return.
        wall_hits: steps of any robot that pushed outside the field.
        trail: (steps + 1, n, 2): the positions, the starts first.
        assignment: for each robot the ROIs that it visited, in order.
        visit_steps: the steps at which ROIs were visited, rising.
    """

    success: bool
    steps: int
    return_: float
    wall_hits: int
    trail: Floats
    assignment: tuple[tuple[int, ...], ...]
    visit_steps: tuple[int, ...]


Controller = Callable[[FloatArray, FloatArray, NDArray[np.bool_]], NDArray[np.float32] | None]
"""Actions (n, 2) from positions (n, 2), velocities (n, 2) and visited ROIs (m,)."""


class Stage:
    """One world to replay plans in, compiled. What its robots would observe makes no difference."""

    def __init__(self, problem: Problem) -> None:
        plain = {"observation": "relative", "one_hot": False}
        config = problem.config.model_copy(update=plain)
        settings = {name: getattr(config, name) for name in NavigationConfig.model_fields}
        self._engine = BatchEngine(problem.field, 1, autoreset="disabled", threads=1, **settings)
        self._engine.reset()
        self._engine.step(np.zeros((1, problem.n, 2), np.float32))

    def replay(self, actions: NDArray[np.float32]) -> Replay:
        """Replay the actions (T, n, 2) until they or the episode end."""
        rows = iter(actions)
        return self.drive(lambda *_: next(rows, None))[0]

    def drive(self, controller: Controller) -> tuple[Replay, NDArray[np.float32]]:
        """One episode, to its end or until the controller returns ``None``, and its actions."""
        engine, actions = self._engine, []
        engine.reset()
        seen = engine.snapshot()
        visits: list[list[int]] = [[] for _ in range(engine.n_robots)]
        steps: list[int] = []
        ended = False
        while not ended:
            action = controller(seen.positions, seen.velocities, seen.visited)
            if action is None:
                break
            actions.append(action)
            _, _, terminated, truncated = engine.step(action[None])
            ended = bool(terminated[0] or truncated[0])
            now = engine.snapshot()
            for j in np.flatnonzero(now.visited & ~seen.visited).tolist():
                visits[_visitor(now, j)].append(j)
                steps.append(now.step)
            seen = now
        metrics = engine.metrics()
        return Replay(
            success=seen.success,
            steps=seen.step,
            return_=seen.team_return,
            wall_hits=int(metrics["wall_hits"].sum()),
            trail=np.asarray(seen.trail, np.float64),
            assignment=tuple(map(tuple, visits)),
            visit_steps=tuple(steps),
        ), np.array(actions, np.float32).reshape(-1, engine.n_robots, 2)


def _visitor(seen: Snapshot, j: int) -> int:
    """The robot that has visited ROI j in the last step: the first one within reach."""
    apart = seen.positions - seen.field.rois[j].astype(seen.positions.dtype)
    return int(np.argmax((apart**2).sum(axis=1) <= seen.roi_radius**2))
