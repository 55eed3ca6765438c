"""The engine's word on a plan: its actions, replayed from the reset."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.engine import BatchEngine
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
    """

    success: bool
    steps: int
    return_: float
    wall_hits: int
    trail: Floats


class Stage:
    """One world to replay plans in."""

    def __init__(self, problem: Problem) -> None:
        config = problem.config
        settings = {name: getattr(config, name) for name in NavigationConfig.model_fields}
        self._engine = BatchEngine(problem.field, 1, autoreset="disabled", threads=1, **settings)

    def replay(self, actions: NDArray[np.float32]) -> Replay:
        """Replay the actions (T, n, 2) until they or the episode end."""
        engine = self._engine
        engine.reset()
        for action in actions:
            _, _, terminated, truncated = engine.step(action[None])
            if terminated[0] or truncated[0]:
                break
        metrics, seen = engine.metrics(), engine.snapshot()
        return Replay(
            success=bool(metrics["success"][0]) and not bool(metrics["collision"][0]),
            steps=int(metrics["steps"][0]),
            return_=float(metrics["episode_return"][0]),
            wall_hits=int(metrics["wall_hits"].sum()),
            trail=np.asarray(seen.trail, np.float64),
        )
