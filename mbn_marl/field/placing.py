"""Holes, ROIs and starts: random points that are clear of walls and of each other."""

from __future__ import annotations

from mbn_marl.field.drawing import (
    QUARTER,
    SHIFT,
    TURN,
    add_corner,
    below,
    between,
    close_ring,
    is_clear,
    sine,
)
from mbn_marl.field.layout import (
    PASSAGE,
    POINTS,
    ROI_WISH,
    ROIS_APART,
    ROIS_WISH,
    STARTS_APART,
    STARTS_WISH,
    WALL,
    WALL_WISH,
)
from mbn_marl.jit.compile import compiled

TRIES = 96
"""How many points are tried for an ROI or a start; what is wished shrinks from one to the next."""
HOLE_TRIES = 20


@compiled
def place_holes(key, scratch, f, outline, box, size, most, rounder):
    """Add up to ``most`` convex holes; return how many corners there are then.

    A hole's corners are on a circle, 3 to 5 of them, or 6 to 8 if it is ``rounder``.
    """
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
