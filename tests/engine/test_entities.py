"""``entities`` by hand, and its symmetries; ``test_forms`` compares it with the oracle."""

from __future__ import annotations

from itertools import combinations_with_replacement, pairwise, permutations
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Failures, Field
from mbn_marl.engine.mdp.observations import observation_table
from mbn_marl.field import catalogue_names, load_field
from tests.support.configurations import EVERYTHING, SIGHTS, entries
from tests.support.tokens import Atlas, Plan
from tests.support.worlds import ASSIGNED

pytestmark = pytest.mark.slow
FAILING: dict[str, Any] = {**EVERYTHING, **SIGHTS["entities"], "dynamics": "holonomic"}
SQUARE = np.array([(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)])
STILL = (0.0, 0.0)
SHIFT = np.array((512.0, 256.0))
LETTER_L = [(0.0, 0.0), (100.0, 0.0), (100.0, 50.0), (60.0, 50.0), (60.0, 100.0), (0.0, 100.0)]
ROOT = 2**0.5
TWO = [(20.0, 50.0), (60.0, 90.0)]
ABC = [(30.0, 50.0), (90.0, 50.0), (50.0, 95.0)]


def engine_of(rois: Any, starts: Any, **settings: Any) -> BatchEngine:
    """Two worlds of a square of 100 units, after their reset."""
    field = Field(vertices=SQUARE, rois=rois, starts=starts)
    engine = BatchEngine(field, 2, threads=1, **{**ASSIGNED, **settings})
    engine.reset()
    return engine


def table_of(engine: BatchEngine, **changes: Any) -> Any:
    """Return the table of observations of an engine whose configuration was another."""
    config = engine.config.model_copy(update=changes)
    return observation_table(config, engine.n_robots, len(engine.field.rois), engine.field.arena)


def after(engine: BatchEngine, *actions: Any) -> BatchEngine:
    """The engine after steps in which all worlds do the same."""
    for action in actions:
        engine.step(np.broadcast_to(action, (engine.num_worlds, engine.n_robots, 2)))
    return engine


def test_at_rest_by_hand() -> None:
    engine = engine_of([(26.0, 58.0)], [(20.0, 50.0), (50.0, 90.0)])
    plain = {entry.name: entry for entry in table_of(engine, assignment=False)}
    found = {name: value for name, value in entries(engine, 0).items() if name in plain}
    expected = {
        **{"own_vx": 0.0, "own_vy": 0.0},
        **{"ray_0": 0.8, "ray_1": 0.5 * ROOT, "ray_2": 0.5, "ray_3": 0.2 * ROOT},
        **{"ray_4": 0.2, "ray_5": 0.2 * ROOT, "ray_6": 0.5, "ray_7": 0.5 * ROOT},
        **{"time_to_wall": 1.0, "brake_inside": 1.0, "wall_distance": 0.2},
        # the other robot at (30, 40), 50 units away
        **{"other_1_present": 1.0, "other_1_near_x": 30 / 45, "other_1_near_y": 40 / 55},
        **{"other_1_far_x": 30 / 130, "other_1_far_y": 40 / 140},
        **{"other_1_dvx": 0.0, "other_1_dvy": 0.0},
        **{"other_1_apart": 50 / 65, "other_1_approach": 50 / 65},
        # the ROI at (6, 8), 10 units away, 40 units from the other robot
        **{"roi_0_left": 1.0, "roi_0_near_x": 6 / 21, "roi_0_near_y": 8 / 23},
        **{"roi_0_far_x": 6 / 106, "roi_0_far_y": 8 / 108},
        **{
            "roi_0_ux": 6 / 11,
            "roi_0_uy": 8 / 11,
            "roi_0_away": 10 / 110,
            "roi_0_others": 40 / 140,
        },
    }
    assert list(found) == list(expected)
    assert found == pytest.approx(expected, abs=1e-6)


def test_assignment_by_hand() -> None:
    """Robot 0 goes to A, 10, and C, 45 + 20 / 8; robot 1 to B, 40 + 30 / 8.

    If robot 1 goes to C and B, that is 60.6, and what going back costs, instead of 57.5.
    """
    engine = engine_of(ABC, TWO, roi_radius=1.0)
    tours, orders = (57.5 / 157.5, 43.75 / 143.75), ((1.0, 0.0, 0.5), (0.0, 1.0, 0.0))
    for robot in (0, 1):
        found = entries(engine, robot)
        told = [found[name] for name in ("own_tour", "team_tour", "other_1_tour")]
        assert told == pytest.approx([tours[robot], tours[0], tours[1 - robot]])
        assert [found[f"roi_{j}_order"] for j in range(3)] == list(orders[robot])
        assert [found[f"roi_{j}_seen"] for j in range(3)] == [1.0] * 3
    plain = {entry.name for entry in table_of(engine, assignment=False)}
    own = {"own_tour", "team_tour", "other_1_tour"}
    own |= {f"roi_{j}_{name}" for name in ("order", "seen") for j in range(3)}
    assert found.keys() - plain == own


def test_assignment_is_the_cheapest_on_the_catalogue() -> None:
    for name in catalogue_names():
        field = load_field(name)
        n, m = len(field.starts), len(field.rois)
        plan = Plan(Atlas(field.polygon, [*map(tuple, field.rois.tolist())]), n)
        plan.update([*map(tuple, field.starts.tolist())], [True] * n, [*range(m)], [0j] * n)
        orders = (
            [list(order[a:b]) for a, b in pairwise((0, *cuts, m))]
            for order in permutations(range(m))
            for cuts in combinations_with_replacement(range(m + 1), n - 1)
        )
        engine = BatchEngine(field, 1, threads=1, **ASSIGNED)
        engine.reset()
        found = []
        for robot in range(n):
            turns = {j: entries(engine, robot)[f"roi_{j}_order"] for j in range(m)}
            found.append(sorted(filter(turns.get, turns), key=lambda j: -turns[j]))
        assert plan.cost(found) == pytest.approx(min(map(plan.cost, orders)), abs=1e-2), name


def test_worlds_that_are_left_out_keep_their_assignment() -> None:
    """World 0 has ended, robot 0 one step from A, at full speed; world 2 is never reset."""
    field = Field(SQUARE, [(36.0, 50.0), *ABC[1:]], [(22.0, 50.0), (60.0, 90.0)])
    settings = {"autoreset": "disabled", "max_steps": 2, "roi_radius": 1.0, "f_max": 4.0}
    engine = BatchEngine(field, 3, threads=1, **{**settings, **ASSIGNED})
    actions = np.broadcast_to([(1.0, 0.0), STILL], (3, 2, 2))
    engine.reset_worlds(np.array([True, True, False]))
    for _ in range(2):
        engine.step(actions, np.array([True, True, False]))
    engine.reset_worlds(np.array([False, True, False]))
    before = entries(engine, 0)
    assert before["roi_0_order"] == 1.0
    engine.step(actions, np.array([False, True, False]))
    assert entries(engine, 0) == before


def test_fresh_assignment_follows_positions_and_velocities() -> None:
    field = Field(
        LETTER_L, [(30.0, 95.0), (90.0, 45.0), (20.0, 20.0)], [(90.0, 20.0), (10.0, 80.0)]
    )
    settings: dict[str, Any] = {"roi_radius": 1.0, "threads": 1, **ASSIGNED}
    engine = BatchEngine(field, 1, **settings | {"assignment": "fresh"})
    kept = BatchEngine(field, 1, **settings)
    plan = Plan(Atlas(field.polygon, [*map(tuple, field.rois.tolist())]), 2, fresh=True)
    engine.reset()
    kept.reset()
    parted = 0
    for _ in range(40):
        actions = engine.sample_actions()
        engine.step(actions)
        kept.step(actions)
        here = engine.snapshot()
        speeds = [complex(*velocity) / 5.0 for velocity in here.velocities.tolist()]
        plan.update([*map(tuple, here.positions.tolist())], [True, True], [0, 1, 2], speeds)
        for robot in (0, 1):
            found = entries(engine, robot)
            expected = [plan.turn(robot, j) for j in range(3)]
            assert [found[f"roi_{j}_order"] for j in range(3)] == pytest.approx(expected)
            tour = float(plan.tours[robot])
            assert found["own_tour"] == pytest.approx(tour / (100 + tour), abs=1e-4)
            parted += found["roi_0_order"] != entries(kept, robot)["roi_0_order"]
    assert parted


def test_way_around_a_corner_by_hand() -> None:
    """The waypoint is 3 units off (60, 50), at (57.88, 47.88); failed robots see ways too."""
    rois, starts = [(30.0, 95.0), (90.0, 45.0)], [(90.0, 20.0), (10.0, 95.0)]
    field = Field(vertices=LETTER_L, rois=rois, starts=starts)
    engine = BatchEngine(field, 2, threads=1, **{**FAILING, "failures": Failures(at={0: 1})})
    tables = engine._backend.geometry
    # Otherwise all is compiled again.
    assert all(table.flags.c_contiguous for part in tables for table in part)
    engine.reset()
    off = 3 / ROOT
    to, on = (30 + off) + (30 - off) / 8, (45 + off) + (30 - off) / 8  # to the waypoint, to ROI 0
    found = entries(engine, 0)
    assert (found["roi_0_seen"], found["roi_1_seen"]) == (0.0, 1.0)
    x, y = -30 - off, 30 - off
    offset = [part / (abs(part) + scale) for scale in (15, 100) for part in (x, y)]
    offset += [part / (np.hypot(x, y) + 1) for part in (x, y)]
    names = [f"roi_0_{name}" for name in ("near_x", "near_y", "far_x", "far_y", "ux", "uy")]
    assert [found[name] for name in names] == pytest.approx(offset, abs=1e-6)
    assert found["roi_0_away"] == pytest.approx((to + on) / (100 + to + on))
    assert found["roi_1_away"] == pytest.approx(25 / 125)
    assert [found["own_tour"], found["other_1_tour"]] == pytest.approx([25 / 125, 20 / 120])
    after(engine, STILL)  # robot 1 goes to ROI 0, and from there around the corner to ROI 1
    total = 20 + on + (30 + off) + (5 - off) / 8
    assert entries(engine, 1)["own_tour"] == pytest.approx(total / (100 + total))
    assert entries(engine, 0)["roi_0_near_x"] == found["roi_0_near_x"]


def three(rng: np.random.Generator) -> dict[str, Any]:
    """Three robots and five ROIs in the square, at eighths of a unit."""
    spots = rng.choice(np.arange(1, 16) * 50, (8, 2), replace=True) / 8 + rng.integers(0, 40, 2) / 8
    spots[:, 0] = rng.permutation(np.arange(8)) * 11.0 + 5.0  # far enough apart
    return {"vertices": SQUARE, "starts": spots[:3], "rois": spots[3:]}


def test_entries_do_not_depend_on_place_and_order() -> None:
    rng = np.random.default_rng(1)
    values, robots, rois = three(rng), rng.permutation(3), rng.permutation(5)
    fields = [
        Field(**values),
        Field(**{name: value + SHIFT for name, value in values.items()}),
        Field(SQUARE, values["rois"][rois], values["starts"][robots]),
    ]
    settings = {**FAILING, "roi_radius": 12.0}
    failures = Failures(at={0: 5}), Failures(at={int(np.flatnonzero(robots == 0)[0]): 5})
    engine = BatchEngine(fields[:2], 2, threads=1, **{**settings, "failures": failures[0]})
    other = BatchEngine(fields[2], 2, threads=1, **{**settings, "failures": failures[1]})
    engine.reset(), other.reset()
    names = [entry.name for entry in engine.observation_table]
    for _ in range(12):
        actions = np.repeat(rng.integers(-8, 9, (1, 3, 2)) / 8, 2, axis=0)
        seen = engine.step(actions)[0]
        np.testing.assert_array_equal(seen[0], seen[1])
        other.step(actions[:, robots])
        for here, there in enumerate(robots):
            expected, found = entries(engine, int(there)), entries(other, here)
            order = [int(there), *(i for i in range(3) if i != there)]
            others = [i for i in robots if i != there]
            for name in names:
                kind, *rest = name.split("_")
                if kind == "other":
                    rest[0] = str(1 + others.index(order[int(rest[0])]))
                elif kind == "roi":
                    rest[0] = str(int(np.flatnonzero(rois == int(rest[0]))[0]))
                assert found["_".join([kind, *rest])] == expected[name], name
