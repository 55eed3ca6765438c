"""The observation ``entities``: a token for the robot itself, for each other robot and each ROI."""

# Lengths are made of units alone, so that a policy can act in fields and teams of any size. The
# first entry of another robot or an ROI says whether it is there to be seen; if not, all its
# entries are 0.
#
# Source: this package (observations.md, "Entities").

import math

import numpy as np

from mbn_marl.engine.mdp import lidar
from mbn_marl.engine.mdp.assignment import STRAIGHT, Tours, assigns, way_to
from mbn_marl.engine.mdp.drawn_numbers import numbers_of
from mbn_marl.engine.mdp.failures import WORKS, blank_gone, put_flag, status_of
from mbn_marl.engine.mdp.kinds import is_mine
from mbn_marl.engine.mdp.knowledge import hide_unnoticed, is_left, knows_own, notices
from mbn_marl.engine.mdp.sight import (
    Row,
    disturbs_sight,
    drop,
    flag_row,
    heading_rows,
    put_heading,
    put_own_motion,
    roi_place,
)
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.features import Feature
from mbn_marl.jit.functions import clip, column, select

# NEAR and FAR: the lengths that become 1/2, units.
SCALES = np.array([15.0, 100.0])
# The steps ahead for which the approach of another robot is foreseen.
STEPS_AHEAD = np.float32(15.0)


def entity_rows(n: int, m: int, turns: bool, flag: str, assigned: bool) -> list[Row]:
    # ``turns``: robots have headings; ``flag``: the name of the flag of robots that have failed, or
    # none; ``assigned``: ROIs are assigned.
    near, far = (f"soft, {scale:g} units" for scale in SCALES)
    rows = [(f"own_v{a}", -1.0, 1.0, "speed limits") for a in "xy"]
    rows += heading_rows("own", turns) + flag_row("own", flag) + lidar.wall_rows()
    rows += [(f"{who}_tour", 0.0, 1.0, far) for who in ("own", "team")] * assigned
    for k in range(1, n):
        one = f"other_{k}"
        rows += [(f"{one}_present", 0.0, 1.0, "flag"), *_offset_rows(one)]
        rows += [(f"{one}_dv{a}", -1.0, 1.0, "2 speed limits") for a in "xy"]
        rows += [(f"{one}_apart", 0.0, 1.0, near), (f"{one}_approach", 0.0, 1.0, near)]
        rows += heading_rows(one, turns) + flag_row(one, flag)
        rows += [(f"{one}_tour", 0.0, 1.0, far)] * assigned
    for j in range(m):
        one = f"roi_{j}"
        rows += [(f"{one}_left", 0.0, 1.0, "flag"), *_offset_rows(one)]
        rows += [(f"{one}_u{a}", -1.0, 1.0, "soft unit vector") for a in "xy"]
        rows += [(f"{one}_away", 0.0, 1.0, far), (f"{one}_others", 0.0, 1.0, far)]
        if assigned:
            rows += [(f"{one}_order", 0.0, 1.0, "1 / place in the robot's order")]
            rows += [(f"{one}_seen", 0.0, 1.0, "flag")]
    return rows


def _offset_rows(thing: str) -> list[Row]:
    scales = zip(("near", "far"), SCALES, strict=True)
    return [
        (f"{thing}_{name}_{a}", -1.0, 1.0, f"soft, {scale:g} units")
        for name, scale in scales
        for a in "xy"
    ]


shows_entities = Feature(lambda g: g.team.scales.ndim == 1)


@compiled
def soft(length, scale):
    """``d / (|d| + scale)``: 1/2 at the scale, below 1 everywhere."""
    return length / (abs(length) + scale)


@compiled
def norm(x, y):
    return math.sqrt(x * x + y * y)


@compiled
def closest(dx, dy, dvx, dvy, most):
    """The least distance, up to time ``most``, of a thing at an offset that keeps its velocity."""
    square = dvx * dvx + dvy * dvy
    time = clip(-(dx * dvx + dy * dvy) / square, most * 0, most)
    time = select(square > 0, time, most * 0)
    return norm(dx + time * dvx, dy + time * dvy)


@compiled
def put_offset(scales, dx, dy, tile, k, entry):
    tile[k, entry] = soft(dx, scales[0])
    tile[k + 1, entry] = soft(dy, scales[0])
    tile[k + 2, entry] = soft(dx, scales[1])
    tile[k + 3, entry] = soft(dy, scales[1])


@compiled
def put_direction(p, scales, dx, dy, tile, k, entry):
    put_offset(scales, dx, dy, tile, k, entry)
    distance = norm(dx, dy) + p.one
    tile[k + 4, entry] = dx / distance
    tile[k + 5, entry] = dy / distance


@compiled
def put_tours(p, g, view, lo, hi, k):
    plan, scale, tile = view.plan, g.team.scales[1], view.tile
    for w in range(lo, hi):
        tile[k, w - lo] = soft(plan[w, view.i], scale)
        tile[k + 1, w - lo] = p.zero
    for j in range(view.ep.x.shape[0]):
        for w in range(lo, hi):
            tile[k + 1, w - lo] = max(tile[k + 1, w - lo], soft(plan[w, j], scale))


@compiled
def put_robot(p, g, view, lo, hi, j, k):
    robots, scales, tile, i = view.robots, g.team.scales, view.tile, view.i
    for w in range(lo, hi):
        dx, dy = robots.x[j, w] - robots.x[i, w], robots.y[j, w] - robots.y[i, w]
        dvx, dvy = robots.vx[j, w] - robots.vx[i, w], robots.vy[j, w] - robots.vy[i, w]
        nearest = closest(dx, dy, dvx, dvy, STEPS_AHEAD * numbers_of(p, view.ep, w).tau)
        tile[k, w - lo] = p.one
        put_offset(scales, dx, dy, tile, k + 1, w - lo)
        tile[k + 5, w - lo] = dvx * p.per_speed_range
        tile[k + 6, w - lo] = dvy * p.per_speed_range
        tile[k + 7, w - lo] = soft(norm(dx, dy), scales[0])
        tile[k + 8, w - lo] = soft(nearest, scales[0])
    return k + 9 + put_heading(p, view, lo, hi, j, k + 9)


@compiled
def put_place(p, g, view, lo, hi, j, k):
    robots, scales, tile, i = view.robots, g.team.scales, view.tile, view.i
    for w in range(lo, hi):
        f = column(g.field, w)
        dx = roi_place(g, view, 0, j, f, w) - robots.x[i, w]
        dy = roi_place(g, view, 1, j, f, w) - robots.y[i, w]
        tile[k, w - lo] = p.one
        put_direction(p, scales, dx, dy, tile, k + 1, w - lo)
        tile[k + 7, w - lo] = soft(norm(dx, dy), scales[1])
        tile[k + 8, w - lo] = p.one
    for other in range(view.ep.x.shape[0]):
        if other != i:
            for w in range(lo, hi):
                f = column(g.field, w)
                dx = roi_place(g, view, 0, j, f, w) - robots.x[other, w]
                dy = roi_place(g, view, 1, j, f, w) - robots.y[other, w]
                counts = (status_of(view.ep, other, w) == WORKS) & is_mine(g, other, j, w)
                if disturbs_sight(view):
                    counts &= view.sensed[other, w] != 0
                if knows_own(view.ep):
                    counts &= notices(p, view, other, w)
                away = select(counts, soft(norm(dx, dy), scales[1]), p.one)
                tile[k + 8, w - lo] = min(tile[k + 8, w - lo], away)
    return k + 9


@compiled
def put_failed(g, view, lo, hi, j, k):
    if g.team.fail_at.shape[0] == 0:  # robots are only absent
        return 0
    return put_flag(view.ep, lo, hi, j, view.tile, k)


@compiled
def put_plan(p, g, view, lo, hi, j, k):
    """Write the assignment of ROI j, from entry k + 9 on, and a way around a corner to it."""
    robots, tile, i = view.robots, view.tile, view.i
    waypoints, scales = g.paths.waypoints, g.team.scales
    n, m = view.ep.x.shape[0], g.field.rois.shape[1]
    for w in range(lo, hi):
        tours = Tours(view.plan, n, m, w)
        way, first = way_to(tours, i, j)
        tile[k + 9, w - lo] = (
            view.plan[w, 2 * n + m + j] if view.plan[w, 2 * n + j] == i else p.zero
        )
        tile[k + 10, w - lo] = p.one if first == STRAIGHT else p.zero
        if first >= 0:
            f = column(g.field, w)
            dx = waypoints[0, first, f] - robots.x[i, w]
            dy = waypoints[1, first, f] - robots.y[i, w]
            put_direction(p, scales, dx, dy, tile, k + 1, w - lo)
            tile[k + 7, w - lo] = soft(way, scales[1])


@compiled
def blank_done(p, g, view, lo, hi, j, k, end):
    # An ROI for another kind is blank too: then a policy acts as it has learned without kinds.
    for w in range(lo, hi):
        left = is_left(p, g, view.ep, view.i, j, w) & is_mine(g, view.i, j, w)
        shown = p.one if left else p.zero
        for entry in range(k, end):
            view.tile[entry, w - lo] *= shown


@compiled
def put_entities(p, g, view, lo, hi):
    n, scale = view.ep.x.shape[0], g.team.scales[1]
    k = put_own_motion(p, view, lo, hi, 0)
    k += put_failed(g, view, lo, hi, view.i, k)
    k = lidar.put_walls(p, g, view, lo, hi, k)
    if assigns(view):
        put_tours(p, g, view, lo, hi, k)
        k += 2
    for j in range(n):
        if j != view.i:
            first = k
            k = put_robot(p, g, view, lo, hi, j, k)
            k += put_failed(g, view, lo, hi, j, k)
            if assigns(view):
                for w in range(lo, hi):
                    view.tile[k, w - lo] = soft(view.plan[w, j], scale)
                k += 1
            drop(view, lo, hi, j, first, k)
            if knows_own(view.ep):
                hide_unnoticed(p, view, lo, hi, j, first, k)
            blank_gone(p, view, lo, hi, j, first, k)
    for j in range(g.field.rois.shape[1]):
        first = k
        k = put_place(p, g, view, lo, hi, j, k)
        if assigns(view):
            put_plan(p, g, view, lo, hi, j, first)
            k += 2
        drop(view, lo, hi, n + j, first, k)
        blank_done(p, g, view, lo, hi, j, first, k)
    return k
