"""Observation noise and dropout (mdp.md, "Disturbances").

Where neither is on, ``Memory.seen`` has no entries and three dimensions, and all of this is left
out when it is compiled.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mbn_marl.config import MAX_ROBOTS
from mbn_marl.engine.mdp.drawn import numbers_of
from mbn_marl.jit.compile import compiled, returning_views
from mbn_marl.jit.functions import clip, column, select
from mbn_marl.jit.random_numbers import FOR_SIGHT, normal, stream_of, uniform

MOST_ROBOTS, MOST_THINGS, DRAWS = np.uint64(MAX_ROBOTS), np.uint64(128), np.uint64(8)
ONE, TWO, THREE, FOUR = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)


class SeenRobots(NamedTuple):
    """The robots as the observer sees them: what observations read of an ``Episode``."""

    x: Any
    y: Any
    vx: Any
    vy: Any
    visited: Any
    cos: Any
    sin: Any


class SeenPlaces(NamedTuple):
    """The ROIs as the observer sees them: what observations read of a ``Geometry``."""

    rois: Any  # (2 m, W), unlike those of a Geometry
    roi_bits: Any
    codes: Any
    boxes: Any


def rows_seen(n: int, m: int) -> int:
    """How many numbers an observer sees of n robots and m ROIs.

    First which of them it sees, 1 or 0; then the robots' x, y, vx and vy; then the ROIs' places.
    """
    return (n + m) + 4 * n + 2 * m


@returning_views
def seen_robots(seen, ep, m):
    """The robots in ``seen``, of as many as the episode has, and of m ROIs."""
    n = ep.x.shape[0]
    x, y, vx, vy = n + m, 2 * n + m, 3 * n + m, 4 * n + m
    motion = seen[x:y], seen[y:vx], seen[vx:vy], seen[vy : vy + n]
    return SeenRobots(*motion, ep.visited, ep.cos, ep.sin)


@returning_views
def seen_places(seen, g, n):
    """The ROIs in ``seen``, beside those of n robots."""
    m = g.roi_bits.shape[0]
    return SeenPlaces(seen[5 * n + m : 5 * n + 3 * m], g.roi_bits, g.codes, g.boxes)


@compiled
def spot(rois, axis, j, f, w):
    """Where ROI j is along an axis, from the tables of a field, column f, or as it is seen."""
    if rois.ndim == 2:
        return rois[2 * j + axis, w]
    return rois[axis, j, f]


@compiled
def draws_of(steps, i, thing):
    """The counter of the first number that robot i draws for a thing that it sees."""
    observer = np.uint64(steps) * MOST_ROBOTS + np.uint64(i)
    return (observer * MOST_THINGS + thing) * DRAWS


@compiled
def blurred(key, counter, value, noise, low, high):
    """A number with noise, in its bounds."""
    return clip(value + noise * normal(key, counter), low, high)


@compiled
def look(p, g, keys, seen, ep, lo, hi, i):
    """Write what robot i sees in each world of a block to ``seen``."""
    n, m, drawn = ep.x.shape[0], g.roi_bits.shape[0], ep.drawn
    for j in range(n):
        for w in range(lo, hi):
            q = numbers_of(p, drawn, w)
            key = stream_of(keys[w], FOR_SIGHT)
            counter = draws_of(ep.steps[w], i, np.uint64(j))
            lost = (uniform(key, counter) < q.dropout) & (i != j)
            sd, top = q.position_noise, p.top_speed
            x = blurred(key, counter + ONE, ep.x[j, w], sd, p.zero, p.arena_x)
            y = blurred(key, counter + TWO, ep.y[j, w], sd, p.zero, p.arena_y)
            vx = blurred(key, counter + THREE, ep.vx[j, w], q.velocity_noise, -top, top)
            vy = blurred(key, counter + FOUR, ep.vy[j, w], q.velocity_noise, -top, top)
            seen[j, w] = select(lost, p.zero, p.one)
            seen[n + m + j, w] = x
            seen[2 * n + m + j, w] = y
            seen[3 * n + m + j, w] = vx
            seen[4 * n + m + j, w] = vy
    for j in range(m):
        for w in range(lo, hi):
            f, q = column(g, w), numbers_of(p, drawn, w)
            key = stream_of(keys[w], FOR_SIGHT)
            counter = draws_of(ep.steps[w], i, MOST_ROBOTS + np.uint64(j))
            lost, sd = uniform(key, counter) < q.dropout, q.position_noise
            x = blurred(key, counter + ONE, g.rois[0, j, f], sd, p.zero, p.arena_x)
            y = blurred(key, counter + TWO, g.rois[1, j, f], sd, p.zero, p.arena_y)
            seen[n + j, w] = select(lost, p.zero, p.one)
            seen[5 * n + m + 2 * j, w] = x
            seen[5 * n + m + 2 * j + 1, w] = y


@compiled
def is_seen(seen, thing, w):
    """Return whether the observer sees a thing, robot j or ROI j as n + j, at all."""
    if seen.ndim == 2:
        return seen[thing, w] != 0
    return True


@compiled
def drop(seen, thing, lo, hi, tile, k, end):
    """Blank entries k to end - 1 where a thing, robot j or ROI j as n + j, is not seen."""
    if seen.ndim == 2:
        for entry in range(k, end):
            for w in range(lo, hi):
                tile[entry, w - lo] *= seen[thing, w]
