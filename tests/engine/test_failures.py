"""Failed robots by hand; ``test_forms`` has the oracle compare everything about them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Field
from mbn_marl.config import Failures, NavigationConfig, make_config
from mbn_marl.engine.tracked_world import TrackedWorld
from tests.support.configurations import EVERYTHING

pytestmark = pytest.mark.slow

SQUARE = Field(
    vertices=[(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)],
    rois=[(90.0, 90.0), (10.0, 90.0)],
    starts=[(20.0, 50.0), (50.0, 20.0), (80.0, 50.0)],
)
FORWARD, STILL = (1.0, 0.0), (0.0, 0.0)


def started(field: Field = SQUARE, **settings: Any) -> BatchEngine:
    """Two worlds, reset."""
    engine = BatchEngine(field, 2, threads=1, autoreset=False, **{**EVERYTHING, **settings})
    engine.reset()
    return engine


def go(engine: BatchEngine, *actions: Any) -> BatchEngine:
    """Take steps with an action for all robots, or one for each."""
    for action in actions:
        engine.step(np.broadcast_to(np.asarray(action, float), (2, engine.n_robots, 2)))
    return engine


def test_configuration_comes_back_from_json() -> None:
    config = make_config({"failures": {"rate": 0.1, "at": {"2": 5}, "kind": "coast"}})
    assert config.failures == Failures(rate=0.1, at={2: 5}, kind="coast")
    assert NavigationConfig(**json.loads(json.dumps(config.model_dump(mode="json")))) == config


@pytest.mark.parametrize("kind", ["brake", "coast", "vanish"])
def test_failed_robot_of_each_dynamics(kind: Any) -> None:
    wind, turn = (0.125, 0.0), np.pi / 3
    failing = Failures(at={0: 3, 1: 3, 2: 3}, kind=kind)
    engine = started(failures=failing, wind=wind, f_max=0.25, turn_max=turn)

    def velocities() -> list[list[float]]:
        return engine.snapshot(1).velocities.tolist()

    actions = ((1.0, -1.0), (1.0, -1.0), (1.0, 0.0))
    go(engine, actions, actions)
    assert velocities() == [[0.75, -0.5], [0.75, -0.5], [0.75, 0.0]]
    impulse = engine.metrics()["impulse"][1].tolist()
    go(engine, np.ones((3, 2)))  # their actions make no difference
    after = {"brake": [0.5, -0.25], "coast": [0.875, -0.5], "vanish": [0.0, 0.0]}[kind]
    assert velocities() == [after, after, [after[0], 0.0]]
    headings = engine.snapshot(1).headings
    assert headings[2] == 0.0 and np.isnan(headings[:2]).all()
    go(engine, *[np.ones((3, 2))] * 4)
    after = {"brake": [0.0, 0.0], "coast": [1.375, -0.5], "vanish": [0.0, 0.0]}[kind]
    assert velocities() == [after, after, [after[0], 0.0]]
    assert engine.metrics()["impulse"][1].tolist() == impulse
    path = {"brake": 0.5 + 0.25, "coast": 0.875 + 1 + 1.125 + 1.25 + 1.375, "vanish": 0.0}[kind]
    assert engine.metrics()["path_length"][1, 2] == 0.375 + 0.75 + path


def test_reset_repairs_robots() -> None:
    engine = go(started(failures=Failures(at={1: 1, 2: 3}, most=1, rate=1.0)), *[STILL] * 3)
    assert engine.snapshot().failed.all()
    engine.reset_worlds(np.array([False, True]))
    assert engine.metrics()["failed"].tolist() == [[True] * 3, [False] * 3]


def test_robots_that_work_share_what_the_team_gets() -> None:
    near = Field(vertices=SQUARE.vertices, rois=[(90.0, 50.0)], starts=SQUARE.starts)
    engine = started(near, failures=Failures(at={0: 1}), roi_radius=9.5)
    _, rewards, terminated, _ = engine.step(np.broadcast_to([FORWARD], (2, 3, 2)))
    assert rewards[1].tolist() == [0.0, 49_990.0, 59_990.0]
    assert engine.team_rewards.tolist() == [109_980.0] * 2
    assert terminated.all() and engine.metrics()["success"].all()


@pytest.mark.parametrize("kind", ["brake", "vanish"])
def test_failed_robots_collide_and_visit_unless_they_have_vanished(kind: Any) -> None:
    failing = Failures(at={0: 1}, kind=kind)
    field = Field(vertices=SQUARE.vertices, rois=[(15.0, 50.0), (90.0, 90.0)], starts=SQUARE.starts)
    there = kind != "vanish"
    engine = go(started(field, failures=failing), STILL)
    assert engine.snapshot().visited.tolist() == [there, False]
    starts = [(20.0, 50.0), (31.0, 50.0), (80.0, 50.0)]
    engine = started(field, starts=starts, failures=failing, f_max=2.0)
    _, rewards, terminated, _ = engine.step(np.broadcast_to((-1.0, 0.0), (2, 3, 2)))
    assert terminated.tolist() == [there] * 2
    assert rewards[0].tolist() == ([0.0, -5e4, -5e4] if there else [0.0, -10.0, -10.0])


def test_vanished_robot_stays_in_the_memory_where_it_vanished() -> None:
    starts = np.array([(20.0, 50.0), (50.0, 50.0), (80.0, 20.0)])
    failing = Failures(at={0: 1}, kind="vanish")
    engine = started(starts=starts, f_max=40.0, v_clip=40.0, failures=failing)
    actions = [STILL, (-0.75, 0.0), STILL]
    _, rewards, _, _ = engine.step(np.broadcast_to(actions, (2, 3, 2)))
    assert engine.snapshot().positions[1].tolist() == [20.0, 50.0]
    assert rewards[0].tolist() == [0.0, -100.0, -10.0]


def test_measured_robots_fail_alike() -> None:
    """Robots that are moved as commanded have the episode that the engine gives them."""
    options = {**EVERYTHING, "failures": Failures(at={0: 2, 2: 4}, kind="coast")}
    plain, tracked = (
        BatchEngine(SQUARE, 1, autoreset=False, threads=1, **options) for _ in range(2)
    )
    plain.reset(), tracked.reset()
    world = TrackedWorld(tracked)
    for action in np.random.default_rng(1).uniform(-1, 1, (8, 3, 2)):
        plain.step(action[None])
        command = world.command(action)
        world.measure(tracked.snapshot().positions + command.velocities, command.velocities)
        assert np.array_equal(plain.state(), tracked.state())
        assert np.array_equal(plain.infos(), tracked.infos())
    assert tracked.snapshot().failed.tolist() == [True, False, True]
