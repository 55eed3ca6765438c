"""``lidar`` and ``lidar_local``, worked out by hand; ``test_forms`` has the oracle compare them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Field, parallel_env

SQUARE = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)]
HOLE = [(40.0, 40.0), (60.0, 40.0), (60.0, 60.0), (40.0, 60.0)]
LETTER_L = [(0.0, 0.0), (100.0, 0.0), (100.0, 50.0), (60.0, 50.0), (60.0, 100.0), (0.0, 100.0)]
ROOT = 2**0.5
pytestmark = pytest.mark.slow
PRECISIONS = pytest.mark.parametrize("dtype", ["float32", "float64"])


def seen(
    field: Field | list[Field], *forces: tuple[float, float], world: int = 0, **settings: Any
) -> dict[str, float]:
    """The first robot's observation, by name, after steps with these forces."""
    engine = BatchEngine(field, 2, threads=1, **{"observation": "lidar", **settings})
    observations = engine.reset()
    for force in forces:
        observations = engine.step(np.full((2, engine.n_robots, 2), force, np.float32))[0]
    row = observations[world, 0]
    assert ((row >= engine.observation_low) & (row <= engine.observation_high)).all()
    names = [entry.name for entry in engine.observation_table]
    return dict(zip(names, row.tolist(), strict=True))


def rays(entries: dict[str, float]) -> list[float]:
    """The eight readings."""
    return [entries[f"ray_{k}"] for k in range(8)]


def field_of(start: tuple[float, float], **changes: Any) -> Field:
    """A square of 100 units in which a robot starts there."""
    values = {"vertices": SQUARE, "rois": [(90.0, 90.0)], "starts": [start]}
    return Field(**(values | changes))


@PRECISIONS
def test_at_rest_by_hand(dtype: Any) -> None:
    field = field_of((20.0, 50.0), rois=[(26.0, 58.0)], starts=[(20.0, 50.0), (50.0, 90.0)])
    entries = seen(field, dtype=dtype)
    assert list(entries) == [
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
    assert list(entries.values()) == pytest.approx(expected, abs=1e-6)


@PRECISIONS
def test_rays_end_at_holes(dtype: Any) -> None:
    entries = seen(field_of((20.0, 50.0), holes=[HOLE]), dtype=dtype)
    assert rays(entries) == pytest.approx(
        [0.2, 0.5 * ROOT, 0.5, 0.2 * ROOT, 0.2, 0.2 * ROOT, 0.5, 0.5 * ROOT], abs=1e-6
    )
    assert entries["wall_distance"] == pytest.approx(0.2)
    beside = seen(field_of((30.0, 70.0), holes=[HOLE]), dtype=dtype)
    assert beside["wall_distance"] == pytest.approx(0.1 * ROOT, abs=1e-6)  # the hole's corner


@pytest.mark.parametrize("step", [1, -1], ids=["counter-clockwise", "clockwise"])
def test_whichever_way_round_the_rings_are_given(step: int) -> None:
    field = field_of((20.0, 20.0), vertices=LETTER_L[::step], rois=[(20.0, 90.0)])
    expected = [0.8, 0.4 * ROOT, 0.8, 0.2 * ROOT, 0.2, 0.2 * ROOT, 0.2, 0.2 * ROOT]
    assert rays(seen(field)) == pytest.approx(expected, abs=1e-6)
    around = field_of((50.0, 20.0), holes=[HOLE[::step]])
    assert rays(seen(around))[2] == pytest.approx(0.2)


@PRECISIONS
def test_on_a_wall_rays_are_how_far_one_can_go(dtype: Any) -> None:
    for start, free in (
        ((100.0, 30.0), {0: 0.0, 1: 0.0, 2: 0.7, 4: 1.0, 6: 0.3, 7: 0.0}),  # on the right wall
        ((0.0, 0.0), {0: 1.0, 1: 0.4 * ROOT, 2: 1.0, 3: 0.0, 4: 0.0, 5: 0.0, 6: 0.0, 7: 0.0}),
        ((40.0, 50.0), {0: 0.0, 2: 0.5, 4: 0.4, 6: 0.5}),  # on the hole's left side
        ((50.0, 60.0), {0: 0.5, 2: 0.4, 4: 0.5, 6: 0.0}),  # along the hole's side, then on
    ):
        entries = seen(field_of(start, holes=[HOLE]), dtype=dtype)
        assert {k: rays(entries)[k] for k in free} == pytest.approx(free, abs=1e-6), start
        assert entries["wall_distance"] == pytest.approx(0.0, abs=1e-6), start


def test_the_sensing_radius_is_the_unit() -> None:
    entries = seen(field_of((20.0, 50.0), starts=[(20.0, 50.0), (32.0, 50.0)]), sensing_radius=40.0)
    assert rays(entries)[0] == 1.0
    assert rays(entries)[4] == pytest.approx(0.5)
    assert entries["wall_distance"] == pytest.approx(0.5)
    assert entries["other_1_near"] == pytest.approx(0.7)


@PRECISIONS
def test_time_to_the_wall_and_brake_by_hand(dtype: Any) -> None:
    # Velocities 0.5, 1, ... 4: 18 units, and 14 more until it stands, 3.5 + 3 + ... + 0.5.
    drive = [(1.0, 0.0)] * 8
    for room, inside in ((32.0, 1.0), (31.9, 0.0)):
        entries = seen(field_of((100.0 - room, 50.0)), *drive, dtype=dtype)
        assert entries["own_vx"] == pytest.approx(0.8)
        assert entries["brake_inside"] == inside
        # Full speed needs 20 steps for the sensing radius of 100 units.
        assert entries["time_to_wall"] == pytest.approx((room - 18) / 4 / 20, abs=1e-6)
    back = seen(field_of((32.0, 50.0)), *[(-1.0, 0.0)] * 8, dtype=dtype)
    assert (back["brake_inside"], back["own_x"]) == (1.0, pytest.approx((14 - 50) / 500))
    # Both axes brake at once, the slower one is the first to stand: 14 and 0.5 + 1 + .. units.
    slanted = seen(field_of((68.0, 50.0)), *drive[:4], *[(1.0, 1.0)] * 4, dtype=dtype)
    assert slanted["brake_inside"] == 1.0
    assert slanted["time_to_wall"] == pytest.approx(14 / 4 / 20, abs=1e-6)


def test_wind_takes_part_in_braking() -> None:
    # With 0.25 against it in each step, the force of 0.5 brakes by 0.25: 2 * (3.75 + ... + 0.25).
    drive = [(0.5, 0.0)] * 8  # 0.25 and the wind's 0.25 a step: 18 units as above
    for room, inside in ((18 + 30.0, 1.0), (18 + 29.9, 0.0)):
        entries = seen(field_of((100.0 - room, 50.0)), *drive, wind=(0.25, 0.0))
        assert entries["brake_inside"] == inside
    held = {"wind": (0.5, 0.0), "f_max": 0.25}
    assert seen(field_of((10.0, 50.0)), **held)["brake_inside"] == 1.0  # at rest: nothing to brake
    assert seen(field_of((10.0, 50.0)), (0.0, 0.0), **held)["brake_inside"] == 0.0


def test_heavier_robots_brake_later() -> None:
    drive = [(1.0, 0.0)] * 8  # velocities 0.25 to 2: 9 units, and 7 until it stands
    for room, inside in ((16.0, 1.0), (15.9, 0.0)):
        entries = seen(field_of((100.0 - room, 50.0)), *drive, mass=2.0)
        assert entries["brake_inside"] == inside


@PRECISIONS
def test_padding_is_not_seen(dtype: Any) -> None:
    """In a batch with a field of more edges and ROIs, a field looks as it does alone."""
    plain = field_of((20.0, 50.0), rois=[(90.0, 90.0), (80.0, 10.0)])
    full = field_of(
        (20.0, 50.0),
        vertices=LETTER_L,
        rois=[(5.0 * k, 95.0) for k in range(1, 8)],
        holes=[[(15.0, 10.0), (35.0, 10.0), (25.0, 20.0)]],
    )
    options = {"dtype": dtype, "one_hot": True}
    steps = [(1.0, -0.3)] * 5
    alone = seen(plain, *steps, **options)
    together = seen([full, plain], *steps, world=1, **options)
    assert {name: together[name] for name in alone} == alone
    padding = [together[f"roi_{k}_{what}"] for k in range(2, 7) for what in ("dx", "ux", "visited")]
    assert padding == [alone["roi_0_dx"], alone["roi_0_ux"], 1.0] * 5
    other = seen([full, plain], *steps, world=0, **options)
    assert other == seen(full, *steps, **options)


TWO = field_of((20.0, 50.0), rois=[(26.0, 58.0)], starts=[(20.0, 50.0), (50.0, 90.0)])


@PRECISIONS
def test_local_hides_what_is_beyond_the_radius(dtype: Any) -> None:
    of_other, of_roi = (
        {"other_1_dx", "other_1_dy"},
        {f"roi_0_{x}" for x in ("dx", "dy", "ux", "uy")},
    )
    for radius, expected in ((50.0, set()), (49.9, of_other), (9.9, of_other | of_roi)):
        options = {"sensing_radius": radius, "dtype": dtype}
        whole, local = seen(TWO, **options), seen(TWO, observation="lidar_local", **options)
        hidden = {name for name in whole if local[name] != whole[name]}
        assert hidden == expected and all(local[name] == 0.0 for name in hidden), radius


def test_a_radius_beyond_the_arena_sees_everything_on_its_diagonal() -> None:
    diagonal = float(np.hypot(*TWO.arena))
    far = seen(TWO, observation="lidar_local", sensing_radius=1e4)
    assert far == seen(TWO, sensing_radius=diagonal)
    assert far["ray_0"] == pytest.approx(80.0 / diagonal)
    assert far["other_1_near"] == pytest.approx(1.0 - 50.0 / diagonal)


def test_names_are_those_of_the_space() -> None:
    env = parallel_env("field_03", observation="lidar", one_hot=True)
    space = env.observation_space("robot_0")
    table = env.unwrapped.engine.observation_table
    assert space.shape == (4 + 5 * 2 + 5 * 6 + 11 + 3,) == (len(table),)
    assert [entry.offset for entry in table] == list(range(len(table)))
    assert len({entry.name for entry in table}) == len(table)
