"""Demonstrations for imitation learning: the planner's episodes as arrays."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.classical.controller import make_tracker
from mbn_marl.engine import BatchEngine
from mbn_marl.planning import Plan


def record_demonstrations(
    plan: Plan, settings: Mapping[str, Any], *, episodes: int = 1, noise: float = 0.0, seed: int = 0
) -> dict[str, NDArray[Any]]:
    """Record episodes of the planner in closed loop, one after the other.

    Noise disturbs the robots' actions (normal, with standard deviation ``noise`` >= 0), but the
    planner's own actions are recorded, so that a learner sees how to return to the plan. The
    settings are those that the plan was made for; it must have a makespan.

    Returns:
        With K steps in all: ``observations`` (K, n, obs_size) float32 and ``states`` (K, 4n+1)
        float32 before the step, the planner's ``actions`` (K, n, 2) float32, ``taken``, the same
        with the noise, ``rewards`` (K, n) float32, ``terminations`` and ``truncations`` (K,)
        bool, ``successes`` (K,) bool of the step's whole episode, ``episodes`` (K,) int32, from 0.
    """
    engine = BatchEngine(plan.field, 1, autoreset="disabled", threads=1, **settings)
    random = np.random.default_rng(seed)
    rows: dict[str, list[Any]] = defaultdict(list)
    for episode in range(episodes):
        tracker, observations = make_tracker(plan, settings), engine.reset()
        while engine.running[0]:
            seen, state = engine.snapshot(), engine.state()[0]
            wanted = tracker.act(seen.positions, seen.velocities, seen.visited)
            added = random.normal(0.0, noise, wanted.shape) if noise else 0.0
            taken = np.clip(wanted + added, -1.0, 1.0).astype(np.float32)
            row = {"observations": observations[0].copy(), "states": state.astype(np.float32)}
            observations, rewards, terminated, truncated = engine.step(taken[None])
            row |= {"actions": wanted, "taken": taken, "rewards": rewards[0].astype(np.float32)}
            row |= {"terminations": terminated[0], "truncations": truncated[0]}
            for name, value in {**row, "episodes": np.int32(episode)}.items():
                rows[name].append(value)
        steps = len(rows["episodes"]) - len(rows["successes"])
        rows["successes"] += [engine.snapshot().success] * steps
    return {name: np.array(values) for name, values in rows.items()}
