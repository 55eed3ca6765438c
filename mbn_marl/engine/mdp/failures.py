"""Robots that fail during an episode (mdp.md, "Failures").

The flags of who has failed are an array (n, W) of ``Episode``, of three dimensions and without
entries where failures are off. The functions get it as an argument of its own, so that a condition
on its type leaves their code out there.

Source: this package.
"""

from __future__ import annotations

import numpy as np

from mbn_marl.compiled.jit import compiled
from mbn_marl.compiled.rng import FOR_FAILURES, stream_of, uniform
from mbn_marl.compiled.scalars import clip, select
from mbn_marl.engine.mdp.disturbances import wind_along
from mbn_marl.engine.mdp.drawn import is_failing_step, limits_in, numbers_of
from mbn_marl.engine.mdp.dynamics import (
    has_heading,
    limits_of,
    next_position,
    next_velocity,
    part_along,
    propose_move,
)

BRAKE, COAST, VANISH = range(3)
KINDS = {"brake": BRAKE, "coast": COAST, "vanish": VANISH}


@compiled
def has_failed(failed, i, w):
    """Return whether robot i of world w has failed."""
    if failed.ndim == 2:
        return failed[i, w]
    return False


@compiled
def is_gone(p, failed, i, w):
    """Return whether robot i of world w has vanished."""
    return has_failed(failed, i, w) & (p.failure_kind == VANISH)


@compiled
def count_failed(failed, w):
    """How many robots of world w have failed."""
    count = 0
    for i in range(failed.shape[0]):
        count += failed[i, w]
    return count


@compiled
def repair(failed, w):
    """Begin an episode of world w: all robots work."""
    if failed.ndim == 2:
        for i in range(failed.shape[0]):
            failed[i, w] = False


@compiled
def fail(p, g, mem, failed, now, to, i, lo, hi):
    """Before the action: robot i fails if this is its step, or by chance while few enough have.

    Its impulse, which the action may change, is kept in ``to.own`` and ``to.share``.
    """
    n, drawn = failed.shape[0], now.drawn
    for w in range(lo, hi):
        step = now.steps[w]
        number = uniform(stream_of(mem.key[w], FOR_FAILURES), step * n + i)
        by_chance = number < np.float32(numbers_of(p, drawn, w).failure_rate)
        by_chance &= count_failed(failed, w) < p.most_failures
        due = (step + 1 == g.fail_at[i]) | is_failing_step(drawn, i, step + 1, w)
        failed[i, w] |= by_chance | due
        to.own[w - lo] = now.impulse_x[i, w]
        to.share[w - lo] = now.impulse_y[i, w]


@compiled
def failed_velocity(p, velocity, brake, wind, v_clip):
    """The next velocity of a failed robot, along an axis or its heading."""
    slower = velocity - clip(velocity, -brake, brake)
    blown = next_velocity(velocity, p.zero, p.one, wind, v_clip)
    moving = select(p.failure_kind == BRAKE, slower, blown)
    return select(p.failure_kind == VANISH, p.zero, moving)


@compiled
def move_failed(p, g, kinds, failed, now, to, i, lo, hi):
    """Steps 1 and 2 of robot i where it has failed, after ``fail`` and the move that it lost."""
    limits, drawn, gust = limits_of(g, i), now.drawn, now.gust
    for w in range(lo, hi):
        if failed[i, w]:
            k, q = w - lo, numbers_of(p, drawn, w)
            mass, f_max, v_clip = limits_in(limits, drawn, i, w)
            brake = f_max / mass
            vx, vy = now.vx[i, w], now.vy[i, w]
            wind_x, wind_y = wind_along(q, gust, 0, w), wind_along(q, gust, 1, w)
            if kinds.ndim == 1 and has_heading(kinds[i]):
                cos, sin = now.cos[i, w], now.sin[i, w]
                wind = part_along(wind_x, wind_y, cos, sin)
                speed = failed_velocity(p, part_along(vx, vy, cos, sin), brake, wind, v_clip)
                vx, vy = speed * cos, speed * sin
                to.heading[k], to.cos[k], to.sin[k] = now.heading[i, w], cos, sin
            else:
                vx = failed_velocity(p, vx, brake, wind_x, v_clip)
                vy = failed_velocity(p, vy, brake, wind_y, v_clip)
            to.vx[k], to.vy[k] = vx, vy
            to.x[k] = next_position(now.x[i, w], vx, q.tau)
            to.y[k] = next_position(now.y[i, w], vy, q.tau)
            now.impulse_x[i, w], now.impulse_y[i, w] = to.own[k], to.share[k]


@compiled
def move_or_fail(p, g, mem, failed, now, to, actions, i, lo, hi):
    """Steps 1 and 2 of robot i, which may fail before its action."""
    if failed.ndim == 2:
        fail(p, g, mem, failed, now, to, i, lo, hi)
        propose_move(p, g, now, to, actions, i, lo, hi)
        move_failed(p, g, g.kinds, failed, now, to, i, lo, hi)
    else:
        propose_move(p, g, now, to, actions, i, lo, hi)


@compiled
def put_flag(failed, lo, hi, i, tile, k):
    """Write robot i's flag of ``failed`` as entry k; return the number of entries, 0 or 1."""
    if failed.ndim == 2:
        for w in range(lo, hi):
            tile[k, w - lo] = failed[i, w]
        return 1
    return 0


@compiled
def put_other_flag(p, failed, lo, hi, j, tile, first, k):
    """As ``put_flag``, of robot j; if it has vanished, blank its entries from ``first`` on."""
    if failed.ndim == 2 and p.failure_kind == VANISH:
        for w in range(lo, hi):
            there = p.zero if failed[j, w] else p.one
            for entry in range(first, k):
                tile[entry, w - lo] *= there
    return put_flag(failed, lo, hi, j, tile, k)
