"""Robots that fail during an episode, or are not in the team (mdp.md, "Failures", "Fields").

The status of each robot is an array (n, W) of ``Episode``, of three dimensions and without entries
where no robot can fail or be absent. The functions get it as an argument of its own, so that a
condition on its type leaves their code out there.

Source: this package.
"""

from __future__ import annotations

import numpy as np

from mbn_marl.config import MAX_ROBOTS
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
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.functions import clip, select
from mbn_marl.jit.random_numbers import FOR_FAILURES, stream_of, uniform

WORKS, FAILED, ABSENT = range(3)
"""The status of a robot; an absent one is not in the team of its world."""
BRAKE, COAST, VANISH = range(3)
KINDS = {"brake": BRAKE, "coast": COAST, "vanish": VANISH}


@compiled
def works(status, i, w):
    """Return whether robot i of world w is in the team and has not failed."""
    if status.ndim == 2:
        return status[i, w] == WORKS
    return True


@compiled
def is_absent(status, i, w):
    """Return whether robot i is not in the team of world w."""
    if status.ndim == 2:
        return status[i, w] == ABSENT
    return False


@compiled
def has_failed(status, i, w):
    """Return whether robot i of world w has failed."""
    if status.ndim == 2:
        return status[i, w] == FAILED
    return False


@compiled
def is_gone(p, status, i, w):
    """Return whether robot i of world w has vanished, or is absent."""
    if status.ndim == 2:
        vanished = (status[i, w] == FAILED) & (p.failure_kind == VANISH)
        return vanished | (status[i, w] == ABSENT)
    return False


@compiled
def count(status, which, w):
    """How many robots of world w have a status."""
    found = 0
    for i in range(status.shape[0]):
        found += select(status[i, w] == which, 1, 0)
    return found


@compiled
def begin_status(status, team, w):
    """Begin an episode of world w: the first ``team`` robots work, the others are absent."""
    if status.ndim == 2:
        for i in range(status.shape[0]):
            status[i, w] = select(i < team, WORKS, ABSENT)


@compiled
def fail(p, g, mem, status, now, to, i, lo, hi):
    """Before the action: robot i fails if this is its step, or by chance while few enough have.

    Its impulse, which the action may change, is kept in ``to.own`` and ``to.share``.
    """
    n, drawn = status.shape[0], now.drawn
    for w in range(lo, hi):
        to.own[w - lo] = now.impulse_x[i, w]
        to.share[w - lo] = now.impulse_y[i, w]
    if g.fail_at.shape[0] == 0:  # robots are only absent
        return
    for w in range(lo, hi):
        step = now.steps[w]
        number = uniform(stream_of(mem.key[w], FOR_FAILURES), step * MAX_ROBOTS + i)
        by_chance = number < np.float32(numbers_of(p, drawn, w).failure_rate)
        all_but_one = n - count(status, ABSENT, w) - 1
        most = select(p.most_failures < 0, all_but_one, p.most_failures)
        by_chance &= count(status, FAILED, w) < most
        due = (step + 1 == g.fail_at[i]) | is_failing_step(drawn, i, step + 1, w)
        fails = (by_chance | due) & (status[i, w] == WORKS)
        status[i, w] = select(fails, FAILED, status[i, w])


@compiled
def failed_velocity(p, velocity, brake, wind, v_clip):
    """The next velocity of a failed robot that is there, along an axis or its heading."""
    slower = velocity - clip(velocity, -brake, brake)
    blown = next_velocity(velocity, p.zero, p.one, wind, v_clip)
    return select(p.failure_kind == BRAKE, slower, blown)


@compiled
def move_failed(p, g, kinds, status, now, to, i, lo, hi):
    """Steps 1 and 2 of robot i where it does not work, after ``fail`` and the move that it lost."""
    limits, drawn, gust = limits_of(g, i), now.drawn, now.gust
    for w in range(lo, hi):
        if status[i, w] != WORKS:
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
            gone = is_gone(p, status, i, w)
            vx, vy = select(gone, p.zero, vx), select(gone, p.zero, vy)
            to.vx[k], to.vy[k] = vx, vy
            to.x[k] = next_position(now.x[i, w], vx, q.tau)
            to.y[k] = next_position(now.y[i, w], vy, q.tau)
            now.impulse_x[i, w], now.impulse_y[i, w] = to.own[k], to.share[k]


@compiled
def move_or_fail(p, g, mem, status, now, to, actions, i, lo, hi):
    """Steps 1 and 2 of robot i, which may fail before its action."""
    if status.ndim == 2:
        fail(p, g, mem, status, now, to, i, lo, hi)
        propose_move(p, g, now, to, actions, i, lo, hi)
        move_failed(p, g, g.kinds, status, now, to, i, lo, hi)
    else:
        propose_move(p, g, now, to, actions, i, lo, hi)


@compiled
def put_flag(status, lo, hi, i, tile, k):
    """Write as entry k whether robot i does not work; return the number of entries, 0 or 1."""
    if status.ndim == 2:
        for w in range(lo, hi):
            tile[k, w - lo] = status[i, w] != WORKS
        return 1
    return 0


@compiled
def blank_gone(p, status, lo, hi, j, tile, first, end):
    """Blank the entries ``first`` to ``end - 1``, about robot j, where it is gone."""
    if status.ndim == 2 and p.some_gone:
        for entry in range(first, end):
            for w in range(lo, hi):
                tile[entry, w - lo] *= select(is_gone(p, status, j, w), p.zero, p.one)


@compiled
def blank_absent(p, status, lo, hi, i, tile):
    """Blank all that robot i sees where it is absent."""
    if status.ndim == 2 and p.teams_vary:
        for entry in range(tile.shape[0]):
            for w in range(lo, hi):
                tile[entry, w - lo] *= select(is_absent(status, i, w), p.zero, p.one)
