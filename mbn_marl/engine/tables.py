"""The tables of the worlds' fields: from ``Field`` to numbers, and back."""

from __future__ import annotations

from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from shapely import MultiPoint, points

from mbn_marl.config import LIMITS, NavigationConfig
from mbn_marl.engine.mdp.drawn_numbers import make_ranges
from mbn_marl.engine.mdp.dynamics import DYNAMICS, POINT_MASS
from mbn_marl.engine.mdp.entities import SCALES
from mbn_marl.engine.mdp.events import cross_edge
from mbn_marl.engine.mdp.kinds import has_kinds
from mbn_marl.engine.mdp.lidar import rays_of
from mbn_marl.engine.mdp.observations import WITH_RAYS
from mbn_marl.engine.mdp.paths import Paths, make_paths, no_paths
from mbn_marl.engine.state import Array, Geometry, Sampler, Team
from mbn_marl.field import Field, FieldSampler
from mbn_marl.field.generator.layout import Tables, make_tables, scratch_rows
from mbn_marl.field.generator.sampler import field_of

# Safety distances between starts: discs about them are polygons, and they are rounded.
MARGIN = 1.02
# Starts so near to a border, units, may be outside by rounding; where they move then, in reaches.
REACH = 2e-3
RADII = np.array([0.0, *4.0 ** np.arange(-20, 2)])
DIRECTIONS = np.stack([np.cos(np.arange(16) * np.pi / 8), np.sin(np.arange(16) * np.pi / 8)], 1)
# The fields of the worlds in turn, or what draws one for each episode.
FieldSource = tuple[Field, ...] | FieldSampler


class Sizes(NamedTuple):
    edges: int
    rois: int
    robots: int
    fewest_robots: int
    arena: tuple[float, float]
    kinds: bool


def sizes_of(source: FieldSource) -> Sizes:
    if isinstance(source, FieldSampler):
        fewest, most = source.robots
        return Sizes(source.most_edges, source.rois[1], most, fewest, source.arena, False)
    edges, rois, teams = (
        [len(getattr(field, name)) for field in source] or [1]
        for name in ("edges", "rois", "starts")
    )
    arena = source[0].arena if source else (1.0, 1.0)
    kinds = any(field.roi_kinds for field in source)
    return Sizes(max(edges), max(rois), max(teams), min(teams), arena, kinds)


def make_geometry(
    source: FieldSource,
    config: NavigationConfig,
    n: int,
    worlds: int,
    teams_vary: bool = False,
    given_starts: Array | None = None,
) -> Geometry:
    """Tables of one field for all worlds, or a field for each: world w has ``w % len(source)``."""
    # ROIs and edges are padded to the largest field. ``given_starts`` (n, 2) take the place of all
    # the fields' own. The tables of a sampler are empty until a world is reset.
    sampler = source if isinstance(source, FieldSampler) else None
    fields = () if isinstance(source, FieldSampler) else source
    sizes = sizes_of(source)
    tables = make_tables(sizes.edges, sizes.rois, n, len(fields) or worlds, sizes.kinds)
    for f, field in enumerate(fields):
        write_field(tables, f, field, starts_of(field, n, config, teams_vary, given_starts))
    tables = rounded(tables, np.dtype(config.dtype))
    paths = paths_of(tables, sampler, config)
    if len(fields) > 1:
        # A table for each world takes more memory than one for each field, but it is read as it
        # lies; looking fields up took a third of a step.
        own = np.arange(worlds) % len(fields)
        tables = Tables(*(np.take(table, own, axis=-1) for table in tables))
        paths = Paths(*(np.take(table, own, axis=-1) for table in paths))
    scratch = (scratch_rows(n, sizes.rois), worlds) if sampler else (0, 0)
    return Geometry(
        field=tables,
        paths=paths,
        team=make_team(config, n, sizes.arena),
        sampler=Sampler(
            numbers=sampler_numbers(sampler) if sampler else np.zeros((0, 0), np.int64),
            scratch=np.zeros(scratch, np.int64, order="F"),
            kept=np.zeros(worlds if sampler else 0, np.bool_),
        ),
    )


def make_team(config: NavigationConfig, n: int, arena: tuple[float, float]) -> Team:
    real, failures = np.dtype(config.dtype), config.failures
    kinds = np.array([DYNAMICS[name] for name in config.of_each("dynamics", n)], np.int32)
    fail_at = [failures.at.get(i, 0) for i in range(n)] if failures else []
    has_rays = config.observation in WITH_RAYS
    return Team(
        limits=np.array([config.at_most().of_each(name, n) for name in LIMITS], real),
        kinds=np.zeros((0, 0), np.int32) if (kinds == POINT_MASS).all() else kinds,
        fail_at=np.array(fail_at, np.int32),
        ranges=make_ranges(config, n),
        rays=(rays_of(config.sensing_radius, arena) if has_rays else np.zeros(0)).astype(real),
        scales=(SCALES if config.observation == "entities" else np.zeros((0, 0))).astype(real),
    )


def paths_of(tables: Tables, sampler: FieldSampler | None, config: NavigationConfig) -> Paths:
    count, m, real = len(tables.codes), tables.rois.shape[1], tables.edges.dtype
    if not config.assignment:
        return no_paths(0, m, count, real)._replace(ways_in=np.zeros((0, count), np.int32))
    if sampler is None:
        return make_paths(tables)
    return no_paths(sampler.most_bends, m, count, real)


def rounded(tables: Tables, real: np.dtype[Any]) -> Tables:
    return Tables(*(t.astype(real) if t.dtype == np.float64 else t for t in tables))


def sampler_numbers(sampler: FieldSampler) -> Array:
    return np.append(sampler.numbers(), np.int64(sampler.seed))


def starts_of(
    field: Field, n: int, config: NavigationConfig, teams_vary: bool, given: Array | None
) -> Array:
    # Teams that do not vary may be larger than that if they start at random. If that fails, the
    # others start at points of the field that are at least the safety distance from those before.
    # As many as ``field_problems`` allows have discs of that radius that leave some of the field.
    starts = inside(field, field.starts[:n] if given is None else given, config.dtype)
    if teams_vary or len(starts) == n:
        return starts
    distance = MARGIN * max(config.at_most().safety_distance, 1.0)
    free = field.polygon.difference(MultiPoint(starts).buffer(distance))
    while len(starts) < n:
        point = free.representative_point()
        starts = np.vstack([starts, (point.x, point.y)])
        free = free.difference(point.buffer(distance))
    return starts


def inside(field: Field, starts: Array, dtype: str) -> Array:
    # Rounding may put a start on the border outside, where a robot at rest would pay for a wall.
    # Then it is moved to one of the nearest points around it that are inside for the engine.
    starts = np.array(starts, np.float64)
    reach = max(REACH, 4.0 * np.spacing(field.vertices.max().astype(dtype)))
    near = np.flatnonzero(field.polygon.boundary.distance(points(starts)) <= reach)
    edges = directed_edges(field).astype(dtype).T if near.size else starts[:0]
    for i in near:
        around = np.multiply.outer(reach * RADII, DIRECTIONS).reshape(-1, 2)
        tried = (starts[i] + around).astype(dtype)
        starts[i] = next((point for point in tried if _has(edges, *point)), starts[i])
    return starts


def _has(edges: Array, x: Any, y: Any) -> bool:
    crossings = 0
    for edge in edges:
        crossings = cross_edge.py_func(crossings, x, y, *edge)
    return crossings != 0


def write_field(t: Tables, f: int, field: Field, starts: Array) -> None:
    m, own = t.rois.shape[1], len(field.rois)
    t.edges[:, :, f] = np.tile(field.vertices[0], 2)[:, None]
    t.edges[:, : len(field.edges), f] = directed_edges(field)
    t.rois[:, :, f] = field.rois[0][:, None]
    t.rois[:, :own, f] = field.rois.T
    t.starts[:, :, f] = starts[0][:, None]
    t.starts[:, : len(starts), f] = starts.T
    t.roi_bits[:, f] = [1 << (own - 1 - j) if j < own else 1 << j for j in range(m)]
    t.codes[f] = (1 << own) - 1
    t.boxes[:2, f] = field.vertices.min(axis=0)
    t.boxes[2:, f] = np.ptp(field.vertices, axis=0)
    t.robots_in[f] = len(starts)
    if len(t.mine):
        mine = field.mine[: len(t.mine)] @ t.roi_bits[:own, f]
        t.mine[:, f], t.mine[: len(mine), f] = t.codes[f], mine


def column_of(
    field: Field, g: Geometry, config: NavigationConfig, teams_vary: bool, starts: Array | None
) -> tuple[Tables, Paths]:
    """The tables of a field, with one column; as large as those of ``g``, or larger."""
    (_, most_edges, _), n = g.field.edges.shape, g.field.starts.shape[1]
    sizes = max(len(field.edges), most_edges), g.field.rois.shape[1], n
    tables = make_tables(*sizes, 1, has_kinds(g))
    write_field(tables, 0, field, starts_of(field, n, config, teams_vary, starts))
    tables = rounded(tables, np.dtype(config.dtype))
    return tables, paths_of(tables, None, config)


def with_room(g: Geometry, edges: int, waypoints: int, xp: ModuleType) -> Geometry:
    """The tables with room for so many edges and waypoints in all columns, if there is less."""
    # ``xp`` is numpy or torch. New edges are a vertex of each field.
    field, paths = g.field, g.paths
    if (missing := edges - field.edges.shape[1]) > 0:
        vertex = xp.concatenate([field.edges[:2, :1], field.edges[:2, :1]])
        g = g._replace(
            field=field._replace(edges=xp.concatenate([field.edges, *[vertex] * missing], axis=1))
        )
    if (missing := waypoints - paths.waypoints.shape[1]) > 0:
        nodes, known = field.rois.shape[1] + waypoints, len(paths.legs)
        empty = 0 * field.rois[:1, :1]
        legs = xp.concatenate([xp.concatenate([empty] * nodes, axis=1)] * nodes)
        legs[:known, :known] = paths.legs
        none = xp.concatenate([empty, empty])
        corners = xp.concatenate([paths.waypoints, *[none] * missing], axis=1)
        g = g._replace(paths=paths._replace(waypoints=corners, legs=legs))
    return g


def read_field(tables: Tables, arena: tuple[float, float], name: str) -> Field:
    edges, rois, starts = (np.round(table.astype(np.float64), 3) for table in tables[:3])
    return field_of(tables._replace(edges=edges, rois=rois, starts=starts), arena, name)


def directed_edges(field: Field) -> Array:
    """The edges of a field (4, E), ring by ring, turned so that it lies to the left of each."""
    edges = []
    for number, ring in enumerate([field.polygon.exterior, *field.polygon.interiors]):
        corners = np.array(ring.coords[:-1])
        if ring.is_ccw == (number > 0):
            corners = np.roll(corners[::-1], 1, axis=0)  # the first stays the first
        edges.append(np.hstack([corners, np.roll(corners, -1, axis=0)]))
    return np.concatenate(edges).T
