"""What ``lidar`` senses of the walls, one scalar function each, written like those of ``rules``.

An edge goes from a to b, and the field lies to its left; its ends are given as seen from the robot.
Only operations that every processor rounds alike are used.
"""

from __future__ import annotations

import math

import numpy as np

from mbn_marl.engine.compiling import compiled
from mbn_marl.engine.rules import clip, select

HALF, MANY = np.float32(0.5), np.float32(1e6)
ROUNDING = np.float32(1e-6)
"""Of a position, in arenas: a little more than float32's."""
S = math.sqrt(0.5)
RAYS = np.array([[1, S, 0, -S, -1, -S, 0, S], [0, S, 1, S, 0, -S, -1, -S]])
"""The directions of the rays, (2, 8): unit vectors, counter-clockwise from +x."""


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
def braking_path(p, velocity, brake, wind, beyond):
    """How far a robot goes until the force that brakes it by ``brake`` a step has stopped it.

    One axis; ``beyond``, and on, if the wind is stronger. The speed falls by the same amount each
    step, and in the last one to 0: the path is the mean of the first and the last speed that is
    left, times their number.
    """
    speed = abs(velocity)
    slower = brake - select(velocity > 0, wind, -wind)
    ratio = speed / slower
    count = np.float32(np.int32(select(ratio < MANY, ratio, MANY)))  # also where it is no number
    path = count * ((speed - slower) + (speed - slower * count)) * HALF * p.tau
    path = select(slower > 0, path, select(speed > 0, beyond, p.zero))
    return select(velocity > 0, path, -path)
