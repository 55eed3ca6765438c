"""Playback of a plan's actions in the engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.engine import BatchEngine
from mbn_marl.engine.snapshot import FloatArray
from mbn_marl.planning.problem import Floats, Problem

GRIDS = (0.0, 1e-6, 1e-4, 1e-2)
"""Actions this close to a whole number are rounded to it, which makes motions exact."""


@dataclass(frozen=True, eq=False)
class Playback:
    """One episode of a team in the engine."""

    actions: NDArray[np.float32]  # (T, n, 2) in [-1, 1]
    clean: bool  # every ROI was visited, without a collision or a push against a wall
    return_: float  # of the team, reward units
    trail: Floats  # (T + 1, n, 2), the positions from the starts on, units
    assignment: tuple[tuple[int, ...], ...]  # the ROIs that each robot visited, in order
    visit_steps: tuple[int, ...]  # rising


ChooseActions = Callable[[FloatArray, FloatArray, NDArray[np.bool_]], NDArray[np.float32] | None]
"""Actions (n, 2) from positions (n, 2), velocities (n, 2) and visited ROIs (m,)."""


class Player:
    """Plays episodes of an instance in an engine with one world, some ROIs ``visited`` before."""

    def __init__(self, problem: Problem, visited: Sequence[int] = ()) -> None:
        # Another observation would be compiled and never read.
        unread = ("observation", "assignment", "one_hot", "sensing_radius")
        plain = {name: NavigationConfig.model_fields[name].default for name in unread}
        config = problem.config.model_copy(update=plain)
        settings = dict(config)
        self._engine = BatchEngine(problem.field, 1, autoreset="disabled", threads=1, **settings)
        self._engine.reset()
        self._engine.step(np.zeros((1, problem.n, 2), np.float32))
        self._engine.reset()
        self._start = self._engine.save_state()
        self._start["now.vx"][:, 0], self._start["now.vy"][:, 0] = problem.velocities.T
        last = len(problem.field.rois) - 1
        self._start["now.visited"] |= sum(1 << last - j for j in set(visited))

    def verify(self, _: Floats, actions: NDArray[np.float32]) -> Playback | None:
        """Return the episode with the actions (T, n, 2), rounded if need be, if it is clean."""
        whole = np.round(actions)
        for grid in GRIDS:
            snapped = np.where(np.abs(actions - whole) <= grid, whole, actions)
            rows = iter(snapped.astype(np.float32))
            playback = self.play(lambda *_, rows=rows: next(rows, None))
            if playback.clean:
                return playback
        return None

    def play(self, choose: ChooseActions) -> Playback:
        engine, actions = self._engine, []
        engine.load_state(self._start)
        seen = engine.snapshot()
        visits: list[list[int]] = [[] for _ in range(engine.n_robots)]
        steps: list[int] = []
        ended = False
        while not ended:
            action = choose(seen.positions, seen.velocities, seen.visited)
            if action is None:
                break
            actions.append(action)
            _, _, terminated, truncated = engine.step(action[None])
            ended = bool(terminated[0] or truncated[0])
            now = engine.snapshot()
            for j in np.flatnonzero(now.visited & ~seen.visited).tolist():
                apart = now.positions - now.field.rois[j].astype(now.positions.dtype)
                near = (apart**2).sum(axis=1) <= now.roi_radius**2
                near &= now.field.mine[: len(near), j]
                visits[int(np.argmax(near))].append(j)  # the first robot within reach
                steps.append(now.step)
            seen = now
        return Playback(
            actions=np.array(actions, np.float32).reshape(-1, engine.n_robots, 2),
            clean=seen.success and not engine.metrics(["wall_hits"])["wall_hits"].any(),
            return_=seen.team_return,
            trail=np.asarray(seen.trail, np.float64),
            assignment=tuple(map(tuple, visits)),
            visit_steps=tuple(steps),
        )
