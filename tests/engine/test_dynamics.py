"""Robots of each dynamics, and failed ones, by hand; ``test_forms`` has the oracle compare all."""

import math
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Failures, Field
from tests.support.configurations import EVERYTHING

pytestmark = pytest.mark.slow

CORNERS = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)]
STARTS = [(20.0, 50.0), (50.0, 20.0), (80.0, 50.0)]
SQUARE = Field(CORNERS, rois=[(90.0, 90.0)], starts=STARTS)
FORWARD, LEFT, STILL = (1.0, 0.0), (0.0, 1.0), (0.0, 0.0)


def driven(*actions: Any, field: Field = SQUARE, **settings: Any) -> BatchEngine:
    """Two equal worlds in float64, after steps with an action for all or for each."""
    engine = BatchEngine(field, 2, threads=1, autoreset=False, **{**EVERYTHING, **settings})
    engine.reset()
    for action in actions:
        engine.step(np.broadcast_to(action, (2, 3, 2)))
    return engine


def first(engine: BatchEngine) -> tuple[list[float], list[float], float]:
    now = engine.snapshot(1)
    return now.positions[0].tolist(), now.velocities[0].tolist(), float(now.headings[0])


def test_holonomic_takes_the_velocity_of_the_action():
    engine = driven((0.05, -1.0), (0.05, -1.0), dynamics="holonomic", mass=2.0)
    # 0.25 of the force of 0.5 is a change of 0.25 at most; the wanted velocity is (0.25, -5).
    assert first(engine)[:2] == ([20.5, 49.25], [0.25, -0.5])
    assert engine.metrics()["impulse"][0, 0] == math.hypot(0.5, 1.0)  # 2 (0.25 + 0), 2 (-0.5)
    blown = driven(STILL, STILL, dynamics="holonomic", wind=(0.125, 0.0))
    assert first(blown)[1] == [0.125, 0.0]  # it brakes the velocity that the wind gave before


def test_unicycle_turns_then_moves_along_its_heading():
    engine = driven(FORWARD, (1.0, 1.0), (-1.0, 1.0), dynamics="unicycle", turn_max=math.pi / 6)
    c, s = math.cos(math.pi / 6), 0.5
    place, velocity, heading = first(engine)
    assert heading == pytest.approx(math.pi / 3, abs=1e-15)
    assert velocity == pytest.approx([0.5 * s, 0.5 * c], abs=1e-14)
    assert place == pytest.approx([20 + 0.5 + c + 0.5 * s, 50 + s + 0.5 * c], abs=1e-13)
    impulse = (0.5 + 0.5 * c - 0.5 * s, 0.5 * s - 0.5 * c)
    assert engine.metrics()["impulse"][0, 0] == pytest.approx(math.hypot(*impulse), abs=1e-13)
    back = driven(*[(-1.0, 0.0)] * 3, dynamics="unicycle", v_clip=1.25)
    assert first(back) == ([20 - 0.5 - 1.0 - 1.25, 50.0], [-1.25, 0.0], 0.0)
    blown = driven(LEFT, dynamics="unicycle", turn_max=math.pi / 2, wind=(0.25, 90.0))
    assert first(blown)[1] == pytest.approx([0.0, 0.25], abs=1e-15)


def test_bicycle_turns_by_its_speed():
    still = driven(LEFT, LEFT, dynamics="bicycle")
    assert first(still) == ([20.0, 50.0], [0.0, 0.0], 0.0)
    engine = driven((1.0, 1.0), (1.0, -1.0), dynamics="bicycle", wheelbase=2.0, steer_max=0.75)
    one = 0.5 / 2 * math.tan(0.75)
    two = one - 1.0 / 2 * math.tan(0.75)
    place, velocity, heading = first(engine)
    assert heading == pytest.approx(two, abs=1e-14)
    assert velocity == pytest.approx([math.cos(two), math.sin(two)], abs=1e-14)
    moved = [20 + 0.5 * math.cos(one) + math.cos(two), 50 + 0.5 * math.sin(one) + math.sin(two)]
    assert place == pytest.approx(moved, abs=1e-13)


@pytest.mark.parametrize("kind", ["brake", "coast", "vanish"])
def test_failed_robot_of_each_dynamics(kind):
    failing = Failures(at={0: 3, 1: 3, 2: 3}, kind=kind)
    actions = ((1.0, -1.0), (1.0, -1.0), (1.0, 0.0))
    settings = {"failures": failing, "wind": (0.125, 0.0), "f_max": 0.25}
    engine = driven(actions, actions, turn_max=np.pi / 3, **settings)
    assert engine.snapshot(1).velocities.tolist() == [[0.75, -0.5], [0.75, -0.5], [0.75, 0.0]]
    impulse = engine.metrics()["impulse"][1].tolist()
    once = {"brake": [0.5, -0.25], "coast": [0.875, -0.5], "vanish": [0.0, 0.0]}[kind]
    later = {"brake": [0.0, 0.0], "coast": [1.375, -0.5], "vanish": [0.0, 0.0]}[kind]
    for steps, after in ((1, once), (4, later)):
        for _ in range(steps):
            engine.step(np.ones((2, 3, 2)))  # their actions make no difference
        assert engine.snapshot(1).velocities.tolist() == [after, after, [after[0], 0.0]]
    assert engine.metrics()["impulse"][1].tolist() == impulse
    path = {"brake": 0.5 + 0.25, "coast": 0.875 + 1 + 1.125 + 1.25 + 1.375, "vanish": 0.0}[kind]
    assert engine.metrics()["path_length"][1, 2] == 0.375 + 0.75 + path


def test_robots_that_work_share_what_the_team_gets():
    near = Field(CORNERS, rois=[(90.0, 50.0)], starts=STARTS)
    engine = driven(field=near, failures=Failures(at={0: 1}), roi_radius=9.5)
    _, rewards, terminated, _ = engine.step(np.broadcast_to([FORWARD], (2, 3, 2)))
    assert rewards[1].tolist() == [0.0, 49_990.0, 59_990.0]
    assert engine.team_rewards.tolist() == [109_980.0] * 2
    assert terminated.all() and engine.metrics()["success"].all()
