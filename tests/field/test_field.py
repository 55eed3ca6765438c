"""Fields: the value, and the rules, each by a case worked out by hand."""

from __future__ import annotations

import copy
import json
import math
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from mbn_marl import parallel_env
from mbn_marl.errors import ConfigError, FieldError
from mbn_marl.field import Field, load_field, save_field
from tests.support.field_cases import HOLE, SQUARE, circle, square


def problems_of(**changes: Any) -> list[str]:
    """The problems of the square field with ``changes``."""
    with pytest.raises(FieldError) as caught:
        square(**changes)
    return caught.value.problems


class TestValue:
    def test_arrays_edges_and_defaults(self) -> None:
        field = square()
        assert field.vertices.dtype == np.float64
        np.testing.assert_array_equal(field.vertices, SQUARE)
        np.testing.assert_array_equal(field.holes[0], HOLE)
        np.testing.assert_array_equal(field.edges[0], [0, 0, 100, 0])
        np.testing.assert_array_equal(field.edges[3], [0, 100, 0, 0])
        np.testing.assert_array_equal(field.edges[7], [40, 60, 40, 40])
        assert field.edges.shape == (8, 4)
        assert field.polygon.area == 100 * 100 - 20 * 20
        assert (field.arena, field.name, field.optimal_makespan) == ((1000, 1000), "custom", None)

    def test_arrays_are_accepted(self) -> None:
        same = square(
            vertices=np.array(SQUARE, dtype=np.float32),
            rois=np.array([[90, 90]], dtype=np.int64),
            holes=np.array([HOLE]),
            arena=np.array([1000, 1000]),
        )
        assert same == square()

    def test_equal_by_value(self) -> None:
        assert square() == square()
        assert hash(square()) == hash(square())
        assert square(starts=[(-0.0, 0.0)]) == square(starts=[(0.0, 0.0)])
        assert not np.signbit(square(starts=[(-0.0, 0.0)]).starts).any()
        for change in (
            {"vertices": SQUARE[1:] + SQUARE[:1]},
            {"rois": [(90.0, 91.0)]},
            {"starts": [(10.0, 10.0)]},
            {"holes": ()},
            {"arena": (100, 100)},
            {"name": "other"},
            {"optimal_makespan": 3},
        ):
            assert square(**change) != square()
        assert square() != "custom"

    def test_immutable(self) -> None:
        field = square()
        with pytest.raises(AttributeError, match="name"):
            field.name = "other"
        with pytest.raises(AttributeError, match="rois"):
            del field.rois
        for array in (field.vertices, field.rois, field.starts, field.edges, *field.holes):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1.0
            with pytest.raises(ValueError, match="WRITEABLE"):
                array.setflags(write=True)

    def test_copies_are_equal(self) -> None:
        field = square(name="mine", optimal_makespan=24, arena=(200.0, 100.0))
        assert pickle.loads(pickle.dumps(field)) == field
        assert copy.deepcopy(field) == field
        assert Field(**field.to_dict()) == field
        json.dumps(field.to_dict())

    def test_repr(self) -> None:
        assert repr(square()) == (
            "<Field 'custom': 4 vertices, 1 holes, 1 ROIs, 2 starts, arena 1000 x 1000>"
        )


INVALID: dict[tuple[str, str], list[Any]] = {
    ("vertices", ""): [SQUARE[:2], "triangle", [(0, 0), (50, 50), (100, 100)]],
    ("rois", ""): [[], None, [(90, 80 + k / 4) for k in range(25)]],
    ("starts", ""): [()],
    ("holes", ""): [3],
    ("rois[1]", ""): [[(90, 90), (90, 90, 0)], [(90, 90), 7]],
    ("starts[0].x", ""): [[(True, 10)], [(math.nan, 10)]],
    ("starts[0].y", ""): [[(10, "9")], [(10, 1j)]],
    ("rois[0]", ""): [[(100.5, 50)]],
    ("rois[0].y", ""): [[(90, math.inf)], [(90, 10**5000)]],
    ("vertices[4].x", ""): [[*SQUARE, (-math.inf, 50)]],
    ("vertices[4]", ""): [[*SQUARE, (-1, 50)]],
    ("arena", ""): [(0, 100), 100],
    ("arena.y", ""): [(100, 1e7)],
    ("vertices[4]", "vertices[0]"): [[*SQUARE, (0, 0)]],
    ("rois[2]", "rois[0]"): [[(90, 90), (80, 80), (90, 90)]],
    ("starts[1]", "starts[0]"): [[(10, 10), (10, 10)]],
    ("starts[1]", "holes[0]"): [[(10, 10), (50, 50)]],
    ("vertices", "vertices[0]-vertices[1] meets vertices[2]-vertices[3]"): [
        [SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]],
        [(0, 0), (100, 0), (50, 0), (50, 50)],  # a spike
    ],
    ("vertices", "vertices[0]-vertices[1] meets vertices[3]-vertices[4]"): [
        [*SQUARE, (50, 0)],  # the last corner lies on the first edge
    ],
    ("holes[0]", "holes[0][0]-holes[0][1] meets holes[0][2]-holes[0][3]"): [
        [[HOLE[0], HOLE[2], HOLE[1], HOLE[3]]],
    ],
    ("holes[0][4]", "holes[0][1]"): [[[*HOLE, HOLE[1]]]],
    ("holes[0]", ""): [
        *([HOLE[:2]], [SQUARE[:3]], [[(70, 70), (100, 75), (70, 80)]]),
        *([[(70, 70), (110, 70), (70, 90)]], [[(210, 70), (310, 70), (210, 90)]]),
    ],
    ("holes[1]", "holes[0]"): [
        [HOLE, [(60, 60), (70, 60), (70, 70)]],
        [HOLE, [(45, 45), (55, 45), (50, 55)]],  # inside the other
    ],
    ("name", ""): ["../up", "line\n", "", "x" * 65, 7],
    ("optimal_makespan", ""): [0, 2.5, True],
}
"""The place of a problem, another place that it names, and arguments that have no other problem."""


class TestRules:
    """The exact place of each problem, and no other problem."""

    def test_rules(self) -> None:
        for (place, other), values in INVALID.items():
            name = re.split(r"[.\[]", place)[0]
            without: dict[str, Any] = {"holes": ()} if name == "vertices" else {}
            for value in values:
                (problem,) = problems_of(**without, **{name: value})
                assert problem.startswith(f"{place}: ") and other in problem, (place, value)
        (problem,) = problems_of(vertices=[*SQUARE[:3], (0, 99)], arena=(100, 99), holes=())
        assert problem.startswith("vertices[2]: ")

    def test_too_many_robots_and_corners(self) -> None:
        starts = [(5 + 10 * (k % 9), 5 + 10 * (k // 9)) for k in range(65)]
        for changes, place in (
            ({"starts": starts, "holes": ()}, "starts"),
            ({"vertices": circle(501), "holes": ()}, "vertices"),
            ({"vertices": circle(497), "starts": [(30, 30)], "rois": [(20, 50)]}, "holes"),
        ):
            assert [problem.split(":")[0] for problem in problems_of(**changes)] == [place]

    def test_the_limits_themselves_are_valid(self) -> None:
        starts = [(5 + 10 * (k % 8), 5 + 10 * (k // 8)) for k in range(64)]
        field = square(starts=starts, rois=[(k, 99) for k in range(24)], holes=())
        assert (len(field.starts), len(field.rois)) == (64, 24)
        assert len(square(vertices=circle(496), starts=[(30, 30)], rois=[(20, 50)]).edges) == 500

    def test_the_largest_field_survives_a_round_trip(self, tmp_path: Path) -> None:
        starts = [(x / 2 + 25, y / 2 + 25) for x, y in circle(12)]
        rois = [(x / 1.5 + 10, y / 1.5 + 10) for x, y in circle(24)]
        field = Field(circle(500), rois, starts)
        save_field(field, tmp_path / "custom.yaml")
        assert load_field(tmp_path / "custom.yaml") == field

    def test_boundaries_belong_to_the_field(self) -> None:
        slanted = [(0.0, 0.0), (90.0, 30.0), (0.0, 60.0)]
        field = Field(
            slanted, rois=[(45.0, 15.0)], starts=[(0.0, 0.0), (0.0, 10.0)], arena=(90, 60)
        )
        assert len(field.starts) == 2
        assert len(square(rois=[(40.0, 50.0), (60.0, 60.0), (100.0, 0.0)]).rois) == 3

    def test_points_that_rounding_puts_outside_are_on_the_border(self) -> None:
        slanted, hole = (
            [(10.1, 20.3), (333.3, 47.9), (280.7, 310.1)],
            [(250, 100), (270, 99), (260, 80.3)],
        )
        for border in (shapely.LinearRing(slanted), shapely.LinearRing(hole)):
            for share in np.linspace(0.0, 1.0, 100, endpoint=False):
                x, y = shapely.get_coordinates(border.interpolate(share, normalized=True))[0]
                assert len(Field(slanted, [(x, y)], [(x, y)], [hole]).rois) == 1
        for away in ((170.0, 33.0), (260.0, 99.0)):
            with pytest.raises(FieldError, match="rois"):
                Field(slanted, [away], [(200, 100)], [hole])

    def test_the_configuration_knows_how_near_starts_may_be(self) -> None:
        near = square(starts=[(10, 10), (16, 18 - 1e-9)])  # 6-8-10, but for 1e-9
        with pytest.raises(ConfigError, match=r"safety_distance: 10.*starts 0 and 1"):
            parallel_env(near)
        parallel_env(near, safety_distance=9.9)
        parallel_env(near, n_robots=1)
        parallel_env(square(starts=[(10, 10), (16, 18)]))

    def test_degrees_as_units_are_warned_of(self) -> None:
        parcel = Field([(5.1, 52.1), (5.2, 52.1), (5.2, 52.2)], [(5.18, 52.15)], [(5.15, 52.12)])
        with pytest.warns(UserWarning, match="smaller than an ROI"):
            parallel_env(parcel)

    def test_all_problems_at_once(self) -> None:
        problems = problems_of(
            vertices=[*SQUARE, (0.0, 0.0)],
            rois=[(90, 90), (150, 50), (50, 50), (math.nan, 1)],
            starts=[(10, 10), (12, 10), (2000, 10)],
            holes=[HOLE, [(55, 55), (80, 55), (80, 80)], [(1, 1), (2, 2)]],
            arena=(1000, -1),
            name="no/slash",
            optimal_makespan=-1,
        )
        places = sorted(problem.split(": ")[0] for problem in problems)
        assert places == [
            *("arena", "holes[1]", "holes[2]", "name", "optimal_makespan", "rois[1]", "rois[2]"),
            *("rois[3].x", "starts[2]", "vertices[4]"),
        ]


numbers = (
    st.floats(allow_nan=True, allow_infinity=True)
    | st.integers(-(10**400), 10**400)
    | st.sampled_from([0, 1, 2, 50, 100, 5e-324, 1e-200, 1e6, 1e6 + 1])
)
scalars = numbers | st.none() | st.booleans() | st.text(max_size=5) | st.binary(max_size=3)
lists = st.lists(st.lists(numbers, min_size=2, max_size=2), min_size=1, max_size=12)
trees = st.recursive(scalars, lambda inner: st.lists(inner, max_size=5), max_leaves=20)


class TestHostileArguments:
    @settings(max_examples=100)
    @given(
        vertices=lists | trees,
        rois=lists | trees,
        starts=lists | trees,
        holes=st.lists(lists, max_size=3) | trees,
        arena=st.tuples(numbers, numbers) | trees,
        name=st.just("custom") | scalars,
        optimal_makespan=st.none() | scalars,
    )
    def test_only_field_errors(self, **values: Any) -> None:
        try:
            field = Field(**values)
        except FieldError as error:
            assert error.problems
        else:
            assert field.polygon.is_valid

    @settings(max_examples=100)
    @given(
        ring=st.lists(
            st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=3, max_size=7, unique=True
        ),
        point=st.tuples(st.integers(0, 4), st.integers(0, 4)),
    )
    def test_inside_agrees_with_exact_integer_arithmetic(
        self, ring: list[tuple[int, int]], point: tuple[int, int]
    ) -> None:
        corner = ring[0]
        try:
            Field(ring, rois=[corner], starts=[corner])
        except FieldError:
            return  # not a simple polygon
        try:
            Field(ring, rois=[point], starts=[corner])
        except FieldError as error:
            assert [problem.split(":")[0] for problem in error.problems] == ["rois[0]"]
            assert not _inside_or_on(ring, point)
        else:
            assert _inside_or_on(ring, point)


def _inside_or_on(ring: list[tuple[int, int]], point: tuple[int, int]) -> bool:
    """Even-odd rule on integers, the boundary included; exact."""
    x, y = point
    inside = False
    for (ax, ay), (bx, by) in zip(ring, [*ring[1:], ring[0]], strict=True):
        cross = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        within = min(ax, bx) <= x <= max(ax, bx) and min(ay, by) <= y <= max(ay, by)
        if cross == 0 and within:
            return True
        if (ay > y) != (by > y) and (cross > 0) == (by > ay):
            inside = not inside
    return inside
