"""The file format ``mbn-field/1`` (docs/fields.md): one model, and the check of all its rules."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from annotated_types import Len
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, ValidationError
from pydantic import Field as Described

from mbn_marl.config import MAX_ROBOTS, MAX_ROIS, NOT_A_WORD, NavigationConfig, describe
from mbn_marl.errors import FieldError

FORMAT = "mbn-field/1"
SAMPLER_FORMAT = "mbn-sampler/1"
"""Of files with the arguments of a :class:`~mbn_marl.field.FieldSampler`."""
SAFETY_DISTANCE: float = NavigationConfig.model_fields["safety_distance"].default
ROI_RADIUS: float = NavigationConfig.model_fields["roi_radius"].default
DEFAULT_ARENA = (1000.0, 1000.0)
MAX_COORDINATE = 1e6
"""The longest side of an arena, in units: beyond it float32 positions are 1/8 apart or more."""
MAX_VERTICES = 500  # corners of the outline and all holes together
MAX_HOLES = 64
MAX_NAME = 64
POINT_DEPTH = {"arena": 1, "holes": 3}
"""The places of points are so long; 2 in other lists."""
KINDS = "roi_kinds", "start_kinds"
ROUNDING = 1e-9
"""ROIs and starts may be so far outside, as a share of the outline's longer side."""


Place = tuple[int | str, ...]


def _plain(value: object) -> object:
    value = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(value, list | tuple):
        raise ValueError("Input should be a list")
    return value


_Positive = AfterValidator(lambda number: number + 0.0)  # not -0.0
_Coordinate = Annotated[float, Described(ge=0.0, le=MAX_COORDINATE), _Positive, NOT_A_WORD]
_Side = Annotated[float, Described(gt=0.0, le=MAX_COORDINATE), NOT_A_WORD]
_List = BeforeValidator(_plain)
_Point = Annotated[tuple[_Coordinate, _Coordinate], _List]
_Ring = Annotated[list[_Point], Len(3, MAX_VERTICES), _List]
_Kind = Annotated[int, Described(ge=0, lt=MAX_ROBOTS), NOT_A_WORD]


class FieldFile(BaseModel):
    """A field of mbn_marl in the format mbn-field/1. Lengths are in arena units."""

    model_config = ConfigDict(extra="forbid", frozen=True, title="mbn_marl field")

    format: Literal["mbn-field/1"] = Described(description="Name and version of the format.")
    name: str = Described(
        default="custom",
        pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$",  # it becomes a part of ids and paths
        max_length=MAX_NAME,
        description="The field's name; the file's stem when absent.",
    )
    optimal_makespan: Annotated[int, Described(ge=1, le=1_000_000), NOT_A_WORD] | None = Described(
        default=None,
        description="Proved least number of steps in which robots on all the starts visit "
        "every ROI without pushing outside the field, with the default dynamics and no wind.",
    )
    arena: Annotated[tuple[_Side, _Side], _List] = Described(
        default=DEFAULT_ARENA, description="Width and height of the arena, in units."
    )
    vertices: _Ring = Described(
        description="Corners of the outline in order, not repeated at the end."
    )
    holes: Annotated[list[_Ring], Len(0, MAX_HOLES), _List] = Described(
        default=[], description="Obstacles inside the outline that touch nothing."
    )
    rois: Annotated[list[_Point], Len(1, MAX_ROIS), _List] = Described(
        description="Regions of interest; the first is the visit code's most significant bit."
    )
    starts: Annotated[list[_Point], Len(1, MAX_ROBOTS), _List] = Described(
        description="Starts of the robots, at least the safety distance (10 by default) apart."
    )
    roi_kinds: Annotated[list[_Kind | None], Len(0, MAX_ROIS), _List] = Described(
        default=[], description="For each ROI the kind of the robots that it is for; null: all."
    )
    start_kinds: Annotated[list[_Kind], Len(0, MAX_ROBOTS), _List] = Described(
        default=[], description="For each start the kind of its robot, if there are kinds."
    )


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a field file, as in ``envs_catalog/field.schema.json``."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **FieldFile.model_json_schema(),
    }


def check(document: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return the values of a field.

    Raises:
        FieldError: listing all problems of structure, and of the geometry of what is readable.
    """
    problems: list[str] = []
    try:
        values = FieldFile.model_validate(document).model_dump()
    except ValidationError as error:
        problems = [_with_place(line) for line in describe(error, FieldFile)]
        bad = {one["loc"] for one in error.errors()}
        values = {key: _readable(value, bad, (key,)) for key, value in document.items()}
    problems += [*_geometry_problems(values), *_kind_problems(values)]
    if problems:
        raise FieldError(source, problems)
    return values


def _with_place(line: str) -> str:
    """Return a problem with ``holes[0][2].y`` in place of ``holes.0.2.1``."""
    name, *numbers = line.partition(":")[0].split(".")
    depth = POINT_DEPTH.get(name, 2) - 1
    if not all(map(str.isdecimal, numbers)) or not set(numbers[depth:]) <= {"0", "1"}:
        return line  # a name with dots
    axes = "".join(f".{'xy'[int(k)]}" for k in numbers[depth:])
    place = name + "".join(f"[{k}]" for k in numbers[:depth]) + axes
    return f"{place}:{line.partition(':')[2]}"


def _readable(value: Any, bad: set[Place], place: Place) -> Any:
    """Return points and lists of them, with ``None`` where pydantic found a problem."""
    value = value.tolist() if isinstance(value, np.ndarray) else value
    if place in bad or not isinstance(value, list | tuple):
        return None if place in bad else value
    parts = [_readable(part, bad, (*place, k)) for k, part in enumerate(value)]
    if len(place) < POINT_DEPTH.get(str(place[0]), 2):
        return parts
    return None if None in parts or len(parts) != 2 else tuple(map(float, parts))


def _geometry_problems(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is wrong with the geometry of all readable points."""
    arena = values.get("arena") or (math.inf, math.inf)
    rings = {"vertices": values.get("vertices") or []}
    rings |= {f"holes[{k}]": hole or [] for k, hole in enumerate(values.get("holes") or [])}
    corners = sum(map(len, rings.values()))
    if len(rings) > 1 and corners > MAX_VERTICES:
        yield f"holes: at most {MAX_VERTICES} corners with the outline's, not {corners}"
    points = {name: values.get(name) or [] for name in ("rois", "starts")}
    for label, entries in (rings | points).items():
        yield from _point_problems(label, entries, *arena)
    polygons = {label: _polygon(ring) for label, ring in rings.items()}
    for label, polygon in polygons.items():
        if polygon and not polygon.is_valid:
            yield f"{label}: {_crossing(label, rings[label])}"
    sound = {label: polygon for label, polygon in polygons.items() if polygon and polygon.is_valid}
    outline = sound.pop("vertices", None)
    yield from _hole_problems(outline, sound)
    for label, entries in points.items():
        for k, point in enumerate(entries):
            for problem in _outside(shapely.Point(point), outline, sound) if point else ():
                yield f"{label}[{k}]: {point} is {problem}"


def _kind_problems(values: Mapping[str, Any]) -> Iterator[str]:
    of_rois, of_starts = (values.get(name) for name in KINDS)  # None if they are not readable
    for name, kinds in (("roi", of_rois), ("start", of_starts)):
        points = values.get(f"{name}s")
        if kinds is None or points is None or not (of_rois or of_starts):
            continue
        if len(kinds) != len(points):
            yield f"{name}_kinds: {len(kinds)} of them; allowed: {len(points)}, as many as {name}s"
    for j, kind in enumerate(of_rois or []):
        if kind is not None and of_starts is not None and kind not in of_starts:
            yield f"roi_kinds[{j}]: {kind}; allowed: a kind of start_kinds, or None for all robots"


def _point_problems(label: str, points: list[Any], width: float, height: float) -> Iterator[str]:
    for k, point in enumerate(points):
        if point and (first := points.index(point)) < k:
            yield f"{label}[{k}]: {point} is a duplicate of {label}[{first}]"
        if point and (point[0] > width or point[1] > height):
            bounds = f"[0, {width:g}] x [0, {height:g}]"
            yield f"{label}[{k}]: {point} is outside the arena {bounds}"


def _polygon(ring: list[Any]) -> shapely.Polygon | None:
    """Return the polygon of a ring that is readable; points that are there twice count once."""
    distinct = [*dict.fromkeys(ring)]
    return None if None in ring or len(distinct) < 3 else shapely.Polygon(distinct)


def _hole_problems(
    outline: shapely.Polygon | None, holes: Mapping[str, shapely.Polygon]
) -> Iterator[str]:
    for label, hole in holes.items():
        if outline and not shapely.contains_properly(outline, hole):
            yield f"{label}: a hole must lie inside the field without touching its outline"
    for (label, hole), (other, later) in combinations(holes.items(), 2):
        if shapely.intersects(hole, later):
            yield f"{other}: touches or overlaps {label}"


def _outside(
    point: shapely.Point, outline: shapely.Polygon | None, holes: Mapping[str, shapely.Polygon]
) -> Iterator[str]:
    left, low, right, high = outline.bounds if outline else (0.0, 0.0, 0.0, 0.0)
    # In floating point a point on a slanted edge is seldom exactly on it.
    rounding = ROUNDING * max(right - left, high - low)
    if outline and outline.distance(point) > rounding:
        yield "outside the field"
    for label, hole in holes.items():
        if hole.contains(point) and hole.exterior.distance(point) > rounding:
            yield f"inside {label}"


def _crossing(label: str, ring: list[Any]) -> str:
    """Name the first two edges that meet in a ring that is not simple."""
    corners = [*dict.fromkeys(ring)]
    count, ends = len(corners), np.array(corners)
    edges = shapely.linestrings(np.stack([ends, np.roll(ends, -1, axis=0)], axis=1))
    pairs = shapely.STRtree(edges).query(edges, predicate="intersects").T.tolist()
    meeting = sorted((a, b) for a, b in pairs if 1 < b - a < count - 1)
    if not meeting:
        return "has no area"

    def edge(k: int) -> str:
        a, b = (ring.index(corners[end % count]) for end in (k, k + 1))
        return f"{label}[{a}]-{label}[{b}]"

    others = f", and {len(meeting) - 1} more such pairs" if len(meeting) > 1 else ""
    return "crosses or touches itself: {} meets {}".format(*map(edge, meeting[0])) + others
