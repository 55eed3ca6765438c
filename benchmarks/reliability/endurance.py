"""A billion env-steps of the engine, with resets.

All fields are in one batch; memory is compared before and after, and random worlds are checked.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from shapely import Polygon, contains_xy

from baselines.compare.text_table import TextTable
from benchmarks.speed.timing import SETS
from mbn_marl import BatchEngine
from mbn_marl.field import catalogue_names

LOOKS, WORLDS = 1000, 5  # how often worlds are looked at, and how many each time
ROUNDING = 0.01  # units; positions are float32
WARM_UP = 0.02  # share of the steps before memory is measured for the first time


def resident() -> float:
    """Return the resident memory of this process, in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def problems(engine: BatchEngine, worlds: list[int]) -> list[str]:
    """Return what is wrong after a step: numbers in all worlds, all else in ``worlds``."""
    output = {"team rewards": engine.team_rewards, "state": engine.state(), **engine.metrics()}
    found = [name for name, values in output.items() if not np.isfinite(values).all()]
    for world in worlds:
        found += [f"{name}, world {world}" for name, holds in facts(engine, world) if not holds]
    return found


def facts(engine: BatchEngine, world: int) -> Iterator[tuple[str, bool]]:
    """Yield what has to hold of a world since its reset (but for rounding), and whether it does."""
    seen, config = engine.snapshot(world), engine.config
    ground = Polygon(seen.field.vertices, seen.field.holes).buffer(ROUNDING)
    yield "inside the field", bool(contains_xy(ground, seen.trail.reshape(-1, 2)).all())
    yield "the trail ends here", bool((seen.trail[-1] == seen.positions).all())
    yield "speed limit", bool((np.abs(seen.velocities) <= config.top_speed).all())
    first, second = np.triu_indices(engine.n_robots, 1)
    apart = np.linalg.norm(seen.positions[first] - seen.positions[second], axis=-1)
    near = bool((apart < config.safety_distance).any())
    unclear = bool((np.abs(apart - config.safety_distance) < ROUNDING).any())
    yield "a collision is one", unclear or near == seen.collision
    gaps = np.linalg.norm(seen.trail[:, :, None] - seen.field.rois, axis=-1)
    close = gaps.min(axis=(0, 1))
    unclear_rois = np.abs(close - config.roi_radius) < ROUNDING
    visits = (close <= config.roi_radius) == seen.visited
    yield "visits", bool((visits | unclear_rois).all())
    yield "time limit", 0 <= seen.step <= config.max_steps


@dataclass(frozen=True)
class Endurance:
    """Step the engine with random actions; compare its memory, and look at worlds on the way."""

    env_steps: int = 1_000_000_000
    """How many."""
    worlds: int = 8192
    """Side by side."""
    threads: int = 1
    """Of the engine."""

    def run(self, command: str) -> bool:
        """Return whether nothing is broken and memory grew by at most 1 %."""
        engine = BatchEngine(catalogue_names(), self.worlds, seed=0, threads=self.threads)
        rng = np.random.default_rng(0)
        shape = (SETS, self.worlds, engine.n_robots, 2)
        actions = rng.uniform(-1, 1, shape).astype(np.float32)
        engine.reset()
        calls = -(-self.env_steps // self.worlds)
        every = max(1, calls // LOOKS)
        episodes, looks, before = 0, 0, 0.0
        broken: list[str] = []
        started = time.perf_counter()
        for call in range(calls):
            observations, rewards, terminated, truncated = engine.step(actions[rng.integers(SETS)])
            episodes += int(np.count_nonzero(terminated | truncated))
            if call % every == 0:
                looks += 1
                finite = np.isfinite(rewards).all() and np.isfinite(observations).all()
                broken += [] if finite else ["rewards or observations"]
                broken += problems(engine, rng.integers(self.worlds, size=WORLDS).tolist())
            if call == int(WARM_UP * calls):
                before = resident()
            if call % (every * LOOKS // 20) == 0:
                print(f"{call * self.worlds:,}: {resident():.1f} MiB", file=sys.stderr, flush=True)
        seconds, after = time.perf_counter() - started, resident()
        growth, steps = after / before - 1.0, calls * self.worlds
        lines = (
            ("env-steps", f"{steps:,}"),
            ("episodes that ended", f"{episodes:,}"),
            ("seconds", f"{seconds:,.0f} ({steps / seconds / 1e6:.1f} M env-steps/s)"),
            ("memory", f"{before:.1f} MiB, then {after:.1f} ({growth:+.2%})"),
            ("looks", f"{looks:,} at all worlds, {looks * WORLDS:,} at one"),
            ("broken", ", ".join(dict.fromkeys(broken)) or "nothing"),
        )
        table = TextTable("", ("what", "how much"), lines, words=2)
        table.print("the engine on ten fields, random actions")
        return not broken and growth <= 0.01
