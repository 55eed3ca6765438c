"""One robot of each dynamics by hand; ``test_forms`` has the oracle compare them all.

One more dynamics is added to a copy of the package by ``docs/extending.md``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Field
from tests.support.configurations import EVERYTHING

pytestmark = pytest.mark.slow

SQUARE = Field(
    vertices=[(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)],
    rois=[(90.0, 90.0)],
    starts=[(20.0, 50.0), (50.0, 20.0)],
)
FORWARD, LEFT, STILL = (1.0, 0.0), (0.0, 1.0), (0.0, 0.0)


def driven(*actions: Any, **settings: Any) -> BatchEngine:
    """Two equal worlds of the square in float64, after steps with an action for all or for each."""
    settings = {**EVERYTHING, "dynamics": ("point_mass", "holonomic"), **settings}
    engine = BatchEngine(SQUARE, 2, threads=1, autoreset=False, **settings)
    engine.reset()
    for action in actions:
        engine.step(np.broadcast_to(np.asarray(action), (2, 2, 2)))
    return engine


def first(engine: BatchEngine) -> tuple[list[float], list[float], float]:
    """Position, velocity and heading of the first robot."""
    now = engine.snapshot(1)
    return now.positions[0].tolist(), now.velocities[0].tolist(), float(now.headings[0])


def test_state_without_headings_has_no_entries_for_them() -> None:
    engine = driven(STILL, max_steps=1)
    assert not any("heading" in part for part in engine.save_state())
    assert engine.state().shape == (2, 11)
    assert np.isnan(engine.snapshot().headings).all()
    engine.reset_worlds(np.array([True, False]))
    engine.step(np.zeros((2, 2, 2)), active=np.array([True, False]))  # keeps the other as it is


def test_heading_is_reset_kept_and_final() -> None:
    engine = BatchEngine(SQUARE, 2, **{**EVERYTHING, "dynamics": "unicycle", "max_steps": 1})
    engine.reset()
    engine.step(np.full((2, 2, 2), (0.0, 1.0)))  # ends, and restarts
    assert engine.final_state()[:, 8:10].tolist() == [[0.3, 0.3]] * 2
    assert not engine.state()[:, 8:10].any()
    saved = engine.save_state()
    assert saved["now.heading"].shape == saved["final.cos"].shape == (2, 2)


def test_holonomic_takes_the_velocity_of_the_action() -> None:
    engine = driven((0.05, -1.0), (0.05, -1.0), dynamics="holonomic", mass=2.0)
    # 0.25 of the force of 0.5 is a change of 0.25 at most; the wanted velocity is (0.25, -5).
    assert first(engine)[:2] == ([20.5, 49.25], [0.25, -0.5])
    assert engine.metrics()["impulse"][0, 0] == math.hypot(0.5, 1.0)  # 2 (0.25 + 0), 2 (-0.5)
    blown = driven(STILL, STILL, dynamics="holonomic", wind=(0.125, 0.0))
    assert first(blown)[1] == [0.125, 0.0]  # it brakes the velocity that the wind gave before


def test_unicycle_turns_then_moves_along_its_heading() -> None:
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


def test_bicycle_turns_by_its_speed() -> None:
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
    backwards = driven((-1.0, 1.0), dynamics="bicycle", wheelbase=2.0, steer_max=0.75)
    assert first(backwards)[2] == pytest.approx(-one, abs=1e-14)


def test_wall_restores_the_heading() -> None:
    engine = driven((-1.0, 0.0), (-1.0, 0.5), dynamics="bicycle", f_max=20.0, v_clip=20.0)
    assert first(engine) == ([0.0, 50.0], [0.0, 0.0], 0.0)
    assert engine.metrics()["wall_hits"][0, 0] == 1
