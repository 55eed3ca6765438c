"""Observations: ``lidar`` by hand, and entries that every observation has."""

import math
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Failures, Field
from mbn_marl.config import WITHOUT_RADIUS
from tests.support.configurations import EVERYTHING, SIGHTS, entries
from tests.support.field_cases import HOLE, LETTER_L, SQUARE

ROOT = 2**0.5
pytestmark = pytest.mark.slow
PRECISIONS = pytest.mark.parametrize("dtype", ["float32", "float64"])


def field_of(start: tuple[float, float], **changes: Any) -> Field:
    values = {"vertices": SQUARE, "rois": [(90.0, 90.0)], "starts": [start]}
    return Field(**(values | changes))


TWO = field_of((20.0, 50.0), rois=[(26.0, 58.0)], starts=[(20.0, 50.0), (50.0, 90.0)])


def seen(field: Field, *forces: tuple[float, float], **settings: Any) -> dict[str, float]:
    """The first robot's observation, by name, after steps with these forces."""
    engine = BatchEngine(field, 2, threads=1, **{"observation": "lidar", **settings})
    engine.reset()
    for force in forces:
        engine.step(np.full((2, engine.n_robots, 2), force, np.float32))
    return entries(engine, 0)


def rays(found: dict[str, float]) -> list[float]:
    return [found[f"ray_{k}"] for k in range(8)]


@PRECISIONS
def test_lidar_at_rest_by_hand(dtype):
    found = seen(TWO, dtype=dtype)
    assert list(found) == [
        *("own_x", "own_y", "own_vx", "own_vy"),
        *("other_1_dx", "other_1_dy", "other_1_dvx", "other_1_dvy", "other_1_near"),
        *("roi_0_dx", "roi_0_dy", "roi_0_ux", "roi_0_uy", "roi_0_visited"),
        *(f"ray_{k}" for k in range(8)),
        *("time_to_wall", "brake_inside", "wall_distance"),
    ]
    expected = [
        *(-0.06, 0.0, 0.0, 0.0),  # 30 units left of (50, 50), in half arenas of 500
        *(0.03, 0.04, 0.0, 0.0, 0.5),  # 50 units away, of the 100 that are sensed
        *(0.006, 0.008, 6 / 11, 8 / 11, 0.0),  # 10 units away: visited after the first step
        *(0.8, 0.5 * ROOT, 0.5, 0.2 * ROOT, 0.2, 0.2 * ROOT, 0.5, 0.5 * ROOT),
        *(1.0, 1.0, 0.2),
    ]
    assert list(found.values()) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("step", [1, -1], ids=["counter-clockwise", "clockwise"])
def test_rays_do_not_depend_on_the_direction_of_rings(step):
    field = field_of((20.0, 20.0), vertices=LETTER_L[::step], rois=[(20.0, 90.0)])
    expected = [0.8, 0.4 * ROOT, 0.8, 0.2 * ROOT, 0.2, 0.2 * ROOT, 0.2, 0.2 * ROOT]
    assert rays(seen(field)) == pytest.approx(expected, abs=1e-6)
    around = field_of((50.0, 20.0), holes=[HOLE[::step]])
    assert rays(seen(around))[2] == pytest.approx(0.2)


@PRECISIONS
def test_rays_from_a_wall(dtype):
    for start, free in (
        ((100.0, 30.0), {0: 0.0, 1: 0.0, 2: 0.7, 4: 1.0, 6: 0.3, 7: 0.0}),  # on the right wall
        ((0.0, 0.0), {0: 1.0, 1: 0.4 * ROOT, 2: 1.0, 3: 0.0, 4: 0.0, 5: 0.0, 6: 0.0, 7: 0.0}),
        ((40.0, 50.0), {0: 0.0, 2: 0.5, 4: 0.4, 6: 0.5}),  # on the hole's left side
        ((50.0, 60.0), {0: 0.5, 2: 0.4, 4: 0.5, 6: 0.0}),  # along the hole's side, then on
    ):
        found = seen(field_of(start, holes=[HOLE]), dtype=dtype)
        assert {k: rays(found)[k] for k in free} == pytest.approx(free, abs=1e-6), start
        assert found["wall_distance"] == pytest.approx(0.0, abs=1e-6), start


@PRECISIONS
def test_time_to_the_wall_and_brake_by_hand(dtype):
    # Velocities 0.5, 1, ... 4: 18 units, and 14 more until it rests, 3.5 + 3 + ... + 0.5.
    drive = [(1.0, 0.0)] * 8
    for room, inside in ((32.0, 1.0), (31.9, 0.0)):
        found = seen(field_of((100.0 - room, 50.0)), *drive, dtype=dtype)
        assert found["own_vx"] == pytest.approx(0.8)
        assert found["brake_inside"] == inside
        # Full speed needs 20 steps for the sensing radius of 100 units.
        assert found["time_to_wall"] == pytest.approx((room - 18) / 4 / 20, abs=1e-6)
    held = {"wind": (0.5, 0.0), "f_max": 0.25}
    assert seen(field_of((10.0, 50.0)), **held)["brake_inside"] == 1.0  # at rest: nothing to brake
    assert seen(field_of((10.0, 50.0)), (0.0, 0.0), **held)["brake_inside"] == 0.0


def test_radius_beyond_the_arena_is_its_diagonal():
    diagonal = float(np.hypot(*TWO.arena))
    far = seen(TWO, observation="lidar_local", sensing_radius=1e4)
    assert far == seen(TWO, sensing_radius=diagonal)
    assert far["ray_0"] == pytest.approx(80.0 / diagonal)
    assert far["other_1_near"] == pytest.approx(1.0 - 50.0 / diagonal)


def moved(observation: str, radius: float, **settings: Any) -> BatchEngine:
    starts = [(20.0, 50.0), (50.0, 20.0), (80.0, 50.0)]
    field = field_of(starts[0], starts=starts, rois=[(5.0, 95.0), (80.0, 50.0)])
    sight = {**EVERYTHING, **SIGHTS[observation], "one_hot": True}
    sight |= {} if observation in WITHOUT_RADIUS else {"sensing_radius": radius}
    sight["dynamics"] = ("point_mass", "unicycle", "point_mass")
    engine = BatchEngine(field, 2, threads=1, autoreset=False, **{**sight, **settings})
    engine.reset()
    for _ in range(2):
        engine.step(np.ones((2, 3, 2)))
    return engine


@pytest.mark.parametrize("observation", SIGHTS)
def test_headings_failures_and_dropout_are_shown(observation):
    turned = [pytest.approx(math.cos(0.6)), pytest.approx(math.sin(0.6))]
    for kind in ("brake", "vanish"):
        engine = moved(observation, 1000.0, failures=Failures(at={2: 2}, kind=kind))
        first, last = entries(engine, 0), entries(engine, 2)
        gone, blank = kind == "vanish", kind == "vanish" and observation == "entities"
        things = ("own", "other_1", "other_2")
        flags = {name for name in first if name.endswith(("cos", "sin", "failed"))}
        assert flags == {f"{one}_{what}" for one in things for what in ("cos", "sin", "failed")}
        assert [first[f"other_1_{name}"] for name in ("cos", "sin")] == turned
        assert [first[f"own_{name}"] for name in ("cos", "sin", "failed")] == [0.0] * 3
        assert [last["own_failed"], first["other_2_failed"]] == [1.0, float(not blank)]
        assert [first["is_robot_0"], last["is_robot_0"]] == [1.0, 0.0]
        shown = [name for name, value in first.items() if name[:7] == "other_2" and value]
        hidden = gone and observation != "state"
        assert shown == ["other_2_failed"] * (not blank) if hidden else len(shown) >= 2
    if observation in ("local", "lidar_local"):
        far = entries(moved(observation, 9.0, failures=Failures(at={2: 2})), 0)
        shown = {name for name, value in far.items() if value and name.startswith("other")}
        assert shown == {"other_2_failed"}
    dropped = entries(moved(observation, 1000.0, dropout=1.0), 0)
    kept = {"roi_1_visited", "visit_code"}
    things = {name for name in dropped if name.startswith(("other", "roi"))} - kept
    assert things and not any(dropped[name] for name in things)
    assert all(dropped[name] == 1.0 for name in kept & dropped.keys())
    assert dropped.get("own_x", 1.0) and dropped.get("ray_0", 1.0) > 0.0
