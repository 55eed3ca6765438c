"""``entities`` by hand; ``test_forms`` compares it with the oracle."""

from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Failures, Field
from tests.support.configurations import EVERYTHING, SIGHTS, entries
from tests.support.field_cases import LETTER_L, SQUARE
from tests.support.worlds import ASSIGNED

pytestmark = pytest.mark.slow
FAILING = {
    **{**EVERYTHING, **SIGHTS["entities"], "dynamics": "holonomic"},
    "failures": Failures(at={0: 1}),
}
ROOT = 2**0.5
ABC = [(30.0, 50.0), (90.0, 50.0), (50.0, 95.0)]


def engine_of(rois: Any, starts: Any) -> BatchEngine:
    field = Field(vertices=SQUARE, rois=rois, starts=starts)
    engine = BatchEngine(field, 2, threads=1, roi_radius=1.0, **ASSIGNED)
    engine.reset()
    return engine


def test_at_rest_by_hand():
    engine = engine_of([(26.0, 58.0)], [(20.0, 50.0), (50.0, 90.0)])
    found = entries(engine, 0)
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
        **{"roi_0_ux": 6 / 11, "roi_0_uy": 8 / 11},
        **{"roi_0_away": 10 / 110, "roi_0_others": 40 / 140},
    }
    assigned = {"own_tour", "team_tour", "other_1_tour", "roi_0_order", "roi_0_seen"}
    assert [name for name in found if name not in assigned] == list(expected)
    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=1e-6)


def test_assignment_by_hand():
    """Robot 0 goes to A, 10, and C, 45 + 20 / 8; robot 1 to B, 40 + 30 / 8.

    If robot 1 goes to C and B, that is 60.6, and what going back costs, instead of 57.5.
    """
    engine = engine_of(ABC, [(20.0, 50.0), (60.0, 90.0)])
    tours, orders = (57.5 / 157.5, 43.75 / 143.75), ((1.0, 0.0, 0.5), (0.0, 1.0, 0.0))
    for robot in (0, 1):
        found = entries(engine, robot)
        told = [found[name] for name in ("own_tour", "team_tour", "other_1_tour")]
        assert told == pytest.approx([tours[robot], tours[0], tours[1 - robot]])
        assert [found[f"roi_{j}_order"] for j in range(3)] == list(orders[robot])
        assert [found[f"roi_{j}_seen"] for j in range(3)] == [1.0] * 3


def test_worlds_that_are_left_out_keep_their_assignment():
    """World 0 has ended, robot 0 one step from A, at full speed; world 2 is never reset."""
    field = Field(SQUARE, [(36.0, 50.0), *ABC[1:]], [(22.0, 50.0), (60.0, 90.0)])
    settings = {"autoreset": "disabled", "max_steps": 2, "roi_radius": 1.0, "f_max": 4.0}
    engine = BatchEngine(field, 3, threads=1, **{**settings, **ASSIGNED})
    actions = np.broadcast_to([(1.0, 0.0), (0.0, 0.0)], (3, 2, 2))
    engine.reset_worlds(np.array([True, True, False]))
    for _ in range(2):
        engine.step(actions, np.array([True, True, False]))
    engine.reset_worlds(np.array([False, True, False]))
    before = entries(engine, 0)
    assert before["roi_0_order"] == 1.0
    engine.step(actions, np.array([False, True, False]))
    assert entries(engine, 0) == before


def test_way_around_a_corner_by_hand():
    """The waypoint is 3 units off (60, 50), at (57.88, 47.88); failed robots see ways too."""
    rois, starts = [(30.0, 95.0), (90.0, 45.0)], [(90.0, 20.0), (10.0, 95.0)]
    field = Field(vertices=LETTER_L, rois=rois, starts=starts)
    engine = BatchEngine(field, 2, threads=1, **FAILING)
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
    engine.step(
        np.zeros((2, 2, 2))
    )  # robot 1 goes to ROI 0, and from there around the corner to ROI 1
    total = 20 + on + (30 + off) + (5 - off) / 8
    assert entries(engine, 1)["own_tour"] == pytest.approx(total / (100 + total))
    assert entries(engine, 0)["roi_0_near_x"] == found["roi_0_near_x"]
