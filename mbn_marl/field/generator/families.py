"""The making of a random field, in whole numbers: one compiled function for all families.

It makes outline, holes, ROIs and starts, and begins again with other random numbers when the
outline has a narrow passage or a sharp corner, or when there is no room. After ``ATTEMPTS`` of
them, which the least sizes that samplers allow make all but impossible, the field is a square.

All numbers are int64, so that every processor makes the same field; keys are uint64, since Numba
makes float64 of the two together. Outlines have their corners counter-clockwise, in whole numbers
of no unit, where 2^20 is about half of the longest side; ``fit`` makes milli-units of them.
"""

from __future__ import annotations

import math

import numpy as np

from mbn_marl.field.generator.layout import (
    CORNERS,
    FAMILIES,
    MILLI,
    POINTS,
    ROIS_APART,
    STARTS_APART,
    WALL,
    WEIGHT_SUM,
)
from mbn_marl.jit.compile import compiled, entry_point
from mbn_marl.jit.random_numbers import FOR_FIELDS, GOLDEN, mix, stream_key, stream_of

CONVEX, CONCAVE, CORRIDORS, OBSTACLES, FARM = range(len(FAMILIES))
ARENA, SIZE, ROBOTS, ROIS, WEIGHTS = 0, 2, 4, 6, 8
"""Of a sampler's numbers: the arena's sides, three ranges, and the families' weights, summed up."""
COUNTER = 0
X, Y, NEXT, LENGTH = (1 + k * CORNERS for k in range(4))
"""Rows of the scratch: corners, the corner that follows, the length of the edge to it."""
PASSAGE = 12 * MILLI
"""No passage is narrower."""
WALL_WISH, ROIS_WISH, STARTS_WISH, ROI_WISH = 8 * MILLI, 30 * MILLI, 30 * MILLI, 20 * MILLI
"""Distances that points have if there is room; the last is that of starts from ROIs."""
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


ONE = 1 << 20
PERCENT = ONE // 100
HULL_X, HULL_Y = NEXT, LENGTH
"""Rows that are free while an outline is made."""
RING, COMB = 0, 3
"""Corridors: a ring, an L, a U (2) and combs of three to five teeth."""
BANDS = 3
"""The number of bands among four concave outlines."""


@compiled
def make_hull(key, scratch, f):
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
    """Turn, scale and move corners into the arena; return lowest x and y, width and height."""
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


TRIES = 96
"""Points tried for an ROI or a start; the wished distance shrinks from try to try."""
HOLE_TRIES = 20


@compiled
def place_holes(key, scratch, f, outline, box, size, most, rounder):
    """Add up to ``most`` convex holes of 3 to 5 corners, 3 more if ``rounder``; count corners."""
    left, low, width, height = box
    corners = outline
    for _ in range(most):
        for _ in range(HOLE_TRIES):
            radius = max(between(key, scratch, f, size // 16, size // (4 + most)), PASSAGE // 2)
            x = left + below(key, scratch, f, width + 1)
            y = low + below(key, scratch, f, height + 1)
            if is_clear(scratch, f, corners, x, y, radius + PASSAGE):
                count = between(key, scratch, f, 3, 5) + 3 * rounder
                phase = below(key, scratch, f, TURN)
                for i in range(count):
                    angle = phase - (i * TURN + below(key, scratch, f, TURN * 7 // 10)) // count
                    dx = (radius * sine(angle + QUARTER)) >> SHIFT
                    dy = (radius * sine(angle)) >> SHIFT
                    add_corner(scratch, f, corners + i, x + dx, y + dy)
                close_ring(scratch, f, corners, corners + count)
                corners += count
                break
    return corners


@compiled
def shrinking(wish, least, left):
    """A distance that goes from ``wish`` to ``least`` while ``left`` goes from ``TRIES`` to 0."""
    return least + (wish - least) * left // TRIES


@compiled
def place_points(key, scratch, f, corners, box, size, rois, robots):
    """Put the ROIs and the starts into a field; return whether there was room for all."""
    left, low, width, height = box
    rois_wish = max(ROIS_WISH, size // (rois + 2))
    for p in range(rois + robots):
        placed = False
        for t in range(TRIES):
            x = left + below(key, scratch, f, width + 1)
            y = low + below(key, scratch, f, height + 1)
            from_rois = shrinking(rois_wish, ROIS_APART, TRIES - t)
            if p >= rois:
                from_rois = shrinking(ROI_WISH, 0, TRIES - t)
            from_starts = shrinking(STARTS_WISH, STARTS_APART, TRIES - t)
            wall = shrinking(WALL_WISH, WALL, TRIES - t)
            # A point of the field that is so close to a side of the box is closer to an edge.
            placed = min(x - left, y - low, left + width - x, low + height - y) >= wall
            for q in range(p):
                dx = scratch[POINTS + 2 * q, f] - x
                dy = scratch[POINTS + 2 * q + 1, f] - y
                apart = from_rois if q < rois else from_starts
                placed = placed and dx * dx + dy * dy >= apart * apart
            if placed and is_clear(scratch, f, corners, x, y, wall):
                scratch[POINTS + 2 * p, f] = x
                scratch[POINTS + 2 * p + 1, f] = y
                break
            placed = False
        if not placed:
            return False
    return True


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
    return np.float64(length) / np.float64(MILLI)


@compiled
def write(scratch, g, f, corners, rois, robots):
    """Fill column f of the tables ``g`` as ``engine.tables.write_field`` does."""
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
    """Make the field of a key (uint64) in column f of ``g``; return its family's code.

    ``s`` (13,) is a sampler's ``numbers()``, ``scratch`` (``scratch_rows()``, F) int64, whose
    column f is overwritten, and ``g`` has all of ``Tables``.
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
