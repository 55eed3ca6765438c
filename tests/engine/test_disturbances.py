"""Disturbances worked out by hand, and their random numbers; ``test_forms`` has the oracle compare.

What holds for every random number, such as that the batch does not matter, is in
``test_determinism``.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mbn_marl import BatchEngine, Field
from mbn_marl.config import make_config
from mbn_marl.engine.mdp.disturbances import DISTURBANCES
from mbn_marl.engine.state import make_episode, make_memory
from mbn_marl.errors import ConfigError
from mbn_marl.jit import elementary, rng
from mbn_marl.planning import plan
from mbn_marl.planning.problem import make_problem
from tests.support import disturbances as expected
from tests.support.configurations import EVERYTHING, SIGHTS, entries, seeing

pytestmark = pytest.mark.slow

SQUARE = Field(
    vertices=[(0.0, 0.0), (400.0, 0.0), (400.0, 400.0), (0.0, 400.0)],
    rois=[(390.0, 390.0)],
    starts=[(200.0, 200.0), (200.0, 150.0)],
)
ON: dict[str, Any] = {
    "gust": 0.15,
    "wind": (0.1, 30.0),
    "dynamics": ("point_mass", "holonomic"),
    "action_delay": 2,
    "position_noise": 2.0,
}


def engine_of(worlds: int = 2, field: Field = SQUARE, **settings: Any) -> BatchEngine:
    """An engine whose worlds are not reset."""
    return BatchEngine(field, worlds, threads=1, **{**EVERYTHING, **ON, **settings})


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
        engine_of(
            **{"gust": -0.1, "gust_time": 0.0, "position_noise": math.nan, "velocity_noise": -1},
            **{"action_noise": -1, "action_loss": 1.1, "action_delay": 101, "dropout": -0.1},
        )
    names = ["gust", "gust_time", *(name for name in DISTURBANCES if name != "gust")]
    assert [problem.split(":")[0] for problem in caught.value.problems] == names
    with pytest.raises(ConfigError, match="first_world"):
        engine_of(first_world=-1)


def test_what_is_off_has_no_entries() -> None:
    now = make_episode(2, 2, make_config({}))
    assert now.gust.shape == now.queue.shape == (0, 0, 2)
    memory = make_memory(2, 2, 1, make_config({}), now)
    assert memory.key.shape == (0,) and memory.acted.shape == (0, 2, 2)
    assert memory.seen.shape == (0, 0, 2)


def test_a_gust_is_one_push_for_the_whole_team() -> None:
    engine = engine_of()
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
    engine = engine_of(300, gust_time=5.0)
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


def acted(actions: list[Any], **settings: Any) -> NDArray[np.float64]:
    """Return the disturbed actions of world 0 with seed 3, (steps, robots, 2)."""
    engine = engine_of(**{"wind": (0.0, 0.0), "gust": 1e-9, **settings})
    engine.reset(seed=8)
    for _ in range(4):
        engine.step(np.ones((2, 2, 2)))
    engine.reset(seed=3)  # which begins with an empty queue again
    arrived = []
    for action in actions:
        engine.step(np.broadcast_to(np.asarray(action, float), (2, 2, 2)))
        arrived.append(engine._backend.memory.acted[0].copy())
    return np.array(arrived)


def test_actions_are_late() -> None:
    given = [(0.25, -3.0), (0.5, 0.0), (0.75, 1.0), (1.0, 0.0)]
    expected_ones = [(0.0, 0.0), (0.0, 0.0), (0.25, -1.0), (0.5, 0.0)]
    for robot in range(2):
        assert [*map(tuple, acted(given)[:, robot].tolist())] == expected_ones
        assert acted(given, action_delay=0, action_loss=1e-9)[:, robot, 0].tolist() == [
            *(0.25, 0.5, 0.75, 1.0)
        ]


def test_what_is_lost_is_what_was_sent_before() -> None:
    given = [((t + 1) / 64, -(t + 1) / 64) for t in range(40)]
    key = expected.key_of(3, 0, 0, 5)
    found = acted(given, action_loss=0.5, action_delay=1)
    for robot in range(2):
        sent, lost = [(0.0, 0.0)], 0  # arrives in the first step
        for t, action in enumerate(given):
            fails = expected.uniform(key, 4 * (64 * t + robot)) < 0.5
            sent.append(sent[-1] if fails else action)
            lost += fails
        assert [*map(tuple, found[:, robot].tolist())] == sent[:-1]
        assert 10 <= lost <= 30
    assert not acted(given, action_loss=1.0).any()


def test_noise_comes_last_and_is_clipped() -> None:
    given = [(5.0, 0.0)] * 60
    key = expected.key_of(3, 0, 0, 5)
    found = acted(given, action_noise=0.25, action_delay=1)
    for t, robot, axis in np.ndindex(60, 2, 2):
        xi = float(expected.normal(key, 4 * (64 * t + robot) + 1 + axis))
        came = float(t > 0 and axis == 0)
        assert found[t, robot, axis] == min(max(came + 0.25 * xi, -1.0), 1.0)
    assert (found[1:, :, 0] == 1.0).mean() == pytest.approx(0.5, abs=0.15)


@pytest.mark.parametrize("steps", [0, 3])
def test_each_robot_sees_everything_with_noise_of_its_own(steps: int) -> None:
    engine = engine_of(velocity_noise=0.25, max_steps=3, autoreset="disabled")
    engine.reset(seed=3)
    for _ in range(steps):
        engine.step(np.ones((2, 2, 2)))
    key, now = expected.key_of(3, 1, 0, 6), engine.snapshot(1)
    for i in range(2):

        def seen(thing: int, numbers: Any, sd: float, first: int, i: int = i) -> NDArray[Any]:
            counter = 8 * (128 * (64 * steps + i) + thing) + first
            draws = [float(expected.normal(key, counter + k)) for k in range(2)]
            return np.asarray(numbers) + sd * np.array(draws)

        places = [seen(j, now.positions[j], 2.0, 1) for j in range(2)]
        motions = [seen(j, now.velocities[j], 0.25, 3) for j in range(2)]
        found, other = entries(engine, i, world=1), 1 - i
        numbers = {
            "own_{}": (places[i] - 500.0) / 500.0,
            "own_v{}": motions[i] / 5.0,
            "other_1_d{}": (places[other] - places[i]) / 1000.0,
            "other_1_dv{}": (motions[other] - motions[i]) / 10.0,
            "roi_0_d{}": (seen(64, (390.0, 390.0), 2.0, 1) - places[i]) / 1000.0,
        }
        for name, pair in numbers.items():
            axes = [found[name.format(axis)] for axis in "xy"]
            assert axes == pytest.approx(pair, abs=1e-7), name
    true = [*now.positions.ravel(), *now.velocities.ravel(), 0.0, 0.0, 0.0]
    assert engine.state()[1].tolist() == true


@pytest.mark.parametrize("observation", ["relative", "local", "entities", "state"])
def test_what_is_seen_stays_in_the_space(observation: str) -> None:
    engine = engine_of(position_noise=1e5, velocity_noise=1e5, **SIGHTS[observation])
    for row in (engine.reset(seed=1), engine.step(np.ones((2, 2, 2)))[0]):
        assert (row >= engine.observation_low).all() and (row <= engine.observation_high).all()
        assert np.isin([1.0, -1.0] if observation != "state" else [0.0, 1000.0], row).all()


@pytest.mark.parametrize("observation", SIGHTS)
def test_what_drops_out_is_nought(observation: str) -> None:
    field = Field(vertices=SQUARE.vertices, rois=[(200.0, 150.0)], starts=SQUARE.starts)
    settings = {"position_noise": 0.0, **seeing(observation, 500.0)}
    engine = engine_of(field=field, autoreset=False, dropout=1.0, **settings)
    engine.reset(seed=1)
    engine.step(np.zeros((2, 2, 2)))
    found = entries(engine, 0, world=1)
    kept = {"roi_0_visited", "visit_code"}
    things = {name for name in found if name.startswith(("other", "roi"))} - kept
    assert things and not any(found[name] for name in things)
    assert all(found[name] == 1.0 for name in kept & found.keys())
    assert found.get("own_x", 1.0) and (found.get("ray_0", 1.0) > 0.0)
    assert engine.infos()[1, 0, 1] == 1.0


def test_things_drop_out_alone_and_as_often_as_they_should() -> None:
    engine = engine_of(300, dropout=0.25)
    rows = [engine.reset(seed=1).copy()]
    rows += [engine.step(np.zeros((300, 2, 2)))[0].copy() for _ in range(3)]
    table = [entry.name for entry in engine.observation_table]
    seen = np.array(rows)[..., [table.index("other_1_dx"), table.index("roi_0_dx")]] != 0
    assert seen.mean(axis=(0, 1)).ravel() == pytest.approx([0.75] * 4, abs=0.05)
    assert seen.all(axis=-1).mean() == pytest.approx(0.75**2, abs=0.05)
    assert seen.all(axis=2).mean() == pytest.approx(0.75**2, abs=0.05)


def test_plans_are_not_for_disturbed_robots() -> None:
    settings: dict[str, Any] = {"gust": 0.15, "action_delay": 1}
    with pytest.raises(ConfigError) as caught:
        plan("field_03", **settings)
    assert [problem.split(";")[0] for problem in caught.value.problems] == [
        "gust: 0.15",
        "action_delay: 1",
    ]
    config = make_config(settings)
    assert make_problem(SQUARE, config, closed_loop=True).n == 2
