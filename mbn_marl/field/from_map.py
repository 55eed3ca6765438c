"""Fields from maps: polygons and points in GeoJSON or WKT, in degrees or in metres."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely
from shapely.geometry import mapping

from mbn_marl.errors import FieldError
from mbn_marl.field import layout
from mbn_marl.field.field import DEFAULT_ARENA, Field
from mbn_marl.field.files import name_from, read_bytes, split_location
from mbn_marl.field.limits import MAX_COORDINATE, MAX_VERTICES, ROI_RADIUS
from mbn_marl.field.sampler import FieldSampler

_Points = npt.NDArray[np.float64]

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


@dataclass(frozen=True)
class _Shape:
    """A polygon or a point of a map."""

    place: str  # such as "features[2]"
    name: str  # empty if the map has none
    kind: str  # as the map says, in lower case; empty if it does not
    rings: list[_Points]  # of a point: one ring of one point


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
        ConfigError: ``robots``, ``rois`` or ``seed`` is not in its range.
    """
    FieldSampler(robots=robots, rois=rois, seed=seed)  # checks the numbers
    path, wanted = split_location(os.fspath(source))
    notes: list[str] = []
    try:
        if not (0.0 < metres_per_unit < math.inf):
            raise _error(f"metres_per_unit: {metres_per_unit}; allowed: a number above 0")
        shapes = _read(read_bytes(Path(path), MAX_MAP_BYTES), notes)
        polygons = [shape for shape in shapes if len(shape.rings[0]) > 1]
        holes = [shape for shape in polygons if shape.kind == "hole"]
        outlines = [shape for shape in polygons if shape.kind != "hole"]
        chosen = _chosen(outlines, wanted, Path(path).name)
        scale = _Scale(chosen.rings[0], metres_per_unit, notes)
        polygon = _mended(chosen, holes, scale, notes)
        points = [shape for shape in shapes if len(shape.rings[0]) == 1]
        found = _points(points, polygon, scale, len(outlines) > 1, notes)
        rng = np.random.default_rng(seed)
        placed = {"roi": (rois, layout.ROIS_APART), "start": (robots, layout.STARTS_APART)}
        for kind, (count, apart) in placed.items():
            if not found[kind]:
                taken = found["roi"] + found["start"]
                found[kind] = _placed(polygon, count, apart / layout.MILLI, taken, rng)
                notes.append(f"{kind}: none in the map: {count} placed at random")
        rings = [polygon.exterior, *polygon.interiors]
        outline, *inner = [shapely.get_coordinates(ring)[:-1] for ring in rings]
        sides = zip(DEFAULT_ARENA, polygon.bounds[2:], strict=True)
        arena = [max(side, 10.0 * math.ceil(most / 10.0)) for side, most in sides]
        name = name_from(chosen.name or Path(path).stem)
        field = Field(outline, found["roi"], found["start"], inner, arena=arena, name=name)
    except FieldError as error:
        raise FieldError(path, error.problems) from None
    return field, notes


def _error(problem: str) -> FieldError:
    return FieldError("map", [problem])


# -- reading ---------------------------------------------------------------------------------------


def _read(data: bytes, notes: list[str]) -> list[_Shape]:
    """Return the polygons and points of GeoJSON or WKT text."""
    if len(data) > MAX_MAP_BYTES:
        raise _error(f"file: larger than {MAX_MAP_BYTES} bytes")
    try:
        text = data.decode("utf-8-sig").strip()
        document = json.loads(text) if text[:1] == "{" else mapping(_geometry_of(text, notes))
        return [*_shapes(document, "", {})]
    except FieldError:
        raise
    except (ValueError, RecursionError, shapely.GEOSException) as error:
        raise _error(f"file: neither GeoJSON nor WKT: {str(error)[:200]}") from None


def _geometry_of(text: str, notes: list[str]) -> shapely.Geometry:
    """Return the geometries of WKT text as one, with its rings closed."""

    def close(ring: re.Match[str]) -> str:
        points = ring[1].split(",")
        if len(points) < 3 or points[0].split() == points[-1].split():
            return ring[0]
        notes.append("a ring was not closed: closed")
        return f"({ring[1]},{points[0]})"

    text = re.sub(r"SRID=\d+;", "", text, flags=re.IGNORECASE)
    if "POLYGON" in text.upper() and "MULTIPOINT" not in text.upper():
        text = re.sub(r"\(([^()]+)\)", close, text)
    kinds = r"\)[\s;]*(?=(?:MULTI)?(?:POLYGON|POINT)\b)"  # geometries that follow each other
    several = re.sub(kinds, "),", text, flags=re.IGNORECASE)
    return shapely.from_wkt(f"GEOMETRYCOLLECTION({several.rstrip(';')})")


def _shapes(node: Any, place: str, properties: dict[str, Any]) -> Iterator[_Shape]:
    """Walk through GeoJSON; all places of ``node`` begin with ``place``."""
    if not isinstance(node, dict):
        raise _error(f"{place or 'file'}: expected a GeoJSON object, got {type(node).__name__}")
    dot = f"{place}." if place else ""
    kind, at = node.get("type"), place or "file"
    match kind:
        case "FeatureCollection" | "GeometryCollection":
            key = "features" if kind == "FeatureCollection" else "geometries"
            members = node.get(key)
            if not isinstance(members, list | tuple):
                raise _error(f"{dot}{key}: expected a list")
            for k, member in enumerate(members):
                yield from _shapes(member, f"{dot}{key}[{k}]", properties)
        case "Feature":
            given = node.get("properties") or {}
            if not isinstance(given, dict):
                raise _error(f"{at}: properties: expected names and values")
            known = {str(key).lower(): value for key, value in given.items()}
            known = {"name": node.get("id"), **known}
            if node.get("geometry") is not None:
                yield from _shapes(node["geometry"], place, known)
        case "Polygon" | "MultiPolygon" | "Point" | "MultiPoint":
            yield from _parts(str(kind), node.get("coordinates"), at, properties)
        case _:
            allowed = "Polygon, MultiPolygon, Point, MultiPoint, or a collection of such"
            raise _error(f"{at}: type: {kind!r}; allowed: {allowed}")


def _parts(kind: str, entries: Any, place: str, properties: dict[str, Any]) -> Iterator[_Shape]:
    """Return the polygons or points of one geometry."""
    parts = entries if kind.startswith("Multi") else [entries]
    name = "" if properties.get("name") is None else str(properties["name"])
    role = str(properties.get("kind") or "").lower()
    for part in parts if isinstance(parts, list | tuple) else [None]:
        rings = [[part]] if kind.endswith("Point") else part
        if not isinstance(rings, list | tuple) or not rings:
            raise _error(f"{place}: coordinates: expected those of a {kind}")
        yield _Shape(place, name, role, [_numbers(ring, place) for ring in rings])


def _numbers(ring: Any, place: str) -> _Points:
    """Return the points of a ring, (k, 2); a height is dropped."""
    points: list[Any] = [*ring] if isinstance(ring, list | tuple) else [None]
    for k, point in enumerate(points):
        numbers = point[:2] if isinstance(point, list | tuple) else ()
        right = [type(x) in (int, float) and abs(x) < 1e9 for x in numbers]  # not NaN either
        if right != [True, True]:
            shown = str(point)[:60]
            raise _error(f"{place}: point {k}: {shown}; allowed: two finite numbers below 1e9")
    return np.array([point[:2] for point in points], np.float64).reshape(-1, 2)


def _chosen(polygons: Sequence[_Shape], wanted: str | None, file: str) -> _Shape:
    """Return the polygon with a name or a number from 1 on; there is one if none is wanted."""
    if not polygons:
        raise _error("file: no polygon for the field's outline")
    picks = [shape for shape in polygons if shape.name == wanted]
    if wanted is None:
        picks = [*polygons]
    elif not picks and wanted.isdecimal() and 1 <= int(wanted) <= len(polygons):
        picks = [polygons[int(wanted) - 1]]
    if len(picks) != 1:
        names = [
            f"{k}" + f" ({shape.name})" * bool(shape.name) for k, shape in enumerate(polygons, 1)
        ]
        shown = ", ".join(names[:20]) + f" .. {len(names)}" * (len(names) > 20)
        problem = f"{len(picks)} polygons" + ("" if wanted is None else f" named {wanted!r}")
        raise _error(f"file: {problem}; pick one as {file}#NUMBER or #NAME: {shown}")
    return picks[0]


# -- units -----------------------------------------------------------------------------------------


class _Scale:
    """From a map's coordinates to units, with the outline's south-west corner at (0, 0)."""

    def __init__(self, outline: _Points, metres_per_unit: float, notes: list[str]) -> None:
        self._unit, self._first = metres_per_unit, outline[0, 0]
        self._degrees = False
        low, high = self._unwrapped(outline).min(0), self._unwrapped(outline).max(0)
        inside = np.abs(outline).max(0) <= (180.0, 90.0)
        self._degrees = bool(inside.all() and (high - low).max() < MOST_DEGREES)
        self._origin = np.zeros(2)
        self._middle = (low[1] + high[1]) / 2.0
        metres = self._metres(outline)
        self._origin, sides = metres.min(0), metres.max(0) - metres.min(0)
        corner = low if self._degrees else self._origin
        across = f"{sides[0]:,.1f} x {sides[1]:,.1f} m"
        kind = "degrees (longitude, latitude)" if self._degrees else "metres"
        notes.append(f"coordinates: {kind}; the field is {across}, a unit is {metres_per_unit:g} m")
        notes.append(f"origin: (0, 0) is ({corner[0]:.10g}, {corner[1]:.10g}) of the map")
        units = sides / metres_per_unit
        if units.max() < 2.0 * ROI_RADIUS or units.max() > MAX_COORDINATE:
            wrong = "smaller than an ROI" if units.max() < 2.0 * ROI_RADIUS else "too large"
            allowed = f"{2.0 * ROI_RADIUS:g} to {MAX_COORDINATE:g} units; see metres_per_unit"
            raise _error(f"outline: {across} in {kind}, {wrong}; allowed: {allowed}")

    def __call__(self, points: _Points) -> _Points:
        """Return points in units, to 1/1000 unit."""
        rounded: _Points = np.round((self._metres(points) - self._origin) / self._unit, 3)
        return rounded

    def _unwrapped(self, points: _Points) -> _Points:
        """Return degrees without the step from 180 to -180."""
        x = self._first + (points[:, 0] - self._first + 180.0) % 360.0 - 180.0
        return np.stack([x, points[:, 1]], axis=1)

    def _metres(self, points: _Points) -> _Points:
        if not self._degrees:
            return points
        # The ellipsoid's radii of curvature in the middle of the field, along and across.
        latitude = math.radians(self._middle)
        bent = 1.0 - ECCENTRICITY_SQUARED * math.sin(latitude) ** 2
        east = RADIUS / math.sqrt(bent) * math.cos(latitude)
        north = RADIUS * (1.0 - ECCENTRICITY_SQUARED) / bent**1.5
        from_first = self._unwrapped(points) - (self._first, self._middle)
        metres: _Points = np.radians(from_first) * (east, north)
        return metres


# -- mending ---------------------------------------------------------------------------------------


def _mended(
    chosen: _Shape, holes: Sequence[_Shape], scale: _Scale, notes: list[str]
) -> shapely.Polygon:
    """Return the polygon in units, without what a field may not have."""
    outline = _polygon(chosen, scale, notes)
    for hole in holes:
        outline = _one(outline.difference(_polygon(hole, scale, notes)), hole.place)
    corners, tolerance = len(shapely.get_coordinates(outline)), NEAR
    while len(shapely.get_coordinates(outline)) - 1 - len(outline.interiors) > MAX_VERTICES:
        tolerance *= 2.0
        if tolerance > ROI_RADIUS:
            raise _error(f"{chosen.place}: {corners} corners; allowed: at most {MAX_VERTICES}")
        outline = _one(outline.simplify(tolerance), chosen.place)
    if tolerance > NEAR:
        left = len(shapely.get_coordinates(outline))
        notes.append(f"{corners} corners simplified to {left}, within {tolerance:g} units")
    return outline


def _polygon(shape: _Shape, scale: _Scale, notes: list[str]) -> shapely.Polygon:
    """Return one polygon of a map in units."""
    rings = []
    for k, ring in enumerate(shape.rings):
        place = f"{shape.place}: {'hole ' + str(k) if k else 'outline'}"
        closed = len(ring) > 1 and bool((ring[0] == ring[-1]).all())
        points = scale(ring[: len(ring) - closed])
        distinct = _distinct(points)
        if len(distinct) > 1 and math.dist(distinct[0], distinct[-1]) < NEAR:
            distinct.pop()
        if not closed:
            notes.append(f"{place}: not closed: closed")
        if len(distinct) < len(points):
            notes.append(f"{place}: {len(points) - len(distinct)} repeated corners left out")
        if len(distinct) < 3 or shapely.make_valid(shapely.Polygon(distinct)).area == 0.0:
            if k == 0:
                raise _error(f"{place}: has no area")
            notes.append(f"{place}: has no area: left out")
            continue
        if shapely.is_ccw(shapely.LinearRing(distinct)) == bool(k):
            notes.append(f"{place}: turned round")
            distinct.reverse()
        rings.append(distinct)
    polygon = shapely.Polygon(rings[0], rings[1:])
    if not polygon.is_valid:
        notes.append(f"{shape.place}: {shapely.is_valid_reason(polygon)}: mended")
    return _one(shapely.make_valid(polygon), shape.place)


def _one(geometry: shapely.Geometry, place: str) -> shapely.Polygon:
    """Return the one polygon of which a geometry consists, but for lines and crumbs."""
    parts = shapely.get_parts(shapely.get_parts(geometry))  # of collections of collections
    parts = [part for part in parts if part.area > NEAR]
    if len(parts) != 1:
        raise _error(f"{place}: in {len(parts)} pieces, touching or apart; allowed: one")
    polygon: shapely.Polygon = parts[0]
    return polygon


def _distinct(points: _Points) -> list[tuple[float, float]]:
    """Return the points without those that are near the one before."""
    kept: list[tuple[float, float]] = []
    for x, y in points.tolist():
        if not kept or math.dist(kept[-1], (x, y)) >= NEAR:
            kept.append((x, y))
    return kept


# -- ROIs and starts -------------------------------------------------------------------------------


def _points(
    shapes: Sequence[_Shape],
    polygon: shapely.Polygon,
    scale: _Scale,
    several: bool,
    notes: list[str],
) -> dict[str, list[tuple[float, float]]]:
    """Return the map's ROIs and starts in units; a point without a kind is an ROI."""
    found: dict[str, list[tuple[float, float]]] = {"roi": [], "start": []}
    problems: list[str] = []
    for shape in shapes:
        kind = shape.kind or "roi"
        place = f"{shape.place}: {kind}"
        if kind not in found:
            notes.append(f"{place}: left out; kinds of points: {', '.join(found)}")
            continue
        point = shapely.Point(scale(shape.rings[0])[0])
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
    polygon: shapely.Polygon,
    count: int,
    apart: float,
    taken: list[tuple[float, float]],
    rng: np.random.Generator,
) -> list[tuple[float, float]]:
    """Return random points, each the one of several candidates that is farthest from all others."""
    room = polygon.buffer(-layout.WALL / layout.MILLI)
    low, high = np.reshape(polygon.bounds, (2, 2))
    placed: list[tuple[float, float]] = []
    for _ in range(count):
        points = np.round(rng.uniform(low, high, (CANDIDATES, 2)), 3)
        points = points[shapely.covers(room, shapely.points(points))]
        others = np.array([*taken, *placed]).reshape(-1, 2)
        gaps = np.linalg.norm(points[:, None] - others, axis=2).min(1, initial=math.inf)
        if len(points) == 0 or gaps.max() < apart:
            raise _error(
                f"outline: no room for {count} points {apart:g} units apart and from walls"
            )
        x, y = points[gaps.argmax()].tolist()
        placed.append((x, y))
    return placed
