"""The senses of ``lidar``: the walls, and the nearness and direction of robots and ROIs.

An edge goes from a to b, and the field lies to its left; its ends are given as seen from the robot.
Only operations that every processor rounds alike are used.

Source: this package; the paper's robots sense no walls (mdp.md, "What a robot sees").
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mbn_marl.engine.mdp.containment import cross_edge
from mbn_marl.engine.mdp.drawn import limits_in, numbers_of
from mbn_marl.engine.mdp.dynamics import has_heading, limits_of, part_along
from mbn_marl.engine.mdp.entries import Row
from mbn_marl.engine.mdp.sight import spot
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.functions import HALF, MANY, clip, column, select

FAR = np.float32(np.inf)
ROUNDING = np.float32(1e-6)
"""Of a position, in arenas: a little more than float32's."""
S = math.sqrt(0.5)
RAYS = np.array([[1, S, 0, -S, -1, -S, 0, S], [0, S, 1, S, 0, -S, -1, -S]])
"""The directions of the rays, (2, 8): unit vectors, counter-clockwise from +x."""


def rays_of(radius: float, arena: tuple[float, float]) -> NDArray[np.float64]:
    """The rays (2, 8), units: as long as the sensing radius, or the arena's diagonal if shorter."""
    return RAYS * min(radius, math.hypot(*arena))


def wall_rows() -> list[Row]:
    """The entries about the walls."""
    rows = [(f"ray_{k}", 0.0, 1.0, "sensing radii") for k in range(RAYS.shape[1])]
    rows += [("time_to_wall", 0.0, 1.0, "sensing radii at the speed limit")]
    return [*rows, ("brake_inside", 0.0, 1.0, "flag"), ("wall_distance", 0.0, 1.0, "sensing radii")]


@compiled
def cross(ax, ay, bx, by):
    """The cross product of a and b: positive if b points to the left of a."""
    return ax * by - ay * bx


@compiled
def slack(p, rays):
    """By how much, in sensing radii, rounding may have put a robot beyond a wall."""
    return max(p.arena_x, p.arena_y) * ROUNDING / rays[0, 0]


@compiled
def reading(p, behind, a_side, b_side, turn, along):
    """Where a ray leaves the field by an edge, 0 at its start to 1 at its end; 1 elsewhere.

    ``a_side``, ``b_side`` and ``turn`` are the ray's direction crossed with the edge's ends and
    with the edge; ``along`` is where the ray meets the line of the edge. A ray through a corner
    leaves by both of its edges, so none slips between them; one along an edge leaves by the next.
    A robot that rounding has put beyond the edge, by less than ``behind``, is at it.
    """
    leaves = (a_side <= 0) & (b_side >= 0) & (turn > 0) & (along >= -behind)
    return select(leaves, max(along, p.zero), p.one)


@compiled
def distance_squared(p, ax, ay, ex, ey):
    """From the robot to the nearest point of the edge, squared; (ex, ey) is the edge b - a."""
    square = ex * ex + ey * ey
    per_square = select(square > 0, p.one / square, p.zero)
    along = clip(-(ax * ex + ay * ey) * per_square, p.zero, p.one)
    x, y = ax + along * ex, ay + along * ey
    return x * x + y * y


@compiled
def braking_path(p, tau, velocity, brake, wind, beyond):
    """How far a robot goes until the force that brakes it by ``brake`` a step has stopped it.

    One axis; ``beyond``, and on, if the wind is stronger. The speed falls by the same amount each
    step, and in the last one to 0: the path is the mean of the first and the last speed that is
    left, times their number.
    """
    speed = abs(velocity)
    slower = brake - select(velocity > 0, wind, -wind)
    ratio = speed / slower
    count = np.float32(np.int32(select(ratio < MANY, ratio, MANY)))  # also where it is no number
    path = count * ((speed - slower) + (speed - slower * count)) * HALF * tau
    path = select(slower > 0, path, select(speed > 0, beyond, p.zero))
    return select(velocity > 0, path, -path)


@compiled
def put_near(p, rays, ep, lo, hi, i, j, tile, k):
    """``lidar``: how near robot j is: 1 here, 0 from the sensing radius on."""
    per_radius = p.one / rays[0, 0]
    for w in range(lo, hi):
        dx, dy = ep.x[j, w] - ep.x[i, w], ep.y[j, w] - ep.y[i, w]
        distance = math.sqrt(dx * dx + dy * dy)
        tile[k, w - lo] = max(p.one - distance * per_radius, p.zero)


@compiled
def put_direction(p, g, ep, lo, hi, i, j, tile, k):
    """``lidar``: where ROI j lies, ``d / (|d| + 1 unit)``, and whether the team has visited it."""
    for w in range(lo, hi):
        f = column(g, w)
        dx = spot(g.rois, 0, j, f, w) - ep.x[i, w]
        dy = spot(g.rois, 1, j, f, w) - ep.y[i, w]
        length = math.sqrt(dx * dx + dy * dy) + p.one
        tile[k + 2, w - lo] = tile[k, w - lo]
        tile[k, w - lo] = dx / length
        tile[k + 1, w - lo] = dy / length


@compiled
def put_rays(p, g, rays, ep, lo, hi, i, tile, k):
    """``lidar``: how far robot i can go in each of the directions, up to the sensing radius.

    Each half of the directions is the other one turned back.
    """
    half, behind = rays.shape[1] // 2, slack(p, rays)
    for ray in range(half):
        row, back, dx, dy = k + ray, k + ray + half, rays[0, ray], rays[1, ray]
        for w in range(lo, hi):
            tile[row, w - lo] = p.one
            tile[back, w - lo] = p.one
        for e in range(g.edges.shape[1]):
            for w in range(lo, hi):
                f = column(g, w)
                ax, ay = g.edges[0, e, f], g.edges[1, e, f]
                bx, by = g.edges[2, e, f], g.edges[3, e, f]
                x, y, ex, ey = ep.x[i, w], ep.y[i, w], bx - ax, by - ay
                turn = cross(dx, dy, ex, ey)
                a_side, b_side = cross(dx, dy, ax - x, ay - y), cross(dx, dy, bx - x, by - y)
                along = cross(ax - x, ay - y, ex, ey) * (p.one / turn)
                there = reading(p, behind, a_side, b_side, turn, along)
                opposite = reading(p, behind, -a_side, -b_side, -turn, -along)
                tile[row, w - lo] = min(tile[row, w - lo], there)
                tile[back, w - lo] = min(tile[back, w - lo], opposite)


@compiled
def put_margins(p, g, rays, ep, lo, hi, i, tile, k):
    """``lidar``: when robot i would reach the wall, and how far the nearest wall is."""
    per_radius, behind = p.one / rays[0, 0], slack(p, rays)
    per_time = p.top_speed * per_radius
    for w in range(lo, hi):
        tile[k, w - lo] = p.one
        tile[k + 2, w - lo] = FAR
    for e in range(g.edges.shape[1]):
        for w in range(lo, hi):
            f = column(g, w)
            ax, ay = g.edges[0, e, f], g.edges[1, e, f]
            bx, by = g.edges[2, e, f], g.edges[3, e, f]
            x, y, ex, ey = ep.x[i, w], ep.y[i, w], bx - ax, by - ay
            dx, dy = ep.vx[i, w], ep.vy[i, w]
            turn = cross(dx, dy, ex, ey)
            a_side, b_side = cross(dx, dy, ax - x, ay - y), cross(dx, dy, bx - x, by - y)
            along = cross(ax - x, ay - y, ex, ey) * (per_time / turn)
            square = distance_squared(p, ax - x, ay - y, ex, ey)
            seen = reading(p, behind, a_side, b_side, turn, along)
            tile[k, w - lo] = min(tile[k, w - lo], seen)
            tile[k + 2, w - lo] = min(tile[k + 2, w - lo], square)
    for w in range(lo, hi):
        distance = math.sqrt(tile[k + 2, w - lo]) * per_radius
        tile[k + 2, w - lo] = min(distance, p.one)


@compiled
def place_of_rest(p, q, kinds, ep, brake, i, w):
    """Where robot i would stop if it braked from now on: along its heading, if it has one."""
    x, y, vx, vy = ep.x[i, w], ep.y[i, w], ep.vx[i, w], ep.vy[i, w]
    if kinds.ndim == 1 and has_heading(kinds[i]):
        cos, sin = ep.cos[i, w], ep.sin[i, w]
        wind, beyond = part_along(q.wind_x, q.wind_y, cos, sin), p.arena_x + p.arena_y
        path = braking_path(p, q.tau, part_along(vx, vy, cos, sin), brake, wind, beyond)
        return x + path * cos, y + path * sin
    x += braking_path(p, q.tau, vx, brake, q.wind_x, p.arena_x)
    y += braking_path(p, q.tau, vy, brake, q.wind_y, p.arena_y)
    return x, y


@compiled
def put_brake(p, g, kinds, ep, lo, hi, i, tile, k):
    """``lidar``: whether robot i would stop in the field if it braked from now on.

    The entry holds the bits of ``cross_edge`` until all edges have been seen.
    """
    limits, drawn = limits_of(g, i), ep.drawn
    for w in range(lo, hi):
        tile[k, w - lo] = p.zero
    for e in range(g.edges.shape[1]):
        for w in range(lo, hi):
            f = column(g, w)
            ax, ay = g.edges[0, e, f], g.edges[1, e, f]
            bx, by = g.edges[2, e, f], g.edges[3, e, f]
            mass, f_max, _ = limits_in(limits, drawn, i, w)
            q = numbers_of(p, drawn, w)
            x, y = place_of_rest(p, q, kinds, ep, f_max / mass, i, w)
            tile[k, w - lo] = cross_edge(np.int32(tile[k, w - lo]), x, y, ax, ay, bx, by)
    for w in range(lo, hi):
        tile[k, w - lo] = min(tile[k, w - lo], p.one)


@compiled
def put_walls(p, g, rays, ep, lo, hi, i, tile, k):
    """The entries about the walls; how many entries there are by then."""
    put_rays(p, g, rays, ep, lo, hi, i, tile, k)
    k += rays.shape[1]
    put_margins(p, g, rays, ep, lo, hi, i, tile, k)
    put_brake(p, g, g.kinds, ep, lo, hi, i, tile, k + 1)
    return k + 3
