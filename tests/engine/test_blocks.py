"""No data races: the result has the same bits for any block size and any number of threads."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine
from mbn_marl.engine import step
from tests.support.configurations import EVERYTHING, STORM

pytestmark = pytest.mark.slow
WORLDS, STEPS = 600, 120
STEP_WORLDS = step.step_worlds
CASES: dict[str, dict[str, Any]] = {
    "released": {"field": "field_01"},
    "formal": {"field": "field_07", "reward": "formal"},
    "several fields": {"field": ["field_03", "field_05", "field_10"], "autoreset": "next_step"},
    "lidar": {"field": ["field_06", "field_09"], "observation": "lidar"},
    "mixed": {"field": "field_04", **EVERYTHING, "gust": 0.05},
    "storm": {"field": "field_04", **STORM},
    "float64": {"field": "field_01", "dtype": "float64", "reward_sharing": "team"},
}
LIVELY = {"max_steps": 50, "safety_distance": 20.0, "random_starts": True, "wind": (0.05, 40.0)}


def make_engine(case: str, threads: int = 1) -> BatchEngine:
    return BatchEngine(num_worlds=WORLDS, seed=3, threads=threads, **(CASES[case] | LIVELY))


def in_ranges_of(size: int) -> Callable[..., int]:
    def step_worlds(store: Any, actions: Any, lo: int, hi: int) -> int:
        cuts = [*range(lo, hi, size), hi]
        return sum(STEP_WORLDS(store, actions, a, b) for a, b in pairwise(cuts))

    return step_worlds


def trajectory(engine: BatchEngine) -> list[bytes]:
    rows = [engine.reset().tobytes()]
    ends = 0
    for _ in range(STEPS):
        results = engine.step(engine.sample_actions())
        ends += int(np.count_nonzero(results[2] | results[3]))
        arrays = (*results, engine.team_rewards, engine.state(), engine.infos())
        rows.append(b"".join(array.tobytes() for array in arrays))
    assert ends > WORLDS / 2
    return rows


@pytest.mark.parametrize("case", CASES)
def test_blocks_and_threads_change_nothing(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = trajectory(make_engine(case))
    for size in (1, 7, 64, step.BLOCK - 1):
        monkeypatch.setattr(step, "step_worlds", in_ranges_of(size))
        assert trajectory(make_engine(case)) == expected, size
    monkeypatch.undo()
    for _ in range(3):
        assert trajectory(make_engine(case, threads=2)) == expected


def _rewards_of_threads(worlds: int) -> list[float]:
    engine = BatchEngine("field_03", worlds, threads=2)
    engine.reset(seed=0)
    return engine.step(engine.sample_actions())[1].sum(axis=1).tolist()


def test_forked_children_of_threads_step() -> None:
    expected = _rewards_of_threads(4)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply_async(_rewards_of_threads, (4,)).get(timeout=60) == expected


def test_threads_take_actions_that_cannot_be_written() -> None:
    free, kept = (make_engine("released", threads=2) for _ in range(2))
    free.reset()
    kept.reset()
    for can in (True, False, True):
        actions = free.sample_actions().copy()
        expected = free.step(actions)
        actions.flags.writeable = can
        for one, other in zip(kept.step(actions), expected, strict=True):
            np.testing.assert_array_equal(one, other)
