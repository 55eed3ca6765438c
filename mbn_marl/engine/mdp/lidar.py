"""The senses of ``lidar``: the walls, and the nearness and direction of robots and ROIs."""

# An edge goes from a to b, and the field lies to its left; its ends are given as seen from the
# robot. Only operations that every processor rounds alike are used.
#
# Source: this package; the paper's robots sense no walls (observations.md).

import math

import numpy as np
from numpy.typing import NDArray

from mbn_marl.engine.mdp.drawn_numbers import limits_in, limits_of, numbers_of
from mbn_marl.engine.mdp.dynamics import has_heading, part_along
from mbn_marl.engine.mdp.events import cross_edge
from mbn_marl.engine.mdp.sight import Row, roi_place
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.features import Feature
from mbn_marl.jit.functions import HALF, MANY, clip, column, select

FAR = np.float32(np.inf)
# Of a position, in arenas: a little more than float32's.
ROUNDING = np.float32(1e-6)
S = math.sqrt(0.5)
# The directions of the rays, (2, 8): unit vectors, counter-clockwise from +x.
RAYS = np.array([[1, S, 0, -S, -1, -S, 0, S], [0, S, 1, S, 0, -S, -1, -S]])


def rays_of(radius: float, arena: tuple[float, float]) -> NDArray[np.float64]:
    """The rays (2, 8), units: as long as the sensing radius, or the arena's diagonal if shorter."""
    return RAYS * min(radius, math.hypot(*arena))


def wall_rows() -> list[Row]:
    rows = [(f"ray_{k}", 0.0, 1.0, "sensing radii") for k in range(RAYS.shape[1])]
    rows += [("time_to_wall", 0.0, 1.0, "sensing radii at the speed limit")]
    return [*rows, ("brake_inside", 0.0, 1.0, "flag"), ("wall_distance", 0.0, 1.0, "sensing radii")]


has_rays = Feature(lambda g: g.team.rays.ndim == 2)


@compiled
def cross(ax, ay, bx, by):
    return ax * by - ay * bx


@compiled
def slack(p, g):
    """By how much, in sensing radii, rounding may have put a robot beyond a wall."""
    return max(p.arena_x, p.arena_y) * ROUNDING / g.team.rays[0, 0]


@compiled
def reading(p, behind, a_side, b_side, turn, along):
    """The place on a ray, 0 to 1, where it leaves the field by an edge; 1 if it does not."""
    # ``a_side``, ``b_side`` and ``turn`` are the ray's direction crossed with the edge's ends and
    # with the edge; ``along`` is where the ray meets the line of the edge. A ray through a corner
    # leaves by both of its edges, so none slips between them; one along an edge leaves by the next.
    # A robot that rounding has put beyond the edge, by less than ``behind``, is at it.
    leaves = (a_side <= 0) & (b_side >= 0) & (turn > 0) & (along >= -behind)
    return select(leaves, max(along, p.zero), p.one)


@compiled
def distance_squared(p, ax, ay, ex, ey):
    square = ex * ex + ey * ey
    per_square = select(square > 0, p.one / square, p.zero)
    along = clip(-(ax * ex + ay * ey) * per_square, p.zero, p.one)
    x, y = ax + along * ex, ay + along * ey
    return x * x + y * y


@compiled
def braking_path(p, tau, velocity, brake, wind, beyond):
    """The way of a robot until the force that brakes it by ``brake`` a step has stopped it."""
    # One axis; ``beyond``, and on, if the wind is stronger. The speed falls by the same amount each
    # step, and in the last one to 0: the path is the mean of the first and the last speed that is
    # left, times their number.
    speed = abs(velocity)
    slower = brake - select(velocity > 0, wind, -wind)
    ratio = speed / slower
    count = np.float32(np.int32(select(ratio < MANY, ratio, MANY)))  # also where it is no number
    path = count * ((speed - slower) + (speed - slower * count)) * HALF * tau
    path = select(slower > 0, path, select(speed > 0, beyond, p.zero))
    return select(velocity > 0, path, -path)


@compiled
def put_near(p, g, view, lo, hi, j, k):
    robots, i = view.robots, view.i
    per_radius = p.one / g.team.rays[0, 0]
    for w in range(lo, hi):
        dx, dy = robots.x[j, w] - robots.x[i, w], robots.y[j, w] - robots.y[i, w]
        distance = math.sqrt(dx * dx + dy * dy)
        view.tile[k, w - lo] = max(p.one - distance * per_radius, p.zero)


@compiled
def put_direction(p, g, view, lo, hi, j, k):
    robots, tile, i = view.robots, view.tile, view.i
    for w in range(lo, hi):
        f = column(g.field, w)
        dx = roi_place(g, view, 0, j, f, w) - robots.x[i, w]
        dy = roi_place(g, view, 1, j, f, w) - robots.y[i, w]
        length = math.sqrt(dx * dx + dy * dy) + p.one
        tile[k + 2, w - lo] = tile[k, w - lo]
        tile[k, w - lo] = dx / length
        tile[k + 1, w - lo] = dy / length


@compiled
def edge_from(g, view, e, w):
    edges, f = g.field.edges, column(g.field, w)
    x, y = view.ep.x[view.i, w], view.ep.y[view.i, w]
    ax, ay, bx, by = edges[0, e, f], edges[1, e, f], edges[2, e, f], edges[3, e, f]
    return ax - x, ay - y, bx - x, by - y, bx - ax, by - ay


@compiled
def put_rays(p, g, view, lo, hi, k):
    rays, tile = g.team.rays, view.tile
    half, behind = rays.shape[1] // 2, slack(p, g)
    for ray in range(half):
        # The other half of the directions is this one turned back: one pass does for both.
        row, back, dx, dy = k + ray, k + ray + half, rays[0, ray], rays[1, ray]
        for w in range(lo, hi):
            tile[row, w - lo] = p.one
            tile[back, w - lo] = p.one
        for e in range(g.field.edges.shape[1]):
            for w in range(lo, hi):
                ax, ay, bx, by, ex, ey = edge_from(g, view, e, w)
                turn = cross(dx, dy, ex, ey)
                a_side, b_side = cross(dx, dy, ax, ay), cross(dx, dy, bx, by)
                along = cross(ax, ay, ex, ey) * (p.one / turn)
                there = reading(p, behind, a_side, b_side, turn, along)
                opposite = reading(p, behind, -a_side, -b_side, -turn, -along)
                tile[row, w - lo] = min(tile[row, w - lo], there)
                tile[back, w - lo] = min(tile[back, w - lo], opposite)


@compiled
def put_margins(p, g, view, lo, hi, k):
    """The time until the observer reaches the wall, and, two entries on, its least distance."""
    ep, tile, i = view.ep, view.tile, view.i
    per_radius, behind = p.one / g.team.rays[0, 0], slack(p, g)
    per_time = p.top_speed * per_radius
    for w in range(lo, hi):
        tile[k, w - lo] = p.one
        tile[k + 2, w - lo] = FAR
    for e in range(g.field.edges.shape[1]):
        for w in range(lo, hi):
            ax, ay, bx, by, ex, ey = edge_from(g, view, e, w)
            dx, dy = ep.vx[i, w], ep.vy[i, w]
            turn = cross(dx, dy, ex, ey)
            a_side, b_side = cross(dx, dy, ax, ay), cross(dx, dy, bx, by)
            along = cross(ax, ay, ex, ey) * (per_time / turn)
            time = reading(p, behind, a_side, b_side, turn, along)
            tile[k, w - lo] = min(tile[k, w - lo], time)
            tile[k + 2, w - lo] = min(tile[k + 2, w - lo], distance_squared(p, ax, ay, ex, ey))
    for w in range(lo, hi):
        distance = math.sqrt(tile[k + 2, w - lo]) * per_radius
        tile[k + 2, w - lo] = min(distance, p.one)


@compiled
def place_of_rest(p, g, view, q, brake, w):
    """The place at which the observer would stop if it braked from now on."""
    ep, i = view.ep, view.i
    x, y, vx, vy = ep.x[i, w], ep.y[i, w], ep.vx[i, w], ep.vy[i, w]
    if has_heading(g, i):
        cos, sin = ep.cos[i, w], ep.sin[i, w]
        wind, beyond = part_along(q.wind_x, q.wind_y, cos, sin), p.arena_x + p.arena_y
        path = braking_path(p, q.tau, part_along(vx, vy, cos, sin), brake, wind, beyond)
        return x + path * cos, y + path * sin
    x += braking_path(p, q.tau, vx, brake, q.wind_x, p.arena_x)
    y += braking_path(p, q.tau, vy, brake, q.wind_y, p.arena_y)
    return x, y


@compiled
def put_brake(p, g, view, lo, hi, k):
    """A flag: the observer would stop in the field if it braked from now on."""
    ep, edges, tile, i = view.ep, g.field.edges, view.tile, view.i
    limits = limits_of(g, i)
    for w in range(lo, hi):
        tile[k, w - lo] = p.zero
    # The entry holds the bits of ``cross_edge`` until the pass over all edges is done.
    for e in range(edges.shape[1]):
        for w in range(lo, hi):
            f = column(g.field, w)
            ax, ay, bx, by = edges[0, e, f], edges[1, e, f], edges[2, e, f], edges[3, e, f]
            mass, f_max, _ = limits_in(limits, ep, i, w)
            x, y = place_of_rest(p, g, view, numbers_of(p, ep, w), f_max / mass, w)
            tile[k, w - lo] = cross_edge(np.int32(tile[k, w - lo]), x, y, ax, ay, bx, by)
    for w in range(lo, hi):
        tile[k, w - lo] = min(tile[k, w - lo], p.one)


@compiled
def put_walls(p, g, view, lo, hi, k):
    put_rays(p, g, view, lo, hi, k)
    k += g.team.rays.shape[1]
    put_margins(p, g, view, lo, hi, k)
    put_brake(p, g, view, lo, hi, k + 1)
    return k + 3
