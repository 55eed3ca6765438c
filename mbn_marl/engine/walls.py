"""What ``lidar`` senses of the walls, one scalar function each, written like those of ``rules``.

An edge is given by the offsets of its ends a and b from the robot; the field lies to the left of
a-b. ``p`` are the MDP's constants. Only operations that every processor rounds alike are used.
"""

from __future__ import annotations

import math

import numpy as np

from mbn_marl.engine.compiling import compiled
from mbn_marl.engine.rules import clip, select

HALF = np.float32(0.5)
S = math.sqrt(0.5)
RAYS = np.array([[1, S, 0, -S, -1, -S, 0, S], [0, S, 1, S, 0, -S, -1, -S]])
"""The directions of the rays, (2, 8): unit vectors, counter-clockwise from +x."""


@compiled
def reading(p, dx, dy, ax, ay, bx, by, scale):
    """Where a ray along (dx, dy) leaves the field through the edge: 0 here to 1 at ``1 / scale``.

    1 where it does not. A ray through a corner leaves by both of its edges, so none slips between
    them; along an edge it leaves by the next one. A robot that rounding has put behind the edge it
    stands on, by less than ``p.slack``, is at the edge.
    """
    a_right = dx * ay - dy * ax <= 0
    b_left = dx * by - dy * bx >= 0
    turn = dx * (by - ay) - dy * (bx - ax)
    ahead = (ax * by - ay * bx) / turn * scale
    leaves = a_right & b_left & (turn > 0) & (ahead >= -p.slack)
    return select(leaves, clip(ahead, p.zero, p.one), p.one)


@compiled
def distance_squared(p, ax, ay, bx, by):
    """From the robot to the nearest point of the edge, squared."""
    ex, ey = bx - ax, by - ay
    square = ex * ex + ey * ey
    along = select(square > 0, clip(-(ax * ex + ay * ey) / square, p.zero, p.one), p.zero)
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
    count = math.floor(speed / slower)
    path = count * ((speed - slower) + (speed - slower * count)) * HALF * p.tau
    path = select(slower > 0, path, select(speed > 0, beyond, p.zero))
    return select(velocity > 0, path, -path)
