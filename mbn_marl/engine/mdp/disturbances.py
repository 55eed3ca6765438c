"""What acts on the robots besides their own force: wind and gusts (mdp.md, "Disturbances").

A disturbance that is off has arrays without entries and with three dimensions, by which its code is
left out when it is compiled.

Source: Choton, Woods, Hsu, section 4, for the wind; the others are this package's.
"""

from __future__ import annotations

import math

from mbn_marl.config import NavigationConfig
from mbn_marl.engine.jit import compiled
from mbn_marl.engine.mdp.elementary import exponential
from mbn_marl.engine.mdp.rng import FOR_GUSTS, episode_key, normal, stream_of, world_number


def is_disturbed(config: NavigationConfig) -> bool:
    """Return whether any disturbance but the wind is on."""
    return config.gust > 0


def gust_factors(config: NavigationConfig) -> tuple[float, float]:
    """What a step leaves of a gust, ``r``, and what it adds to it, ``sigma sqrt(1 - r^2)``."""
    r = exponential(-1.0 / config.gust_time)
    return r, config.gust * math.sqrt(1.0 - r * r)


@compiled
def add_wind(velocity, wind):
    """``v + wind`` along an axis: v_a cos(beta_a) along x, v_a sin(beta_a) along y."""
    return velocity + wind


@compiled
def wind_along(p, gust, axis, w):
    """The wind's increment along an axis, x or y, in world w: the wind's own, and the gust's."""
    wind = p.wind_x if axis == 0 else p.wind_y
    if gust.ndim == 2:
        wind += gust[axis, w]
    return wind


@compiled
def begin_gust(p, keys, gust, w):
    """The gust that world w begins an episode with: ``g = sigma xi`` along each axis."""
    if gust.ndim == 2:
        key = stream_of(keys[w], FOR_GUSTS)
        for axis in range(2):
            gust[axis, w] = p.gust * normal(key, axis)


@compiled
def change_gust(p, keys, gust, steps, lo, hi):
    """``g' = r g + sigma sqrt(1 - r^2) xi`` along each axis; ``steps`` are those before g'."""
    if gust.ndim == 2:
        for axis in range(2):
            for w in range(lo, hi):
                xi = normal(stream_of(keys[w], FOR_GUSTS), 2 * steps[w] + axis)
                gust[axis, w] = p.gust_kept * gust[axis, w] + p.gust_added * xi


@compiled
def begin_disturbances(p, mem, now, w):
    """Begin the episode of world w: the key of its random numbers, and what they disturb first."""
    if mem.key.shape[0] > 0:
        mem.key[w] = episode_key(mem.seed[0], world_number(p, w), mem.episode[w])
    begin_gust(p, mem.key, now.gust, w)
