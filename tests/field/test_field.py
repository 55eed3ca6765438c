"""Fields: the value, and the rules, each by a case worked out by hand."""

import copy
import json
import math
import pickle
import re

import numpy as np
import pytest
import shapely

from mbn_marl import BatchEngine, parallel_env
from mbn_marl.errors import ConfigError, FieldError
from mbn_marl.field import Field
from tests.support.field_cases import HOLE, SQUARE, circle, square
from tests.support.problems import places_of


def test_arrays_edges_and_defaults():
    field = square()
    np.testing.assert_array_equal(field.vertices, SQUARE)
    np.testing.assert_array_equal(field.holes[0], HOLE)
    np.testing.assert_array_equal(field.edges[3], [0, 100, 0, 0])
    np.testing.assert_array_equal(field.edges[7], [40, 60, 40, 40])
    assert field.edges.shape == (8, 4)
    assert field.polygon.area == 100 * 100 - 20 * 20
    assert (field.arena, field.name, field.optimal_makespan) == ((1000, 1000), "custom", None)
    assert square(vertices=np.array(SQUARE, np.float32), rois=np.array([[90, 90]])) == square()


def test_values_are_equal_and_immutable():
    assert square() == square()
    assert hash(square()) == hash(square())
    assert square(starts=[(-0.0, 0.0)]) == square(starts=[(0.0, 0.0)])
    for change in (
        {"vertices": SQUARE[1:] + SQUARE[:1]},
        {"rois": [(90.0, 91.0)]},
        {"holes": ()},
        {"arena": (100, 100)},
        {"name": "other"},
        {"optimal_makespan": 3},
        {"roi_kinds": (1,), "start_kinds": (1, 0)},
    ):
        assert square(**change) != square()
    kinds = {"roi_kinds": [None], "start_kinds": np.array([3, 0])}
    field = square(name="mine", optimal_makespan=24, arena=(200.0, 100.0), **kinds)
    for copied in (pickle.loads(pickle.dumps(field)), copy.deepcopy(field)):
        assert copied == field == Field(**json.loads(json.dumps(field.to_dict()))) != "mine"
    with pytest.raises(AttributeError, match="name"):
        field.name = "other"
    for array in (field.vertices, field.rois, field.starts, field.edges, *field.holes):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
        with pytest.raises(ValueError, match="WRITEABLE"):
            array.setflags(write=True)


# The place of a problem, another place that it names, and arguments with no other problem.
INVALID = {
    ("vertices", ""): [SQUARE[:2], "triangle", [(0, 0), (50, 50), (100, 100)], circle(501)],
    ("rois", ""): [[], None, [(90, 80 + k / 4) for k in range(25)], {(90, 90)}],
    ("starts", ""): [(), [(5 + 10 * (k % 9), 5 + 10 * (k // 9)) for k in range(65)]],
    ("holes", ""): [3],
    ("rois[1]", ""): [[(90, 90), (90, 90, 0)], [(90, 90), 7]],
    ("rois[0].y", ""): [[(90,)], [(90, math.inf)], [(90, 10**5000)]],
    ("starts[0].x", ""): [[(True, 10)], [(math.nan, 10)]],
    ("rois[0]", ""): [[(100.5, 50)]],
    ("vertices[4].x", ""): [[*SQUARE, (-math.inf, 50)], [*SQUARE, (-1, 50)]],
    ("arena", ""): [100],
    ("arena.y", ""): [(100, 1e7)],
    ("rois[2]", "rois[0]"): [[(90, 90), (80, 80), (90, 90)]],
    ("starts[1]", "holes[0]"): [[(10, 10), (50, 50)]],
    ("vertices", "vertices[0]-vertices[1] meets vertices[2]-vertices[3]"): [
        [SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]],
        [(0, 0), (100, 0), (50, 0), (50, 50)],  # a spike
    ],
    ("holes[0]", "holes[0][0]-holes[0][1] meets holes[0][2]-holes[0][3]"): [
        [[HOLE[0], HOLE[2], HOLE[1], HOLE[3]]],
    ],
    ("holes[0]", ""): [[HOLE[:2]], [SQUARE[:3]], [[(70, 70), (110, 70), (70, 90)]]],
    ("holes[1]", "holes[0]"): [
        [HOLE, [(45, 45), (55, 45), (50, 55)]],  # inside the other
    ],
    ("name", ""): ["../up", "line\n", "", "x" * 65, 7],
    ("optimal_makespan", ""): [0, 2.5, True],
    ("start_kinds[0]", ""): [[-1, 0], [64, 0], [True, 0], [None, 0]],
    ("start_kinds", ""): [[0], (), "00"],
    ("roi_kinds[0]", ""): [[1], [0.5]],
    ("roi_kinds", ""): [[], [0, None], 0],
}


@pytest.mark.parametrize(("place", "other"), INVALID)
def test_problems_name_the_place(place, other):
    name = re.split(r"[.\[]", place)[0]
    without = {"holes": ()} if name in ("vertices", "starts") else {}
    if name.endswith("kinds"):
        without = {"roi_kinds": (None,), "start_kinds": (0, 0)}
    for value in INVALID[place, other]:
        given = {name: value} if other.startswith("holes") else {**without, name: value}
        with pytest.raises(FieldError) as caught:
            square(**given)
        (problem,) = caught.value.problems
        assert problem.startswith(f"{place}: ") and other in problem, value


def test_nan_is_no_number():
    for call in (
        lambda: square(rois=[(math.nan, 90)]),
        lambda: parallel_env(tau=np.float32("nan")),
    ):
        with pytest.raises(
            ValueError, match=r"(rois\[0\].x|tau): Input should be a number, not NaN"
        ):
            call()


def test_problems_of_several_arguments():
    few = {"starts": [(30, 30)], "rois": [(20, 50)]}
    assert places_of(FieldError, square, vertices=circle(497), **few) == ["holes"]
    assert len(square(vertices=circle(496), **few).edges) == 500
    places = places_of(
        *(FieldError, square),
        vertices=[*SQUARE, (0.0, 0.0)],
        rois=[(90, 90), (150, 50), (50, 50), (math.nan, 1)],
        starts=[(10, 10), (12, 10), (2000, 10)],
        holes=[HOLE, [(55, 55), (80, 55), (80, 80)], [(1, 1), (2, 2)]],
        **{"arena": (1000, -1), "name": "no/slash", "optimal_makespan": -1},
    )
    assert sorted(places) == [
        *("arena.y", "holes[1]", "holes[2]", "name", "optimal_makespan", "rois[1]", "rois[2]"),
        *("rois[3].x", "starts[2]", "vertices[4]"),
    ]


SLANTED = (
    [(10.1, 20.3), (333.3, 47.9), (280.7, 310.1)],
    [(250, 100), (270, 99), (260, 80.3)],  # a hole
)


def test_points_that_rounding_puts_outside_are_on_the_border():
    slanted, hole = SLANTED
    for border in map(shapely.LinearRing, SLANTED):
        for share in np.linspace(0.0, 1.0, 100, endpoint=False):
            x, y = shapely.get_coordinates(border.interpolate(share, normalized=True))[0]
            assert len(Field(slanted, [(x, y)], [(x, y)], [hole]).rois) == 1
    for away in ((170.0, 33.0), (260.0, 99.0)):
        with pytest.raises(FieldError, match="rois"):
            Field(slanted, [away], [(200, 100)], [hole])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("border", SLANTED)
def test_robots_at_rest_on_the_border_pay_for_no_wall(border, dtype):
    outline, hole = SLANTED
    shares = np.linspace(0.0, 1.0, 60, endpoint=False)
    starts = shapely.get_coordinates(
        shapely.LinearRing(border).interpolate(shares, normalized=True)
    )
    field = Field(outline, [(200, 100)], starts, [hole])
    engine = BatchEngine(field, 1, dtype=dtype, safety_distance=0.0)
    engine.reset()
    engine.step(np.zeros((1, 60, 2)))
    assert engine.metrics()["wall_hits"].sum() == 0
    np.testing.assert_allclose(engine.state()[0, :120], starts.ravel(), atol=1e-4)


def test_environments_check_starts_and_scale():
    near = square(starts=[(10, 10), (16, 18 - 1e-9)])  # 6-8-10, but for 1e-9
    with pytest.raises(ConfigError, match=r"safety_distance: 10.*starts 0 and 1"):
        parallel_env(near)
    parallel_env(near, safety_distance=9.9)
    parallel_env(square(starts=[(10, 10), (16, 18)]))
    parcel = Field([(5.1, 52.1), (5.2, 52.1), (5.2, 52.2)], [(5.18, 52.15)], [(5.15, 52.12)])
    with pytest.warns(UserWarning, match="smaller than an ROI"):
        parallel_env(parcel)
