"""Fields from maps: GeoJSON and WKT, degrees and metres, and what is mended."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from baselines.cli.main import main
from mbn_marl.errors import ConfigError, FieldError
from mbn_marl.field import Field, load_field, load_map
from tests.support.field_cases import write
from tests.support.problems import places_of

FARM = [[0, 0], [400, 0], [400, 300], [0, 300]]
POND = [[180, 140], [180, 180], [220, 180], [220, 140]]
METRE = 360 / 40_007_863  # degrees of latitude, on average


def ring(points: list[list[float]], dx: float = 0.0, dy: float = 0.0) -> list[list[float]]:
    return [[x + dx, y + dy] for x, y in [*points, points[0]]]


def polygon(*rings: list[list[float]], **properties: Any) -> dict[str, Any]:
    geometry = {"type": "Polygon", "coordinates": rings}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def point(x: float, y: float, **properties: Any) -> dict[str, Any]:
    geometry = {"type": "Point", "coordinates": [x, y, 7.5]}
    return {"type": "Feature", "properties": properties or None, "geometry": geometry}


POINTS = (point(50, 50, kind="roi"), point(350, 250, Kind="ROI"), point(30, 200, kind="start"))


def read(folder: Path, *features: dict[str, Any], pick: str = "", **options: Any) -> Any:
    """Return the field of a collection of features, and the notes as one text."""
    text = json.dumps({"type": "FeatureCollection", "features": features})
    path = write(folder, text, "my farm.geojson")
    field, notes = load_map(f"{path}{pick}", **options)
    return field, "\n".join(notes)


def test_metres_are_moved_to_the_origin(tmp_path):
    x, y = 412_300.25, 5_200_700.5
    moved = [point(x + 50, y + 50, kind="roi"), point(x + 30, y + 200, kind="start")]
    field, notes = read(tmp_path, polygon(ring(FARM, x, y), ring(POND, x, y)), *moved)
    same = Field(FARM, [(50, 50)], [(30, 200)], [POND], name="my_farm")
    assert field == same
    assert "metres; the field is 400.0 x 300.0 m, a unit is 1 m" in notes


@pytest.mark.parametrize(("west", "south"), [(6.5, 51.9), (-58.0, -34.0), (179.999, -17.0)])
def test_degrees_become_metres(tmp_path, west, south):
    across = METRE / np.cos(np.radians(south))
    corners = [[(west + x * across + 180) % 360 - 180, south + y * METRE] for x, y in FARM]
    field, notes = read(tmp_path, polygon([*corners, corners[0]]))
    assert "degrees" in notes
    np.testing.assert_allclose(field.vertices, FARM, rtol=0.01)


WKT = "POLYGON ((0 0, 400 0, 400 300, 0 300, 0 0), (180 140, 180 180, 220 180, 220 140, 180 140))"


@pytest.mark.parametrize(
    ("text", "rois"),
    [
        (WKT, 8),
        (f"SRID=32632;{WKT}\n".replace("POLYGON", "Polygon"), 8),
        (f"\ufeff{WKT}\nPOINT (50 50)\nMULTIPOINT Z (350 250 1, 60 70 1)", 3),
        (f"GEOMETRYCOLLECTION ({WKT}, POINT (50 50))", 1),
        # Open rings, beside points that are no ring.
        (f"{WKT.replace(', 0 0)', ')')}\nMULTIPOINT ((50 50), (350 250), (60 70))", 3),
        (f"{WKT.replace(', 0 0)', ')')}\nMULTIPOINT (50 50, 350 250, 60 70)", 3),
    ],
)
def test_wkt(tmp_path, text, rois):
    path = write(tmp_path, text, "farm.wkt")
    field, _ = load_map(path, robots=4, rois=8)
    np.testing.assert_array_equal(field.vertices, FARM)
    np.testing.assert_array_equal(field.holes, [POND])
    assert (len(field.starts), len(field.rois)) == (4, rois)
    with pytest.raises(FieldError, match="mbn fields --from"):
        load_field(path)


@pytest.mark.parametrize(
    ("features", "note"),
    [
        ([polygon([*FARM, [0.004, 0.003], FARM[0]])], "1 repeated corners"),
        ([polygon(ring(FARM), ring(POND[:2]))], "mended"),  # a hole without area
        ([polygon([*FARM[:2], [500, 0], *FARM[1:], FARM[0]])], "mended"),  # a spike
        ([polygon(ring(FARM)), point(-0.5, 50)], "moved to its border"),
        ([polygon(ring(FARM)), point(50, 50, kind="tree")], "tree: left out"),
        ([polygon(ring(FARM)), point(50, 50, kind="\ud800")], "?: left out"),
    ],
)
def test_what_is_mended_is_said(tmp_path, features, note):
    field, notes = read(tmp_path, *features)
    assert note in notes
    assert field.polygon.area == pytest.approx(120_000, abs=1)
    assert load_map(tmp_path / "my farm.geojson")[0] == field


def test_a_spike_moves_neither_the_origin_nor_the_arena(tmp_path):
    square = [[0, 0], [100, 0], [100, 100], [0, 100], [0, 50], [-3000, 50], [0, 50]]
    field, notes = read(tmp_path, polygon(ring(square)))
    assert field.vertices.min(0).tolist() == [0, 0] and field.arena == (1000, 1000)
    assert "the field is 100.0 x 100.0 m" in notes


def test_many_corners_are_simplified(tmp_path):
    angles = np.linspace(0, 2 * np.pi, 3000, endpoint=False)
    circle = (200 + 200 * np.stack([np.cos(angles), np.sin(angles)], 1)).tolist()
    field, notes = read(tmp_path, polygon([*circle, circle[0]]))
    assert 50 < len(field.vertices) <= 500
    assert "3001 corners simplified" in notes
    assert field.polygon.area == pytest.approx(np.pi * 200**2, rel=0.01)


def test_polygons_are_picked_and_holes_are_cut_out(tmp_path):
    pond = polygon(ring(POND), kind="hole")
    lake = polygon(ring(POND, 200, 0), kind="Hole")
    farms = [polygon(ring(FARM), Name="A"), polygon(ring(FARM, 450), name="B"), pond, lake, *POINTS]
    for pick in ("", "#C"):
        assert places_of(FieldError, read, tmp_path, *farms, pick=pick) == ["file"]
    for pick in ("#A", "#1"):
        field, _ = read(tmp_path, *farms, pick=pick)
        assert (field.name, len(field.holes), len(field.rois), len(field.starts)) == ("A", 1, 2, 1)
        assert field.polygon.area == 120_000 - 40 * 40 - 20 * 40  # the lake is cut by the border
    assert "left out" in read(tmp_path, *farms, pick="#B")[1]


@pytest.mark.parametrize(
    ("features", "place"),
    [
        ([polygon(ring(FARM)), point(500, 50)], "features[1]"),  # outside
        ([polygon(ring([[0, 0], [10, 0], [10, 10]]))], "outline"),  # smaller than an ROI
        ([polygon(ring([[0, 0], [400, 300], [400, 0], [0, 300]]))], "features[0]"),  # two pieces
        ([polygon([[0, 0], [400, float("nan")], [3, 4]])], "features[0]"),
        ([point(1, 2)], "file"),
        ([{"type": "LineString", "coordinates": [[0, 0], [1, 1]]}], "features[0]"),
        ([{"type": "Point", "coordinates": [10**400, 0]}], "features[0]"),
        ([[1]], "features[0]"),
    ],
)
def test_bad_maps(tmp_path, features, place):
    assert places_of(FieldError, read, tmp_path, *features) == [place]


def test_every_problem_is_listed(tmp_path):
    line, wrong = {"type": "LineString", "coordinates": [[0, 0], [1, 1]]}, {"type": "Nope"}
    found = places_of(FieldError, read, tmp_path, polygon(ring(FARM)), line, wrong)
    assert found == ["features[1]", "features[2]"]
    for metres in (-1, "1"):
        wrong = {"robots": 0, "metres_per_unit": metres}
        assert places_of(ConfigError, load_map, tmp_path / "my farm.geojson", **wrong) == [*wrong]
    # A sampler takes ranges, a map does not.
    wrong = {"robots": (2, 3), "rois": 2.5, "seed": None, "metres_per_unit": True}
    assert places_of(ConfigError, load_map, tmp_path / "my farm.geojson", **wrong) == [*wrong]
    assert places_of(FieldError, load_map, b"my farm.geojson") == ["source"]
    assert len(read(tmp_path, polygon(ring(FARM)), robots=2.0)[0].starts) == 2


def test_other_files_are_refused(tmp_path):
    for text in ("", '{"a": 1}', '{"type": "Polygon"}', "CIRCLE (1 2)", "[" * 10_000):
        with pytest.raises(FieldError, match=r"neither GeoJSON|expected a type and coordinates"):
            load_map(write(tmp_path, text, "some.json"))


def test_placed_points_have_room_and_a_seed(tmp_path):
    farm = polygon(ring(FARM), ring(POND))
    one, other = (read(tmp_path, farm, robots=64, rois=24, seed=3)[0] for _ in range(2))
    gaps = np.linalg.norm(one.starts[:, None] - one.starts, axis=2) + 1e9 * np.eye(64)
    assert one == other and gaps.min() >= 12
    thin = polygon(ring([[0, 0], [400, 0], [400, 9]]))
    assert places_of(FieldError, read, tmp_path, thin, rois=24, robots=64) == ["outline"]
    strip = [[0, 0], [600, 600], [590, 610], [-10, 10]]  # a hundredth of its box has room
    for seed in range(5):
        assert len(read(tmp_path, polygon(ring(strip)), seed=seed)[0].starts) == 3


def test_command(tmp_path, capsys):
    read(tmp_path, polygon(ring(FARM)), *POINTS)
    words = ["fields", "--from", str(tmp_path / "my farm.geojson")]
    out = tmp_path / "new" / "farm.yaml"
    assert main([*words, "-o", str(out), "--metres-per-unit", "0.5"]) == 0
    assert load_field(out).vertices.max() == 800
    assert "a unit is 0.5 m" in capsys.readouterr().out
    for more in (["-o", str(out)], ["--generate", "farm"], ["--metres-per-unit", "0"]):
        assert main([*words, *more]) == 2
        assert "makespan" not in capsys.readouterr().out
