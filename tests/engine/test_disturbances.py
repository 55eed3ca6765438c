"""Disturbances worked out by hand, and their random numbers; ``test_forms`` has the oracle compare.

What holds for every random number, such as that the batch does not matter, is in
``test_determinism``.
"""

from __future__ import annotations

import math
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Field
from mbn_marl.config import make_config
from mbn_marl.engine.mdp import elementary, rng
from mbn_marl.engine.state import make_episode, make_memory
from mbn_marl.episode import EpisodeRecorder, check_episode, load_episode, save_episode
from mbn_marl.errors import ConfigError
from mbn_marl.planning import plan
from mbn_marl.planning.problem import make_problem
from tests.support import disturbances as expected

SQUARE = Field(
    vertices=[(0.0, 0.0), (400.0, 0.0), (400.0, 400.0), (0.0, 400.0)],
    rois=[(390.0, 390.0)],
    starts=[(200.0, 200.0), (200.0, 150.0)],
)
GUSTY: dict[str, Any] = {
    "gust": 0.15,
    "wind": (0.1, 30.0),
    "dynamics": ("point_mass", "holonomic"),
}


def engine_of(worlds: int = 2, **settings: Any) -> BatchEngine:
    """An engine of the square in float64."""
    return BatchEngine(SQUARE, worlds, threads=1, **{"dtype": "float64", **settings})


def test_random_numbers_are_those_of_the_page() -> None:
    for place in [(0, 0, 0), (2**63 - 1, 5, 7), (3, 2**40, 1)]:
        key = rng.stream_key(*place, rng.FOR_GUSTS)
        assert key == expected.key_of(*place, expected.GUSTS)
        for counter in (0, 1, 2**33):
            assert rng.normal(np.uint64(key), counter) == expected.normal(key, counter)


def test_normal_numbers_are_normal() -> None:
    key = expected.key_of(1, 2, 3, 4)
    found = np.sort([float(expected.normal(key, counter)) for counter in range(20_000)])
    assert abs(found.mean()) < 0.02 and abs(found.var() - 1.0) < 0.03
    share = np.arange(len(found)) / len(found)
    assert np.abs([NormalDist().cdf(x) for x in found] - share).max() < 0.011


def test_exponential() -> None:
    for x in np.linspace(-40.0, 0.0, 1001).tolist():
        assert elementary.exponential(x) == pytest.approx(math.exp(x), rel=3e-14)
    assert elementary.exponential(0.0) == 1.0
    assert elementary.exponential(-1e9) == elementary.exponential(-40.0) < 1e-17


def test_settings_are_checked() -> None:
    with pytest.raises(ConfigError) as caught:
        engine_of(gust=-0.1, gust_time=0.0, first_world=-1)
    assert [problem.split(":")[0] for problem in caught.value.problems] == ["gust", "gust_time"]
    with pytest.raises(ConfigError, match=r"first_world: -1; allowed: an integer from 0"):
        engine_of(first_world=-1)


def test_what_is_off_has_no_entries() -> None:
    now = make_episode(2, 2, make_config({}))
    assert now.gust.shape == (0, 0, 2)
    assert make_memory(2, 2, make_config({}), now).key.shape == (0,)


def test_a_gust_is_one_push_for_the_whole_team() -> None:
    engine = engine_of(**GUSTY)
    engine.reset(seed=3)
    first = np.array([engine.snapshot(world).wind for world in (0, 1)])
    assert (first[0] != first[1]).all()
    engine.step(np.zeros((2, 2, 2)))
    for world in (0, 1):
        assert engine.snapshot(world).velocities.tolist() == [first[world].tolist()] * 2
    second = np.array(engine.snapshot(0).wind)
    engine.step(np.zeros((2, 2, 2)))
    assert engine.snapshot(0).velocities[0] == pytest.approx(first[0] + second, abs=1e-15)
    key, wind = expected.key_of(3, 0, 0, 4), np.array(engine.config.wind_increment())
    pushes = [first[0] - wind, second - wind]
    draws = [0.15 * float(expected.normal(key, counter)) for counter in range(4)]
    r = math.exp(-0.1)
    after = [r * g + math.sqrt(1.0 - r * r) * x for g, x in zip(draws, draws[2:], strict=False)]
    assert np.concatenate(pushes) == pytest.approx([*draws[:2], *after], abs=1e-12)


def test_gusts_keep_their_size_and_are_correlated() -> None:
    engine = engine_of(300, **(GUSTY | {"gust_time": 5.0}))
    engine.reset(seed=1)
    gusts = []
    for _ in range(60):
        gusts.append(engine._backend.now.gust.copy())
        engine.step(np.zeros((300, 2, 2)))
    blown = np.array(gusts)  # (steps, 2, worlds)
    assert blown[0].std() == pytest.approx(0.15, rel=0.1)
    assert blown[-1].std() == pytest.approx(0.15, rel=0.1)
    for later in (1, 5):
        correlation = (blown[later:] * blown[:-later]).mean() / blown.var()
        assert correlation == pytest.approx(math.exp(-later / 5.0), abs=0.05)
    assert abs((blown[:, 0] * blown[:, 1]).mean() / blown.var()) < 0.05


def test_disturbed_episodes_are_recorded_and_replayed(tmp_path: Path) -> None:
    engine = engine_of(max_steps=12, random_starts=True, first_world=7, **GUSTY)
    with EpisodeRecorder(engine, world=1) as recorder:
        engine.reset(seed=5)
        for _ in range(20):
            engine.step(engine.sample_actions())
    _, second = recorder.episodes
    assert (second.seed, second.world, second.number) == (5, 8, 1)
    loaded = load_episode(save_episode(second, tmp_path / "gusty.json"))
    check_episode(loaded)
    now = engine.snapshot(1)
    assert loaded.positions[-1].tolist() == now.positions.tolist()
    assert loaded.winds is not None and loaded.winds.tolist() == second.winds.tolist()  # type: ignore[union-attr]
    assert loaded.snapshot(loaded.steps).wind == now.wind
    assert loaded.snapshot(0).wind != now.wind


def test_plans_are_not_for_disturbed_robots() -> None:
    with pytest.raises(ConfigError, match=r"gust: 0\.15; allowed: 0; a plan does not hold"):
        plan("field_03", gust=0.15)
    config = make_config({"gust": 0.15})
    assert make_problem(SQUARE, config, closed_loop=True).n == 2
