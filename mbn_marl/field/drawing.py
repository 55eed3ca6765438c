"""Whole numbers for the generator of fields: random ones, sines, roots, distances.

All are int64, but for keys, which are uint64: Numba makes float64 of the two together.
"""

from __future__ import annotations

import math

import numpy as np

from mbn_marl.field.layout import COUNTER, LENGTH, NEXT, X, Y
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.random_numbers import GOLDEN, mix

HALF_WORD = np.uint64(32)
TURN, QUARTER = 1 << 16, 1 << 14
"""Angles are in such parts of a turn."""
SHIFT = 14
"""Sines are whole numbers, 2^14 for 1."""
SINE_1, SINE_3, SINE_5 = 51472, 21024, 2320


@compiled
def below(key, scratch, f, bound):
    """The next random number from 0 to ``bound - 1``, with a bound of at most 2^32."""
    scratch[COUNTER, f] += 1
    bits = mix(key + np.uint64(scratch[COUNTER, f]) * GOLDEN) >> HALF_WORD
    return np.int64((bits * np.uint64(bound)) >> HALF_WORD)


@compiled
def between(key, scratch, f, low, high):
    """The next random number from ``low`` to ``high``, both included."""
    return low + below(key, scratch, f, high - low + 1)


@compiled
def sine(angle):
    """The sine of an angle times 2^14, to 5 of these: a polynomial of degree 5."""
    x = ((angle + QUARTER) & (TURN - 1)) - QUARTER
    x = 2 * QUARTER - x if x > QUARTER else x
    square = (x * x) >> SHIFT
    factor = SINE_1 - ((square * (SINE_3 - ((square * SINE_5) >> SHIFT))) >> SHIFT)
    return (x * factor) >> (SHIFT + 1)


@compiled
def root(number):
    """The square root of a number below 2^62, rounded up to one more than the whole part."""
    found = np.int64(math.sqrt(np.float64(number)))  # at most 1 off
    found -= np.int64(found * found > number)
    return found + np.int64((found + 1) * (found + 1) <= number) + 1


@compiled
def add_corner(scratch, f, k, x, y):
    """Make (x, y) corner k; return the number of the next."""
    scratch[X + k, f] = x
    scratch[Y + k, f] = y
    return k + 1


@compiled
def close_ring(scratch, f, first, end):
    """Make a ring of the corners from ``first`` on, up to ``end - 1``."""
    for i in range(first, end):
        after = i + 1 if i + 1 < end else first
        dx = scratch[X + after, f] - scratch[X + i, f]
        dy = scratch[Y + after, f] - scratch[Y + i, f]
        scratch[NEXT + i, f] = after
        scratch[LENGTH + i, f] = root(dx * dx + dy * dy)


@compiled
def is_near(scratch, f, e, x, y, distance):
    """Return whether (x, y) may be nearer than ``distance`` to edge e, and surely if it is."""
    after = scratch[NEXT + e, f]
    ux = scratch[X + after, f] - scratch[X + e, f]
    uy = scratch[Y + after, f] - scratch[Y + e, f]
    wx, wy = x - scratch[X + e, f], y - scratch[Y + e, f]
    along, square = wx * ux + wy * uy, ux * ux + uy * uy
    before, past = along <= 0, along >= square
    near = before & (wx * wx + wy * wy < distance * distance)
    near |= past & ((wx - ux) * (wx - ux) + (wy - uy) * (wy - uy) < distance * distance)
    beside = abs(ux * wy - uy * wx) < distance * scratch[LENGTH + e, f]
    return near | (beside & (not (before | past)))


@compiled
def is_clear(scratch, f, corners, x, y, distance):
    """Return whether (x, y) is inside, at least ``distance`` from all edges."""
    inside, near = False, False
    for e in range(corners):  # without branches, so that edges are checked side by side
        near |= is_near(scratch, f, e, x, y, distance)
        after = scratch[NEXT + e, f]
        ax, ay = scratch[X + e, f], scratch[Y + e, f]
        bx, by = scratch[X + after, f], scratch[Y + after, f]
        left = (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0
        inside ^= ((ay > y) != (by > y)) & (left == (by > ay))
    return inside & (not near)
