"""The making of a random field, in whole numbers: one compiled function for all families.

It makes outline, holes, ROIs and starts, and begins again with other random numbers when the
outline has a narrow passage or a sharp corner, or when there is no room. After ``ATTEMPTS`` of
them, which the least sizes that samplers allow make all but impossible, the field is a square.
"""

from __future__ import annotations

import numpy as np

from mbn_marl.field.drawing import (
    QUARTER,
    SHIFT,
    TURN,
    add_corner,
    below,
    between,
    close_ring,
    is_near,
    sine,
)
from mbn_marl.field.layout import (
    ARENA,
    CONCAVE,
    CONVEX,
    COUNTER,
    FAMILIES,
    FARM,
    LENGTH,
    MILLI,
    NEXT,
    OBSTACLES,
    PASSAGE,
    POINTS,
    ROBOTS,
    ROIS,
    SIZE,
    WEIGHT_SUM,
    WEIGHTS,
    X,
    Y,
)
from mbn_marl.field.outlines import make_outline
from mbn_marl.field.placing import place_holes, place_points
from mbn_marl.jit.compile import compiled, entry_point
from mbn_marl.jit.random_numbers import FOR_FIELDS, stream_key, stream_of

ATTEMPTS = 100
SHARP, REFLEX = 82, 30
"""Of 100: the cosine of the sharpest corner (35 degrees), the sine of a corner that counts."""
FULL, THIN = 30, 12
"""Of 100: the least share of its longest side's square that an outline covers, if it is convex."""


@compiled
def draw_family(s, key, scratch, f):
    """The family of a field, with the probabilities that the weights ask for."""
    drawn, family = below(key, scratch, f, WEIGHT_SUM), 0
    for k in range(len(FAMILIES) - 1):
        family += drawn >= s[WEIGHTS + k]
    return family


@compiled
def fit(s, key, scratch, f, corners, size):
    """Turn corners by any angle, scale their longest side to ``size``, put them into the arena.

    Return the lowest x and y, the width and the height.
    """
    angle = below(key, scratch, f, TURN)
    sin, cos = sine(angle), sine(angle + QUARTER)
    left = low = np.int64(1 << 40)
    right = high = -left
    for i in range(corners):
        x, y = scratch[X + i, f], scratch[Y + i, f]
        x, y = (x * cos - y * sin) >> SHIFT, (x * sin + y * cos) >> SHIFT
        add_corner(scratch, f, i, x, y)
        left, right, low, high = min(left, x), max(right, x), min(low, y), max(high, y)
    longest = max(right - left, high - low)
    width, height = (right - left) * size // longest, (high - low) * size // longest
    to_x = below(key, scratch, f, s[ARENA] - width + 1)
    to_y = below(key, scratch, f, s[ARENA + 1] - height + 1)
    for i in range(corners):
        x = to_x + (scratch[X + i, f] - left) * size // longest
        y = to_y + (scratch[Y + i, f] - low) * size // longest
        add_corner(scratch, f, i, x, y)
    return to_x, to_y, width, height


@compiled
def is_sound(scratch, f, outline, corners, family, size):
    """Return whether an outline, and a ring's hole, have only wide passages and blunt corners."""
    twice_area, reflex = np.int64(0), False
    for i in range(corners):
        after = scratch[NEXT + i, f]
        x, y = scratch[X + after, f], scratch[Y + after, f]
        ux, uy = x - scratch[X + i, f], y - scratch[Y + i, f]
        last = scratch[NEXT + after, f]
        wx, wy = scratch[X + last, f] - x, scratch[Y + last, f] - y
        cross, lengths = ux * wy - uy * wx, scratch[LENGTH + i, f] * scratch[LENGTH + after, f]
        if -(ux * wx + uy * wy) > lengths // 100 * SHARP:
            return False
        reflex = reflex or cross < -(lengths // 100 * REFLEX)
        twice_area += (scratch[X + i, f] - scratch[X, f]) * uy
        twice_area -= (scratch[Y + i, f] - scratch[Y, f]) * ux
        for e in range(corners):
            other = e != after and scratch[NEXT + e, f] != after
            if other and min(e, after) < outline and is_near(scratch, f, e, x, y, PASSAGE):
                return False
    full = FULL if (family == CONVEX) | (family == OBSTACLES) else THIN
    return twice_area // 2 >= size * size // 100 * full and (reflex or family != CONCAVE)


@compiled
def attempt(s, key, scratch, f, family, size, rois, robots):
    """Try to make a field; return how many corners it has, 0 for none."""
    outline, corners = make_outline(key, scratch, f, family)
    box = fit(s, key, scratch, f, corners, size)
    close_ring(scratch, f, 0, outline)
    close_ring(scratch, f, outline, corners)
    if not is_sound(scratch, f, outline, corners, family, size):
        return 0
    most = 0
    if family == OBSTACLES:
        most = between(key, scratch, f, 1, 4)
    elif family == FARM:
        most = below(key, scratch, f, 2)
    corners = place_holes(key, scratch, f, corners, box, size, most, family == FARM)
    if family == OBSTACLES and corners == outline:
        return 0
    return corners if place_points(key, scratch, f, corners, box, size, rois, robots) else 0


@compiled
def make_square(scratch, f, size, points):
    """A square with its points on a grid: what is left when all attempts have failed."""
    for i in range(4):
        add_corner(scratch, f, i, size * ((i + 1) // 2 % 2), size * (i // 2))
    close_ring(scratch, f, 0, 4)
    columns = 1
    while columns * columns < points:
        columns += 1
    for p in range(points):
        scratch[POINTS + 2 * p, f] = (2 * (p % columns) + 1) * size // (2 * columns)
        scratch[POINTS + 2 * p + 1, f] = (2 * (p // columns) + 1) * size // (2 * columns)
    return 4


@compiled
def units(length):
    """A length in units, float64, rounded once."""
    return np.float64(length) / np.float64(MILLI)


@compiled
def write(scratch, g, f, corners, rois, robots):
    """Fill column f of the tables ``g`` as ``engine.geometry.write_field`` does."""
    left = right = scratch[X, f]
    low = high = scratch[Y, f]
    for e in range(g.edges.shape[1]):
        i = e if e < corners else 0
        after = scratch[NEXT + i, f] if e < corners else 0
        x, y = scratch[X + i, f], scratch[Y + i, f]
        left, right, low, high = min(left, x), max(right, x), min(low, y), max(high, y)
        g.edges[0, e, f] = units(x)
        g.edges[1, e, f] = units(y)
        g.edges[2, e, f] = units(scratch[X + after, f])
        g.edges[3, e, f] = units(scratch[Y + after, f])
    g.boxes[0, f] = units(left)
    g.boxes[1, f] = units(low)
    g.boxes[2, f] = units(right) - units(left)
    g.boxes[3, f] = units(high) - units(low)
    for j in range(g.rois.shape[1]):
        row = POINTS + 2 * (j if j < rois else 0)
        g.rois[0, j, f] = units(scratch[row, f])
        g.rois[1, j, f] = units(scratch[row + 1, f])
        g.roi_bits[j, f] = 1 << (rois - 1 - j if j < rois else j)
    for i in range(g.starts.shape[1]):
        row = POINTS + 2 * (rois + (i if i < robots else 0))
        g.starts[0, i, f] = units(scratch[row, f])
        g.starts[1, i, f] = units(scratch[row + 1, f])
    g.codes[f] = (1 << rois) - 1
    g.robots_in[f] = robots


@compiled
def make_field(s, key, scratch, g, f):
    """Make the field that a key stands for, in column f of ``g``; return its family's code.

    Args:
        s: (13,) int64, a sampler's ``numbers()``; they may change from one call to the next.
        key: uint64; fields of different keys are independent.
        scratch: (``FieldSampler.scratch_rows``, F) int64, whose column f is overwritten.
        g: the tables ``edges``, ``rois``, ``starts``, ``roi_bits``, ``codes``, ``boxes`` of
            ``engine.state.Geometry``, and ``robots_in`` (F,) int32, how many robots there are.
        f: the column.
    """
    scratch[COUNTER, f] = 0
    family = draw_family(s, key, scratch, f)
    robots = between(key, scratch, f, s[ROBOTS], s[ROBOTS + 1])
    rois = between(key, scratch, f, s[ROIS], s[ROIS + 1])
    size = between(key, scratch, f, s[SIZE], s[SIZE + 1])
    corners = 0
    for number in range(ATTEMPTS):
        scratch[COUNTER, f] = 0
        own = stream_of(key, np.uint64(family * ATTEMPTS + number + 1))
        corners = attempt(s, own, scratch, f, family, size, rois, robots)
        if corners > 0:
            break
    if corners == 0:
        corners = make_square(scratch, f, size, rois + robots)
    write(scratch, g, f, corners, rois, robots)
    return family


@entry_point
def make_fields(s, seed, world, episode, scratch, g, families):
    """Make the fields of the worlds from ``world`` on, one for each entry of ``families`` (F,)."""
    for f in range(families.shape[0]):
        key = stream_key(seed, np.uint64(world) + np.uint64(f), np.uint64(episode), FOR_FIELDS)
        families[f] = make_field(s, key, scratch, g, f)
