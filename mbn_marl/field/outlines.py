"""The outlines of the families, with their corners counter-clockwise, before they are turned.

Coordinates are whole numbers of no unit; 2^20 is about half of an outline's longest side. What is
too narrow or too sharp is found later (``families.is_sound``).
"""

from __future__ import annotations

from mbn_marl.field.drawing import QUARTER, SHIFT, TURN, add_corner, below, between, sine
from mbn_marl.field.layout import CONCAVE, CONVEX, CORRIDORS, FARM, LENGTH, NEXT, OBSTACLES, X, Y
from mbn_marl.jit.compile import compiled

ONE = 1 << 20
PERCENT = ONE // 100
HULL_X, HULL_Y = NEXT, LENGTH
"""Rows that are free while an outline is made."""
RING, COMB = 0, 3
"""Corridors: a ring, an L, a U (2) and combs of three to five teeth."""
BANDS = 3
"""How many of four concave outlines are bands."""


@compiled
def make_hull(key, scratch, f):
    """The convex hull of random points."""
    count = between(key, scratch, f, 5, 12)
    squeeze = between(key, scratch, f, 55, 100)
    first = 0
    for i in range(count):
        scratch[HULL_X + i, f] = between(key, scratch, f, -ONE, ONE)
        scratch[HULL_Y + i, f] = between(key, scratch, f, -ONE, ONE) * squeeze // 100
        if scratch[HULL_Y + i, f] < scratch[HULL_Y + first, f]:
            first = i
    k, at = 0, first
    for _ in range(count):
        x, y = scratch[HULL_X + at, f], scratch[HULL_Y + at, f]
        k = add_corner(scratch, f, k, x, y)
        ahead = first if at != first else (first + 1) % count
        for i in range(count):
            ux, uy = scratch[HULL_X + ahead, f] - x, scratch[HULL_Y + ahead, f] - y
            wx, wy = scratch[HULL_X + i, f] - x, scratch[HULL_Y + i, f] - y
            if ux * wy < uy * wx:
                ahead = i
        at = ahead
        if at == first:
            break
    return k


@compiled
def make_star(key, scratch, f, least, most, shortest):
    """Corners around the origin, at distances from ``shortest`` to ``ONE``."""
    count = between(key, scratch, f, least, most)
    for i in range(count):
        angle = (i * TURN + below(key, scratch, f, TURN * 7 // 10)) // count
        radius = between(key, scratch, f, shortest, ONE)
        x, y = (radius * sine(angle + QUARTER)) >> SHIFT, (radius * sine(angle)) >> SHIFT
        add_corner(scratch, f, i, x, y)
    return count


@compiled
def make_band(key, scratch, f):
    """A band from left to right whose centre line wanders; star-shaped only by chance."""
    columns = between(key, scratch, f, 4, 8)
    slot = 2 * ONE // columns
    centre = 0
    for i in range(columns):
        x = i * slot + below(key, scratch, f, slot // 2)
        half = between(key, scratch, f, 12 * PERCENT, 32 * PERCENT)
        step = between(key, scratch, f, 15 * PERCENT, 65 * PERCENT)
        centre += step if below(key, scratch, f, 2) == 0 else -step
        add_corner(scratch, f, i, x, centre - half)
        add_corner(scratch, f, 2 * columns - 1 - i, x, centre + half)
    return 2 * columns


@compiled
def make_comb(key, scratch, f, teeth):
    """A base along x with teeth upwards, from right to left; with one tooth an L."""
    base = between(key, scratch, f, 12 * PERCENT, 24 * PERCENT)
    x, k = 0, add_corner(scratch, f, 0, 0, 0)
    for i in range(teeth):
        top = base + between(key, scratch, f, 30 * PERCENT, 100 * PERCENT)
        k = add_corner(scratch, f, k, x, top)
        x -= between(key, scratch, f, 12 * PERCENT, 24 * PERCENT)
        k = add_corner(scratch, f, k, x, top)
        gap = between(key, scratch, f, 10 * PERCENT, 40 * PERCENT)
        gap = gap + 40 * PERCENT if teeth <= 2 else gap
        if i + 1 < teeth or teeth == 1:
            k = add_corner(scratch, f, k, x, base)
            x -= gap
            k = add_corner(scratch, f, k, x, base)
    return add_corner(scratch, f, k, x, 0)


@compiled
def make_parcel(key, scratch, f):
    """A parcel of land: a strip or a trapezoid, by chance with a bend, a notch, a corner cut."""
    highest = 30 if below(key, scratch, f, 3) == 0 else 75
    height = between(key, scratch, f, 16 * PERCENT, highest * PERCENT)
    slant = between(key, scratch, f, 0, 35 * PERCENT)
    other = between(key, scratch, f, 0, 35 * PERCENT)
    bend = between(key, scratch, f, 0, 12 * PERCENT) + height // 5
    shift = between(key, scratch, f, -25 * PERCENT, 25 * PERCENT)
    wide = between(key, scratch, f, 10 * PERCENT, 25 * PERCENT)
    deep = height * between(key, scratch, f, 30, 120) // 100
    cut = between(key, scratch, f, 20 * PERCENT, 60 * PERCENT)
    extras = below(key, scratch, f, 8)
    k = add_corner(scratch, f, 0, -ONE, -height)
    if extras & 1:
        k = add_corner(scratch, f, k, shift, -height - bend)
    k = add_corner(scratch, f, k, ONE, -height)
    if extras & 2:
        k = add_corner(scratch, f, k, ONE, height - deep)
        k = add_corner(scratch, f, k, ONE - cut, height - deep)
        k = add_corner(scratch, f, k, ONE - cut, height)
    else:
        k = add_corner(scratch, f, k, ONE - slant, height)
        if extras & 4:
            k = add_corner(scratch, f, k, shift + wide, height)
            k = add_corner(scratch, f, k, shift + wide * 3 // 4, height - deep)
            k = add_corner(scratch, f, k, shift - wide, height - deep)
            k = add_corner(scratch, f, k, shift - wide, height)
    return add_corner(scratch, f, k, -ONE + other, height)


@compiled
def make_outline(key, scratch, f, family):
    """Make an outline; return how many corners it has, and how many with those of a ring's hole."""
    kind = below(key, scratch, f, 4)
    ring = (family == CORRIDORS) & (kind == RING)
    if (family == CONVEX) | (family == OBSTACLES):
        corners = make_hull(key, scratch, f)
    elif family == FARM:
        corners = make_parcel(key, scratch, f)
    elif (family == CONCAVE) & (kind < BANDS):
        corners = make_band(key, scratch, f)
    elif (family == CORRIDORS) & (kind != RING):
        teeth = kind + below(key, scratch, f, 3) if kind == COMB else kind
        corners = make_comb(key, scratch, f, teeth)
    else:
        least, most = (4, 8) if ring else (6, 12)
        shortest = 70 * PERCENT if ring else 30 * PERCENT
        corners = make_star(key, scratch, f, least, most, shortest)
    if not ring:
        return corners, corners
    share = between(key, scratch, f, 40, 65)
    for i in range(corners):
        x, y = scratch[X + i, f], scratch[Y + i, f]
        add_corner(scratch, f, 2 * corners - 1 - i, x * share // 100, y * share // 100)
    return corners, 2 * corners
