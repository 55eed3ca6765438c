"""Wind, gusts, and noise, loss and delay of actions.

The rules are those of mdp.md, "Disturbances".

A disturbance that is off has arrays without entries and with three dimensions, by which its code is
left out when it is compiled.

Source: Choton, Woods, Hsu, section 4, for the wind; the others are this package's.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from mbn_marl.config import MAX_ROBOTS, NavigationConfig
from mbn_marl.engine.mdp.drawn import numbers_of
from mbn_marl.jit.compile import compiled, returning_views
from mbn_marl.jit.functions import clip, exponential, select
from mbn_marl.jit.random_numbers import (
    FOR_GUSTS,
    FOR_SENDING,
    normal,
    stream_of,
    uniform,
)

OF_ACTIONS = ("action_noise", "action_loss", "action_delay")
OF_ROBOTS = ("gust", *OF_ACTIONS)
OF_SIGHT = ("position_noise", "velocity_noise", "dropout")
DISTURBANCES = (*OF_ROBOTS, *OF_SIGHT)
"""The settings, 0 where they are off, that disturb actions, what robots do, and what they see."""
MOST_ROBOTS, DRAWS = np.uint64(MAX_ROBOTS), np.uint64(4)


def any_on(config: NavigationConfig, names: Iterable[str]) -> bool:
    """Return whether any of these disturbances is on."""
    return any(getattr(config, name) for name in names)


def gust_factors(config: NavigationConfig) -> tuple[float, float]:
    """Return the factors ``r`` and ``sigma sqrt(1 - r^2)`` of a gust's recursion."""
    r: float = exponential.py_func(-1.0 / config.gust_time)
    return r, config.gust * math.sqrt(1.0 - r * r)


@compiled
def add_wind(velocity, wind):
    """``v + wind`` along an axis: v_a cos(beta_a) along x, v_a sin(beta_a) along y."""
    return velocity + wind


@compiled
def wind_along(q, gust, axis, w):
    """The wind's increment along an axis, x or y, in world w: the wind's own, and the gust's."""
    wind = q.wind_x if axis == 0 else q.wind_y
    if gust.ndim == 2:
        wind += gust[axis, w]
    return wind


@compiled
def begin_gust(q, keys, gust, w):
    """The gust that world w begins an episode with: ``g = sigma xi`` along each axis."""
    if gust.ndim == 2:
        key = stream_of(keys[w], FOR_GUSTS)
        for axis in range(2):
            gust[axis, w] = q.gust * normal(key, axis)


@compiled
def change_gust(p, drawn, keys, gust, steps, lo, hi):
    """``g' = r g + sigma sqrt(1 - r^2) xi`` along each axis; ``steps`` are those before g'."""
    if gust.ndim == 2:
        for axis in range(2):
            for w in range(lo, hi):
                q = numbers_of(p, drawn, w)
                xi = normal(stream_of(keys[w], FOR_GUSTS), 2 * steps[w] + axis)
                gust[axis, w] = q.gust_kept * gust[axis, w] + q.gust_added * xi


@compiled
def row_of(p, n, i, step):
    """The first of the two rows of the queue that have what robot i of n sent in a step."""
    return (step % (p.action_delay + 1) * n + i) * 2


@compiled
def send(p, drawn, keys, queue, acted, steps, actions, i, lo, hi):
    """Robot i's actions: clipped, lost, delayed, noised and clipped again, into ``acted``."""
    n, late = actions.shape[1], p.action_delay
    for w in range(lo, hi):
        step, q = steps[w], numbers_of(p, drawn, w)
        key = stream_of(keys[w], FOR_SENDING)
        counter = (np.uint64(step) * MOST_ROBOTS + np.uint64(i)) * DRAWS
        lost = uniform(key, counter) < q.action_loss
        for axis in range(2):
            last = queue[row_of(p, n, i, step + late) + axis, w]
            given = clip(actions[w, i, axis], -p.one, p.one)
            queue[row_of(p, n, i, step) + axis, w] = select(lost, last, given)
            noise = q.action_noise * normal(key, counter + np.uint64(1 + axis))
            arrived = queue[row_of(p, n, i, step + 1) + axis, w] + noise
            acted[w, i, axis] = clip(arrived, -p.one, p.one)


@returning_views
def arrived_actions(p, drawn, keys, queue, acted, steps, actions, lo, hi):
    """The actions (W, n, 2) that a block's robots take: those given, or disturbed, in ``acted``."""
    if queue.ndim == 2:
        for i in range(actions.shape[1]):
            send(p, drawn, keys, queue, acted, steps, actions, i, lo, hi)
        return acted
    return actions


@compiled
def begin_queue(p, queue, w):
    """Nothing has been sent in the episode that world w begins."""
    if queue.ndim == 2:
        for k in range(queue.shape[0]):
            queue[k, w] = p.zero


@compiled
def begin_disturbances(p, drawn, keys, gust, queue, key, w):
    """Begin the episode of world w with this key: keep it, and what is disturbed first."""
    if keys.shape[0] > 0:
        keys[w] = key
    begin_gust(numbers_of(p, drawn, w), keys, gust, w)
    begin_queue(p, queue, w)
