"""Shortest paths around corners, for the assignment (observations.md, "Entities")."""

# A field's waypoints lie off the corners at which it is not convex. The lengths of the shortest
# ways between them and the ROIs are made when the field is put into a world; a robot adds the first
# leg. A field without waypoints needs none of that: everything is in straight sight.
#
# Source: this package.

import math
from typing import Any, NamedTuple

import numpy as np

from mbn_marl.engine.mdp.events import in_field
from mbn_marl.field.generator.layout import Tables
from mbn_marl.jit.compile import compiled, entry_point
from mbn_marl.jit.functions import count_bits

# The distance of waypoints from their corners, units.
CLEARANCE = np.float32(3.0)
# The sine of the turn up to which a corner counts as straight.
BLUNT = np.float32(1e-3)
# Ways whose lengths differ by no more are equally long, units.
CLOSE = np.float32(1e-3)
# The weight of a leg's shorter side.
SHORTER = np.float32(1 / 8)
NEVER = np.float32(np.inf)
# The rows of ``ways_in``.
EDGES, WAYPOINTS = range(2)


class Paths(NamedTuple):
    waypoints: Any  # (2, C, F) real, units; C is 0 if nothing is assigned
    legs: Any  # (m + C, m + C, F) real: from each ROI, then each waypoint, to each; units
    ways_in: Any  # (2, F) int32: how many edges and waypoints are there, the first ones


@compiled
def path_length(dx, dy):
    # Forces and speed limits are per axis, so the longer side takes the time. The shorter one tells
    # ways apart that take the same.
    dx, dy = abs(dx), abs(dy)
    return max(dx, dy) + SHORTER * min(dx, dy)


@compiled
def side(ax, ay, bx, by, x, y):
    return (bx - ax) * (y - ay) - (by - ay) * (x - ax)


@compiled
def in_sight(edges, count, f, px, py, qx, qy):
    """Return whether none of the first ``count`` edges comes between two points of a field."""
    # Points may lie on edges; a line that touches a corner may count as crossing it.
    for e in range(count):
        ax, ay, bx, by = edges[0, e, f], edges[1, e, f], edges[2, e, f], edges[3, e, f]
        p, q = side(ax, ay, bx, by, px, py), side(ax, ay, bx, by, qx, qy)
        apart = ((p < 0) & (q > 0)) | ((p > 0) & (q < 0))
        if apart and (side(px, py, qx, qy, ax, ay) > 0) != (side(px, py, qx, qy, bx, by) > 0):
            return False
    return True


@compiled
def count_edges(edges, f):
    count = edges.shape[1]
    while count > 0:
        last = count - 1
        if (edges[0, last, f] != edges[2, last, f]) | (edges[1, last, f] != edges[3, last, f]):
            break
        count = last
    return count


@compiled
def unit(edges, e, f):
    x, y = edges[2, e, f] - edges[0, e, f], edges[3, e, f] - edges[1, e, f]
    size = math.sqrt(x * x + y * y)
    return x / size, y / size


@compiled
def place_waypoint(field, paths, f, before, e, count):
    """Place a waypoint off the corner where two edges meet, unless the field is convex there."""
    # The field is to the left of the edges, so it is not convex where they turn right. There are
    # ``count`` waypoints; return how many there are then.
    edges, waypoints = field.edges, paths.waypoints
    (ux, uy), (vx, vy) = unit(edges, before, f), unit(edges, e, f)
    if (ux * vy - uy * vx < -BLUNT) & (count < waypoints.shape[1]):
        dx, dy = (ux - vx) - (uy + vy), (uy - vy) + (ux + vx)  # the bisector, never 0
        scale = CLEARANCE / math.sqrt(dx * dx + dy * dy)
        x, y = edges[0, e, f] + scale * dx, edges[1, e, f] + scale * dy
        if in_field(field, f, x, y):
            waypoints[0, count, f], waypoints[1, count, f] = x, y
            return count + 1
    return count


@compiled
def place_waypoints(field, paths, f, count):
    edges, first, last, placed = field.edges, 0, 0, 0
    for e in range(count):
        if e == first:  # of a ring
            last = e
            while last + 1 < count and not (
                (edges[2, last, f] == edges[0, first, f])
                & (edges[3, last, f] == edges[1, first, f])
            ):
                last += 1
        before = last if e == first else e - 1
        placed = place_waypoint(field, paths, f, before, e, placed)
        if e == last:
            first = e + 1
    return placed


@compiled
def place_of(field, paths, node, f):
    m = field.rois.shape[1]
    if node < m:
        return field.rois[0, node, f], field.rois[1, node, f]
    return paths.waypoints[0, node - m, f], paths.waypoints[1, node - m, f]


@compiled
def measure_legs(field, paths, f, own, count, placed):
    # ``own`` is how many ROIs the field has, of ``count`` edges and ``placed`` waypoints.
    m, legs = field.rois.shape[1], paths.legs
    for a in range(m + placed):
        for b in range(a, m + placed):
            ax, ay = place_of(field, paths, a, f)
            bx, by = place_of(field, paths, b, f)
            legs[a, b, f] = legs[b, a, f] = NEVER
            known = ((a < own) | (a >= m)) & ((b < own) | (b >= m))
            if known and in_sight(field.edges, count, f, ax, ay, bx, by):
                legs[a, b, f] = legs[b, a, f] = path_length(bx - ax, by - ay)
    for c in range(m, m + placed):
        for a in range(m + placed):
            first = legs[a, c, f]
            if first < NEVER:
                for b in range(m + placed):
                    legs[a, b, f] = min(legs[a, b, f], first + legs[c, b, f])


@compiled
def find_paths(field, paths, f):
    if paths.waypoints.shape[1] > 0:
        count, own = count_edges(field.edges, f), count_bits(field.codes[f])
        placed = place_waypoints(field, paths, f, count)
        paths.ways_in[EDGES, f], paths.ways_in[WAYPOINTS, f] = count, placed
        if placed > 0:
            measure_legs(field, paths, f, own, count, placed)


@entry_point
def find_all(field, paths):
    for f in range(field.codes.shape[0]):
        find_paths(field, paths, np.uint64(f))


def no_paths(waypoints: int, m: int, count: int, real: Any) -> Paths:
    nodes = m + waypoints if waypoints else 0
    return Paths(
        waypoints=np.zeros((2, waypoints, count), real),
        legs=np.zeros((nodes, nodes, count), real),
        ways_in=np.zeros((2, count), np.int32),
    )


def make_paths(field: Tables) -> Paths:
    m = field.rois.shape[1]
    paths = no_paths(field.edges.shape[1], m, len(field.codes), field.edges.dtype)
    find_all(field, paths)
    most = int(paths.ways_in[WAYPOINTS].max(initial=0))
    nodes = m + most if most else 0
    waypoints, legs = paths.waypoints[:, :most], paths.legs[:nodes, :nodes]
    # Arrays with gaps would be other types to compile for.
    return Paths(np.ascontiguousarray(waypoints), np.ascontiguousarray(legs), paths.ways_in)
