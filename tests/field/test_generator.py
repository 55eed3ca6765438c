"""Generated fields: the same everywhere, sound by shapely's word, and of the shapes promised."""

import hashlib
import math
import pickle
from itertools import combinations
from typing import Any

import numpy as np
import pytest
import shapely

from mbn_marl.config import NavigationConfig
from mbn_marl.engine.tables import make_geometry
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, FieldSampler, generate
from mbn_marl.field.generator.families import make_fields, root
from mbn_marl.field.generator.layout import FAMILIES, Tables, make_tables, scratch_rows
from mbn_marl.field.generator.sampler import field_of, least_size
from tests.support.field_cases import circle
from tests.support.problems import places_of

ROUNDING = 1e-6  # of shapely's distances, units


def sampler_of(*families: str, **changes: Any) -> FieldSampler:
    return FieldSampler(families, **{"robots": (1, 6), "size": (140, 420), **changes})


def made(sampler: FieldSampler, count: int, numbers: Any = None, dtype: Any = float) -> Tables:
    """The tables of the fields of the first ``count`` worlds, in the first episode."""
    robots, rois = sampler.robots[1], sampler.rois[1]
    tables = make_tables(sampler.most_edges, rois, robots, count)
    reals = ("edges", "rois", "starts", "boxes")
    tables = tables._replace(**{name: getattr(tables, name).astype(dtype) for name in reals})
    scratch = np.full((scratch_rows(robots, rois), count), -7, np.int64)
    numbers = sampler.numbers() if numbers is None else numbers
    make_fields(numbers, sampler.seed, 0, 0, scratch, tables, np.zeros(count, np.int64))
    return tables


def millis(field: Field) -> str:
    parts = (field.vertices, *field.holes, field.rois, field.starts)
    numbers = np.concatenate(parts) * 1000
    assert np.abs(numbers - np.rint(numbers)).max() < ROUNDING
    return hashlib.sha256(np.rint(numbers).astype("<i8").tobytes()).hexdigest()[:16]


PINNED = {  # hashes of the fields of seed 7
    "convex": "4241e0adb2fac2f3",
    "concave": "be6b3df5cc96ae89",
    "corridors": "c2a40f5018a1317f",
    "obstacles": "ecaa95f7165afa37",
    "farm": "fb6d8e0905edb3f7",
}


def test_fields_are_the_same_everywhere():
    assert {family: millis(generate(family, 7)) for family in FAMILIES} == PINNED
    sampler = sampler_of(*FAMILIES, seed=3)
    field = sampler.field(4, 5)
    assert field == sampler_of(*FAMILIES, seed=3).field(4, 5)
    others = [sampler.field(), sampler.field(5, 4), sampler_of(*FAMILIES, seed=4).field(4, 5)]
    assert len({millis(each) for each in (field, *others)}) == 4
    family = field.name.split("-")[0]
    assert field.name == f"{family}-3-4-5"
    assert field == sampler_of(family, seed=3).field(4, 5)
    assert generate("convex", 7).name == "convex-7"


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_tables_are_those_of_make_geometry(dtype):
    sampler = sampler_of(*FAMILIES, rois=(1, 10), seed=1)
    tables = made(sampler, 60, dtype=dtype)
    rois = [(45.0 + k, 60.0) for k in range(sampler.rois[1])]
    starts = [(20.0 + 10 * k, 40.0) for k in range(sampler.robots[1])]
    filler = Field(circle(sampler.most_edges), rois, starts)
    for world in range(60):
        field = sampler.field(world)
        n = len(field.starts)
        other = make_geometry((field, filler), NavigationConfig(dtype=dtype), n, 2).field
        for name in ("edges", "rois", "roi_bits", "codes", "boxes"):
            own, expected = getattr(tables, name)[..., world], getattr(other, name)[..., 0]
            assert own.dtype == expected.dtype
            np.testing.assert_array_equal(own, expected, name)
        ours = tables.starts[..., world]
        np.testing.assert_array_equal(ours[:, :n], other.starts[..., 0])
        assert (ours[:, n:] == ours[:, :1]).all()
        assert tables.robots_in[world] == n


def test_without_room_it_is_a_square():
    sampler = FieldSampler(("corridors",), robots=9, rois=16, size=200)
    numbers = sampler.numbers()
    numbers[2:4] = 61_000
    field = field_of(made(sampler, 1, numbers), sampler.arena, "square")
    assert field.vertices.tolist() == [[0, 0], [61, 0], [61, 61], [0, 61]]
    assert (len(field.rois), len(field.starts)) == (16, 9)


def sharpest(ring: Any) -> float:
    """Return the least angle between edges that meet, in degrees."""
    back, ahead = np.roll(ring, 1, axis=0) - ring, np.roll(ring, -1, axis=0) - ring
    sizes = np.hypot(*back.T) * np.hypot(*ahead.T)
    return float(np.degrees(np.arccos((back * ahead).sum(axis=1) / sizes)).min())


def broken_promises(field: Field, sampler: FieldSampler) -> list[str]:
    """The promises that a field breaks, by shapely."""
    polygon, (low, high) = field.polygon, sampler.size
    x, y, right, top = polygon.bounds
    longest = max(right - x, top - y)
    points = [shapely.Point(point) for point in (*field.rois, *field.starts)]
    rois, starts = points[: len(field.rois)], points[len(field.rois) :]
    walls = min(point.distance(polygon.boundary) for point in points)
    gap = min((a.distance(b) for a, b in combinations(rois, 2)), default=9.0)
    room = min((a.distance(b) for a, b in combinations(starts, 2)), default=12.0)
    promises = {
        "size": low - ROUNDING <= longest <= high + ROUNDING,
        "robots": sampler.robots[0] <= len(starts) <= sampler.robots[1],
        "rois": sampler.rois[0] <= len(rois) <= sampler.rois[1],
        "edges": len(field.edges) <= sampler.most_edges,
        "arena": field.arena == sampler.arena,
        "walls": walls >= 4 - ROUNDING,
        "ROIs apart": gap >= 5 - ROUNDING,
        "starts apart": room >= 12 - ROUNDING,
        "corners": sharpest(field.vertices) >= 34.0,
        "passages": isinstance(polygon.buffer(-5.99), shapely.Polygon),
    }
    return [name for name, kept in promises.items() if not kept]


def test_both_ends_of_a_range_are_named():
    with pytest.raises(ConfigError, match=r"robots: .*equal to 1.*equal to 64"):
        FieldSampler(robots=(0, 99))


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(
    "changes",
    [
        {"robots": 3, "rois": 6, "size": 100.1, "arena": (100.1, 100.1006)},
        {"robots": (1, 64), "rois": (1, 24), "size": 410, "arena": (410, 5000)},
        {"robots": 2, "rois": 24, "size": (300, 100_000), "arena": (1e6, 1e5)},
    ],
)
def test_sound(family, changes):
    sampler = sampler_of(family, **{"rois": (1, 10), **changes})
    for world in range(60):
        field = sampler.field(world)
        assert broken_promises(field, sampler) == [], field.name


def test_weights():
    for weights, shares in (((2, 0, 6), (0.25, 0, 0.75)), (None, (1 / 3, 1 / 3, 1 / 3))):
        sampler = FieldSampler(FAMILIES[:3], weights=weights)
        names = [sampler.field(world).name.split("-")[0] for world in range(300)]
        found = [names.count(family) / 300 for family in FAMILIES[:3]]
        assert found == pytest.approx(shares, abs=0.08)


def test_a_sampler_is_a_value():
    sampler = FieldSampler(["farm", "convex"], robots=(2, 4), weights=[1, 2], seed=5)
    assert sampler == FieldSampler(("farm", "convex"), (2, 4), weights=(1.0, 2.0), seed=5)
    assert sampler == pickle.loads(pickle.dumps(sampler)) != FieldSampler()
    assert FieldSampler(robots=3, size=200) == FieldSampler(robots=(3, 3), size=(200.0, 200))
    with pytest.raises(ValueError, match="seed"):
        sampler.seed = 6


@pytest.mark.parametrize(
    ("given", "places"),
    [
        (
            {
                **{"families": ("convex", "round"), "robots": (1, 65), "rois": "six"},
                **{"size": (50, 200), "arena": (0, 100), "weights": (1, -1)},
                **{"seed": -1, "colour": "red"},
            },
            "families.1 robots rois arena.0 size weights.1 seed colour",
        ),
        *(({"families": families}, "families") for families in ((), ("farm", "farm"))),
        *(({"robots": robots}, "robots") for robots in (2.5, True)),
        ({"rois": (4, 2)}, "rois"),
        *(({"size": size}, "size") for size in (float("nan"), (99, 300))),
        *(({"weights": weights}, "weights") for weights in ((1, 2), (0,))),
        *(({"robots": 64, "rois": 24, name: (400, 420)}, name) for name in ("size", "arena")),
        ({"size": 500, "arena": (900, 400)}, "size"),
    ],
)
def test_all_problems_at_once(given, places):
    assert places_of(ConfigError, FieldSampler, **given) == places.split()


@pytest.mark.parametrize(
    ("given", "size"),
    [
        ({}, (110, 420)),
        ({"robots": (2, 5)}, (120, 420)),
        ({"robots": 64, "rois": 24}, (410, 1000)),
        ({"arena": (100, 500)}, (100, 100)),
    ],
)
def test_default_size_fits_team_and_arena(given, size):
    sampler = FieldSampler(FAMILIES, **given)
    assert sampler.size == size
    assert len(sampler.field().starts) <= sampler.robots[1]
    assert size[0] >= least_size(sampler.robots[1], sampler.rois[1])


def test_roots_are_one_more_than_their_whole_part():
    for whole in (0, 1, 2, 3, 94_906_265, 94_906_267, 2**30 + 1, 2**31 - 1):
        square = whole * whole
        for number in {square, square + 1, square + 2 * whole}:  # up to the next square
            assert root(np.int64(number)) == math.isqrt(number) + 1
