"""Wind, gusts, and noise, loss and delay of actions."""

# The rules are those of conditions.md, "Disturbances".
#
# Source: Choton, Woods, Hsu, section 4, for the wind; the others are this package's.

import math
from collections.abc import Iterable

import numpy as np

from mbn_marl.config import MAX_ROBOTS, NavigationConfig
from mbn_marl.engine.mdp.drawn_numbers import numbers_of
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.features import Feature
from mbn_marl.jit.functions import clip, exponential, select
from mbn_marl.jit.random_numbers import FOR_GUSTS, FOR_SENDING, normal, stream_of, uniform

OF_ACTIONS = ("action_noise", "action_loss", "action_delay")
OF_ROBOTS = ("gust", *OF_ACTIONS)
OF_SIGHT = ("position_noise", "velocity_noise", "dropout")
# The settings, 0 where they are off, that disturb actions, what robots do, and what they see.
DISTURBANCES = (*OF_ROBOTS, *OF_SIGHT)
MOST_ROBOTS, DRAWS = np.uint64(MAX_ROBOTS), np.uint64(4)


def any_on(config: NavigationConfig, names: Iterable[str]) -> bool:
    return any(getattr(config, name) for name in names)


def gust_factors(config: NavigationConfig) -> tuple[float, float]:
    """Return the factors ``r`` and ``sigma sqrt(1 - r^2)`` of a gust's recursion."""
    r: float = exponential.py_func(-1.0 / config.gust_time)
    return r, config.gust * math.sqrt(1.0 - r * r)


has_gusts = Feature(lambda ep: ep.gust.ndim == 2)

disturbs_actions = Feature(lambda ep: ep.queue.ndim == 2)


@compiled
def add_wind(velocity, wind):
    """``v + wind`` along an axis: v_a cos(beta_a) along x, v_a sin(beta_a) along y."""
    return velocity + wind


@compiled
def wind_along(q, ep, axis, w):
    """The wind's increment along an axis, x or y, in world w: the wind's own, and the gust's."""
    wind = q.wind_x if axis == 0 else q.wind_y
    if has_gusts(ep):
        wind += ep.gust[axis, w]
    return wind


@compiled
def begin_gust(q, key, now, w):
    """The gust that world w begins an episode with: ``g = sigma xi`` along each axis."""
    if has_gusts(now):
        for axis in range(2):
            now.gust[axis, w] = q.gust * normal(stream_of(key, FOR_GUSTS), axis)


@compiled
def change_gust(p, mem, now, lo, hi):
    """``g' = r g + sigma sqrt(1 - r^2) xi`` along each axis, after the step has been counted."""
    if has_gusts(now):
        for axis in range(2):
            for w in range(lo, hi):
                q = numbers_of(p, now, w)
                xi = normal(stream_of(mem.key[w], FOR_GUSTS), 2 * now.steps[w] + axis)
                now.gust[axis, w] = q.gust_kept * now.gust[axis, w] + q.gust_added * xi


@compiled
def queue_row(p, n, i, step):
    return (step % (p.action_delay + 1) * n + i) * 2


@compiled
def send(p, mem, now, actions, lo, hi):
    """All actions: clipped, lost, delayed, noised and clipped again, into ``mem.acted``."""
    n, late, queue = actions.shape[1], p.action_delay, now.queue
    for i in range(n):
        for w in range(lo, hi):
            step, q = now.steps[w], numbers_of(p, now, w)
            key = stream_of(mem.key[w], FOR_SENDING)
            counter = (np.uint64(step) * MOST_ROBOTS + np.uint64(i)) * DRAWS
            lost = uniform(key, counter) < q.action_loss
            for axis in range(2):
                last = queue[queue_row(p, n, i, step + late) + axis, w]
                given = clip(actions[w, i, axis], -p.one, p.one)
                queue[queue_row(p, n, i, step) + axis, w] = select(lost, last, given)
                noise = q.action_noise * normal(key, counter + np.uint64(1 + axis))
                arrived = queue[queue_row(p, n, i, step + 1) + axis, w] + noise
                mem.acted[w, i, axis] = clip(arrived, -p.one, p.one)


@compiled
def begin_disturbances(p, mem, now, key, w):
    if mem.key.shape[0] > 0:
        mem.key[w] = key
    begin_gust(numbers_of(p, now, w), key, now, w)
    if disturbs_actions(now):
        for k in range(now.queue.shape[0]):
            now.queue[k, w] = p.zero
