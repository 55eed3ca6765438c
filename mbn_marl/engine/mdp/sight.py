"""The observer: what it senses with noise and dropout, and entries that observations share."""

# ``Memory.sensed`` has what the robot whose turn it is senses of n robots and m ROIs: first whether
# it senses each of them, 1 or 0, then the robots' x, y, vx and vy, then the ROIs' places.

from typing import Any, NamedTuple

import numpy as np

from mbn_marl.config import MAX_ROBOTS
from mbn_marl.engine.mdp.drawn_numbers import numbers_of
from mbn_marl.jit.compile import compiled, returning_views
from mbn_marl.jit.features import Feature
from mbn_marl.jit.functions import clip, column, select
from mbn_marl.jit.random_numbers import FOR_SIGHT, normal, stream_of, uniform

MOST_ROBOTS, MOST_THINGS, DRAWS = np.uint64(MAX_ROBOTS), np.uint64(128), np.uint64(8)
ONE, TWO, THREE, FOUR = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)

disturbs_sight = Feature(lambda mem: mem.sensed.ndim == 2)

# An entry: its name, bounds and unit.
Row = tuple[str, float, float, str]


class View(NamedTuple):
    """The observer, robot i of an episode, and what its observation is made of and written to."""

    # Few arrays: LLVM takes long for large tuples.
    sensed: Any  # of the memory
    plan: Any  # of the memory
    ep: Any
    robots: Any  # Robots
    i: Any
    tile: Any  # (size, at least hi - lo) float32: an entry a row, worlds side by side


class Robots(NamedTuple):
    """The robots as the observer senses them: what observations read of an ``Episode``."""

    x: Any
    y: Any
    vx: Any
    vy: Any
    cos: Any
    sin: Any


def count_sensed(n: int, m: int) -> int:
    return (n + m) + 4 * n + 2 * m


@returning_views
def sensed_robots(mem, ep, m):
    n, sensed = ep.x.shape[0], mem.sensed
    x, y, vx, vy = n + m, 2 * n + m, 3 * n + m, 4 * n + m
    motion = sensed[x:y], sensed[y:vx], sensed[vx:vy], sensed[vy : vy + n]
    return Robots(*motion, ep.cos, ep.sin)


@compiled
def roi_place(g, view, axis, j, f, w):
    if disturbs_sight(view):
        n, m = view.ep.x.shape[0], g.field.roi_bits.shape[0]
        return view.sensed[5 * n + m + 2 * j + axis, w]
    return g.field.rois[axis, j, f]


@compiled
def first_draw(steps, i, thing):
    """The counter of the first number that robot i draws for a thing that it may sense."""
    observer = np.uint64(steps) * MOST_ROBOTS + np.uint64(i)
    return (observer * MOST_THINGS + thing) * DRAWS


@compiled
def add_noise(key, counter, value, noise, low, high):
    return clip(value + noise * normal(key, counter), low, high)


@compiled
def look(p, g, mem, ep, i, lo, hi):
    n, m, sensed = ep.x.shape[0], g.field.roi_bits.shape[0], mem.sensed
    for j in range(n):
        for w in range(lo, hi):
            q = numbers_of(p, ep, w)
            key = stream_of(mem.key[w], FOR_SIGHT)
            counter = first_draw(ep.steps[w], i, np.uint64(j))
            lost = (uniform(key, counter) < q.dropout) & (i != j)
            sd, top = q.position_noise, p.top_speed
            x = add_noise(key, counter + ONE, ep.x[j, w], sd, p.zero, p.arena_x)
            y = add_noise(key, counter + TWO, ep.y[j, w], sd, p.zero, p.arena_y)
            vx = add_noise(key, counter + THREE, ep.vx[j, w], q.velocity_noise, -top, top)
            vy = add_noise(key, counter + FOUR, ep.vy[j, w], q.velocity_noise, -top, top)
            sensed[j, w] = select(lost, p.zero, p.one)
            sensed[n + m + j, w] = x
            sensed[2 * n + m + j, w] = y
            sensed[3 * n + m + j, w] = vx
            sensed[4 * n + m + j, w] = vy
    for j in range(m):
        for w in range(lo, hi):
            f, q = column(g.field, w), numbers_of(p, ep, w)
            key = stream_of(mem.key[w], FOR_SIGHT)
            counter = first_draw(ep.steps[w], i, MOST_ROBOTS + np.uint64(j))
            lost, sd = uniform(key, counter) < q.dropout, q.position_noise
            x = add_noise(key, counter + ONE, g.field.rois[0, j, f], sd, p.zero, p.arena_x)
            y = add_noise(key, counter + TWO, g.field.rois[1, j, f], sd, p.zero, p.arena_y)
            sensed[n + j, w] = select(lost, p.zero, p.one)
            sensed[5 * n + m + 2 * j, w] = x
            sensed[5 * n + m + 2 * j + 1, w] = y


@compiled
def drop(view, lo, hi, thing, k, end):
    if disturbs_sight(view):
        for entry in range(k, end):
            for w in range(lo, hi):
                view.tile[entry, w - lo] *= view.sensed[thing, w]


def heading_rows(robot: str, turns: bool) -> list[Row]:
    return [(f"{robot}_{name}", -1.0, 1.0, f"{name} of heading") for name in ("cos", "sin")] * turns


def flag_row(robot: str, flag: str) -> list[Row]:
    return [(f"{robot}_{flag}", 0.0, 1.0, "flag")] * bool(flag)


def mine_row(roi: str, kinds: bool) -> list[Row]:
    return [(f"{roi}_mine", 0.0, 1.0, "flag")] * kinds


@compiled
def put_heading(p, view, lo, hi, j, k):
    """The cosine and the sine of robot j's heading, both 0 if it has none; how many entries."""
    if p.headings == 0:
        return 0
    for w in range(lo, hi):
        view.tile[k, w - lo] = view.robots.cos[j, w]
        view.tile[k + 1, w - lo] = view.robots.sin[j, w]
    return 2


@compiled
def put_own_motion(p, view, lo, hi, k):
    robots, i = view.robots, view.i
    for w in range(lo, hi):
        view.tile[k, w - lo] = robots.vx[i, w] * p.per_speed
        view.tile[k + 1, w - lo] = robots.vy[i, w] * p.per_speed
    return k + 2 + put_heading(p, view, lo, hi, i, k + 2)
