"""Fields from maps: polygons and points in GeoJSON or WKT, in degrees or in metres."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import shapely
from pydantic import Field as Described
from shapely.errors import ShapelyError
from shapely.geometry import mapping, shape

from mbn_marl.config import Checked, RealNumber
from mbn_marl.errors import FieldError
from mbn_marl.field.field import Field
from mbn_marl.field.files import location_of, name_from, read_bytes, split_location
from mbn_marl.field.generator.layout import MILLI, ROIS_APART, STARTS_APART, WALL
from mbn_marl.field.generator.sampler import Robots, Rois, Seed
from mbn_marl.field.schema import MAX_COORDINATE, MAX_VERTICES, ROI_RADIUS

Coordinates = npt.NDArray[np.float64]  # (k, 2)
Point = tuple[float, float]
Scale = Callable[[Coordinates], Coordinates]

MAX_MAP_BYTES = 16 * 1024 * 1024
MOST_DEGREES = 0.5
"""A wider outline is in metres, even if its coordinates could be degrees."""
NEAR = 0.01
"""Corners or points closer than this, in units, are one."""
SNAP = 1.0
"""Points at most so far outside the field, in units, are moved to its border."""
RADIUS, ECCENTRICITY_SQUARED = 6_378_137.0, 0.00669437999014
"""Of WGS 84: metres at the equator."""
CANDIDATES = 200
"""Random points that are compared for each ROI or start that is placed."""
ROUNDS = 100
"""Of candidates that are tried until one has room."""
ALLOWED = "Polygon, MultiPolygon, Point, MultiPoint, or a collection of such, numbers below 1e9"


class _Numbers(Checked):
    """The arguments of :func:`load_map` that are numbers."""

    robots: Robots
    rois: Rois
    seed: Seed
    metres_per_unit: Annotated[RealNumber, Described(gt=0.0, allow_inf_nan=False)]

    @classmethod
    def _source(cls) -> str:
        return "map"


@dataclass(frozen=True)
class _Shape:
    """A polygon or a point of a map."""

    place: str  # such as "features[2]"
    name: str  # empty if the map has none
    kind: str  # as the map says, in lower case; empty if it does not
    geometry: Any


def load_map(
    source: str | os.PathLike[str],
    *,
    metres_per_unit: float = 1.0,
    robots: int = 3,
    rois: int = 6,
    seed: int = 0,
) -> tuple[Field, list[str]]:
    """Make a field of a map: a polygon with holes, and points that are ROIs and starts.

    Args:
        source: the path of a GeoJSON or WKT file in degrees (longitude, latitude) or metres;
            ``path#name`` or ``path#2`` picks one of several polygons.
        metres_per_unit: the length of a unit in metres.
        robots: how many starts are placed, 1 to 64, if the map has none.
        rois: how many ROIs are placed, 1 to 24, if the map has none.
        seed: of the random places, at least 0.

    Returns:
        The field, and a line for all that was assumed, mended, left out or placed.

    Raises:
        FieldError: listing every problem with its place.
        ConfigError: listing every argument that is not in its range.
    """
    given = _Numbers(robots=robots, rois=rois, seed=seed, metres_per_unit=metres_per_unit)
    path, wanted = split_location(location_of(source, "a path"))
    notes: list[str] = []
    try:
        shapes = _shapes(read_bytes(Path(path), MAX_MAP_BYTES))
        polygons = [one for one in shapes if one.geometry.geom_type == "Polygon"]
        outers = [one for one in polygons if one.kind != "hole"]
        chosen = _chosen(outers, wanted, Path(path).name)
        corners = shapely.get_coordinates(_without_spikes(chosen.geometry).exterior)
        scale = _scale(corners, given.metres_per_unit, notes)
        polygon = _mended(chosen, scale, notes)
        for hole in polygons:
            if hole.kind == "hole":
                polygon = _one(polygon.difference(_mended(hole, scale, notes)), hole.place)
        polygon = _simplified(polygon, chosen.place, notes)
        points = [one for one in shapes if one.geometry.geom_type == "Point"]
        found = _points(points, polygon, scale, len(outers) > 1, notes)
        rng = np.random.default_rng(given.seed)
        placed = {"roi": (given.rois, ROIS_APART), "start": (given.robots, STARTS_APART)}
        for kind, (count, apart) in placed.items():
            if not found[kind]:
                taken = found["roi"] + found["start"]
                found[kind] = _placed(polygon, count, apart / MILLI, taken, rng)
                notes.append(f"{kind}: none in the map: {count} placed at random")
        rings = [polygon.exterior, *polygon.interiors]
        outline, *inner = [shapely.get_coordinates(ring)[:-1] for ring in rings]
        arena = [max(1000.0, 10.0 * math.ceil(most / 10.0)) for most in polygon.bounds[2:]]
        name = name_from(chosen.name or Path(path).stem)
        field = Field(outline, found["roi"], found["start"], inner, arena=arena, name=name)
    except FieldError as error:
        raise FieldError(path, error.problems) from None
    return field, notes


def _error(problem: str) -> FieldError:
    return FieldError("map", [problem])


def _shapes(data: bytes) -> list[_Shape]:
    """Return the polygons and points of GeoJSON or WKT text."""
    try:
        text = data.decode("utf-8-sig").strip()
        document = json.loads(text) if text[:1] == "{" else mapping(_from_wkt(text))
    except (ValueError, RecursionError, ShapelyError) as error:
        raise _error(f"file: neither GeoJSON nor WKT: {str(error)[:200]}") from None
    if document.get("type") != "FeatureCollection":
        return _feature(document, "file")
    features = document.get("features")
    if not isinstance(features, list):
        raise _error("features: expected a list")
    found, problems = list[_Shape](), list[str]()
    for k, one in enumerate(features):
        try:
            found += _feature(one, f"features[{k}]")
        except FieldError as error:
            problems += error.problems
    if problems:
        raise FieldError("map", problems)
    return found


def _from_wkt(text: str) -> shapely.Geometry:
    """Return the geometries of WKT text as one collection, with its rings closed."""

    def close(ring: re.Match[str]) -> str:
        points = ring[1].split(",")
        is_open = len(points) > 2 and points[0].split() != points[-1].split()
        return f"({ring[1]},{points[0]})" if is_open else ring[0]

    text = re.sub(r"SRID=\d+;", "", text, flags=re.IGNORECASE).rstrip(";")
    if "POLYGON" in text.upper():
        points = r"(MULTIPOINT[^(]*\((?:[^()]|\([^()]*\))*\))"
        parts = re.split(points, text, flags=re.IGNORECASE)
        parts[::2] = [re.sub(r"\(([^()]+)\)", close, part) for part in parts[::2]]
        text = "".join(parts)
    kinds = r"\)[\s;]*(?=(?:MULTI)?(?:POLYGON|POINT)\b)"  # geometries that follow each other
    several = re.sub(kinds, "),", text, flags=re.IGNORECASE)
    return shapely.from_wkt(f"GEOMETRYCOLLECTION({several})")


def _feature(node: Any, place: str) -> list[_Shape]:
    """Return the polygons and points of a GeoJSON feature or geometry."""
    if not isinstance(node, dict):
        raise _error(f"{place}: expected a GeoJSON object, got {type(node).__name__}")
    geometry: Any = node
    properties = node.get("properties") or {}
    if not isinstance(properties, dict):
        raise _error(f"{place}: properties: expected names and values")
    properties = {"name": node.get("id")} | {key.lower(): v for key, v in properties.items()}
    if node.get("type") == "Feature" and (geometry := node.get("geometry")) is None:
        return []
    needed = isinstance(geometry, dict) and geometry.keys() & {"coordinates", "geometries"}
    if not (needed and isinstance(geometry.get("type"), str)):
        raise _error(f"{place}: expected a type and coordinates; allowed: {ALLOWED}")
    try:
        found = shape(geometry)
    except (
        ShapelyError,
        TypeError,
        LookupError,
        AttributeError,
        ValueError,
        OverflowError,
    ) as error:
        raise _error(f"{place}: {str(error)[:200]}; allowed: {ALLOWED}") from None
    return _parts(found, place, properties)


def _parts(geometry: shapely.Geometry, place: str, properties: dict[str, Any]) -> list[_Shape]:
    if hasattr(geometry, "geoms"):
        return [one for part in geometry.geoms for one in _parts(part, place, properties)]
    numbers = shapely.get_coordinates(geometry)
    if geometry.geom_type not in ("Polygon", "Point") or not np.all(np.abs(numbers) < 1e9):
        raise _error(f"{place}: {str(geometry)[:80]}; allowed: {ALLOWED}")
    if geometry.is_empty:
        raise _error(f"{place}: coordinates: empty; allowed: {ALLOWED}")
    name, kind = (properties.get(key) for key in ("name", "kind"))
    kind = str(kind or "").lower().encode(errors="replace").decode()  # JSON allows half a character
    return [_Shape(place, "" if name is None else str(name), kind, geometry)]


def _chosen(polygons: Sequence[_Shape], wanted: str | None, file: str) -> _Shape:
    """Return the polygon with a name or a number from 1 on; there is one if none is wanted."""
    if not polygons:
        raise _error("file: no polygon for the field's outline")
    picks = [one for one in polygons if wanted in (None, one.name)]
    if wanted and not picks and wanted.isdecimal():
        picks = [*polygons[int(wanted) - 1 : int(wanted)]]
    if len(picks) != 1:
        names = [f"{k} {one.name}".strip() for k, one in enumerate(polygons, 1)]
        shown = ", ".join(names[:20]) + f" .. {len(names)}" * (len(names) > 20)
        problem = f"{len(picks)} polygons" + ("" if wanted is None else f" named {wanted!r}")
        raise _error(f"file: {problem}; pick one as {file}#NUMBER or #NAME: {shown}")
    return picks[0]


def _scale(outline: Coordinates, metres_per_unit: float, notes: list[str]) -> Scale:
    """Return the way from a map's coordinates to units, with the south-west corner at (0, 0)."""
    west = outline[0, 0]

    def unwrapped(points: Coordinates) -> Coordinates:  # no step from 180 to -180
        x = west + (points[:, 0] - west + 180.0) % 360.0 - 180.0
        return np.stack([x, points[:, 1]], axis=1)

    flat = unwrapped(outline)
    could_be = bool(np.all(np.abs(outline).max(0) <= (180.0, 90.0)))
    degrees = could_be and bool(np.ptp(flat, axis=0).max() < MOST_DEGREES)
    # The ellipsoid's radii of curvature in the middle of the field, along and across.
    middle = (flat[:, 1].min() + flat[:, 1].max()) / 2.0 if degrees else 0.0
    bent = 1.0 - ECCENTRICITY_SQUARED * math.sin(math.radians(middle)) ** 2
    east = RADIUS / math.sqrt(bent) * math.cos(math.radians(middle))
    north = RADIUS * (1.0 - ECCENTRICITY_SQUARED) / bent**1.5

    def metres(points: Coordinates) -> Coordinates:
        if not degrees:
            return points
        return np.asarray(np.radians(unwrapped(points) - (west, middle)) * (east, north))

    origin = metres(outline).min(0)
    sides = np.ptp(metres(outline), axis=0)
    corner = flat.min(0) if degrees else origin
    across = f"{sides[0]:,.1f} x {sides[1]:,.1f} m"
    kind = "degrees (longitude, latitude)" if degrees else "metres"
    notes.append(f"coordinates: {kind}; the field is {across}, a unit is {metres_per_unit:g} m")
    notes.append(f"origin: (0, 0) is ({corner[0]:.10g}, {corner[1]:.10g}) of the map")
    if not 2.0 * ROI_RADIUS <= sides.max() / metres_per_unit <= MAX_COORDINATE:
        allowed = f"{2.0 * ROI_RADIUS:g} (an ROI) to {MAX_COORDINATE:g} units; see metres_per_unit"
        raise _error(f"outline: {across} in {kind}; allowed: {allowed}")
    return lambda points: np.round((metres(points) - origin) / metres_per_unit, 3)


def _without_spikes(polygon: shapely.Polygon) -> shapely.Polygon:
    """Return the largest part of a polygon that has an area, which tells where the field is."""
    if polygon.is_valid:
        return polygon
    parts = shapely.get_parts(shapely.get_parts(shapely.make_valid(polygon)))
    return max((part for part in parts if part.area), key=lambda part: part.area, default=polygon)


def _mended(one: _Shape, scale: Scale, notes: list[str]) -> shapely.Polygon:
    """Return a polygon of a map in units, valid, without repeated corners."""
    polygon = shapely.transform(one.geometry, scale)
    slim = shapely.remove_repeated_points(polygon, NEAR)
    repeated = len(shapely.get_coordinates(polygon)) - len(shapely.get_coordinates(slim))
    if repeated:
        notes.append(f"{one.place}: {repeated} repeated corners left out")
    if not slim.is_valid:
        notes.append(f"{one.place}: {shapely.is_valid_reason(slim)}: mended")
    return _one(shapely.make_valid(slim), one.place)


def _one(geometry: shapely.Geometry, place: str) -> shapely.Polygon:
    """Return the one polygon of which a geometry consists, but for lines and crumbs."""
    parts = shapely.get_parts(shapely.get_parts(geometry))  # of collections of collections
    parts = [part for part in parts if part.area > NEAR]
    if len(parts) != 1:
        raise _error(f"{place}: {len(parts)} pieces that have an area; allowed: one")
    return parts[0]


def _simplified(polygon: shapely.Polygon, place: str, notes: list[str]) -> shapely.Polygon:
    """Return a polygon with as many corners as a field may have."""
    corners, tolerance = len(shapely.get_coordinates(polygon)), NEAR
    while len(shapely.get_coordinates(polygon)) - 1 - len(polygon.interiors) > MAX_VERTICES:
        tolerance *= 2.0
        if tolerance > ROI_RADIUS:
            raise _error(f"{place}: {corners} corners; allowed: at most {MAX_VERTICES}")
        polygon = _one(polygon.simplify(tolerance), place)
    if tolerance > NEAR:
        left = len(shapely.get_coordinates(polygon))
        notes.append(f"{corners} corners simplified to {left}, within {tolerance:g} units")
    return polygon


def _points(
    shapes: Sequence[_Shape], polygon: Any, scale: Scale, several: bool, notes: list[str]
) -> dict[str, list[Point]]:
    """Return the map's ROIs and starts in units; a point without a kind is an ROI."""
    found: dict[str, list[Point]] = {"roi": [], "start": []}
    problems: list[str] = []
    for one in shapes:
        kind = one.kind or "roi"
        place = f"{one.place}: {kind}"
        if kind not in found:
            notes.append(f"{place}: left out; kinds of points: {', '.join(found)}")
            continue
        point = shapely.transform(one.geometry, scale)
        away = polygon.distance(point)
        if away > SNAP:
            far = f"{place}: {away:,.6g} units outside the field"
            (notes if several else problems).append(far + ": left out" * several)
            continue
        if away > 0.0:
            notes.append(f"{place}: {away:.3g} units outside the field: moved to its border")
            point = shapely.get_point(shapely.shortest_line(polygon, point), 0)
        if any(math.dist((point.x, point.y), other) < NEAR for other in found[kind]):
            notes.append(f"{place}: repeated: left out")
        else:
            found[kind].append((point.x, point.y))
    if problems:
        raise FieldError("map", problems)
    return found


def _placed(
    polygon: Any, count: int, apart: float, taken: list[Point], rng: np.random.Generator
) -> list[Point]:
    """Return random points, each the one of several candidates that is farthest from all others."""
    room = polygon.buffer(-WALL / MILLI)
    low, high = np.reshape(polygon.bounds, (2, 2))
    placed: list[Point] = []
    for _ in range(count):
        others = np.array([*taken, *placed]).reshape(-1, 2)
        for _ in range(ROUNDS):  # in a thin field few candidates are inside
            points = np.round(rng.uniform(low, high, (CANDIDATES, 2)), 3)
            points = points[shapely.covers(room, shapely.points(points))]
            gaps = np.linalg.norm(points[:, None] - others, axis=2).min(1, initial=math.inf)
            if gaps.max(initial=-1.0) >= apart:
                break
        else:
            raise _error(f"outline: no room for {count} points {apart:g} units apart")
        x, y = points[gaps.argmax()].tolist()
        placed.append((x, y))
    return placed
