"""Robots that fail during an episode, or are not in the team (failures.md, fields.md)."""

# Source: this package.

import numpy as np

from mbn_marl.config import MAX_ROBOTS
from mbn_marl.engine.mdp.disturbances import wind_along
from mbn_marl.engine.mdp.drawn_numbers import is_failing_step, limits_in, limits_of, numbers_of
from mbn_marl.engine.mdp.dynamics import go, has_heading, next_velocity, part_along
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.features import Feature
from mbn_marl.jit.functions import clip, select
from mbn_marl.jit.random_numbers import FOR_FAILURES, stream_of, uniform

# The status of a robot; an absent one is not in the team of its world.
WORKS, FAILED, ABSENT = range(3)
BRAKE, COAST, VANISH = range(3)
KINDS = {"brake": BRAKE, "coast": COAST, "vanish": VANISH}

# On if some robots may not work: those that fail, or are not in the team.
may_rest = Feature(lambda ep: ep.status.ndim == 2)


@compiled
def status_of(ep, i, w):
    if may_rest(ep):
        return ep.status[i, w]
    return WORKS


@compiled
def is_gone(p, ep, i, w):
    if may_rest(ep):
        vanished = (ep.status[i, w] == FAILED) & (p.failure_kind == VANISH)
        return vanished | (ep.status[i, w] == ABSENT)
    return False


@compiled
def count_status(ep, status, w):
    found = 0
    for i in range(ep.status.shape[0]):
        found += select(ep.status[i, w] == status, 1, 0)
    return found


@compiled
def begin_status(ep, team, w):
    if may_rest(ep):
        for i in range(ep.status.shape[0]):
            ep.status[i, w] = select(i < team, WORKS, ABSENT)


@compiled
def fail(p, g, mem, now, to, i, lo, hi):
    """Before the action: robot i fails if this is its step, or by chance while few enough have."""
    # The action may change the impulse: what it was is kept here, and put back by ``move_failed``.
    for w in range(lo, hi):
        to.own[w - lo] = now.impulse_x[i, w]
        to.share[w - lo] = now.impulse_y[i, w]
    if g.team.fail_at.shape[0] == 0:  # robots are only absent
        return
    for w in range(lo, hi):
        step = now.steps[w]
        number = uniform(stream_of(mem.key[w], FOR_FAILURES), step * MAX_ROBOTS + i)
        by_chance = number < np.float32(numbers_of(p, now, w).failure_rate)
        all_but_one = now.status.shape[0] - count_status(now, ABSENT, w) - 1
        most = select(p.most_failures < 0, all_but_one, p.most_failures)
        by_chance &= count_status(now, FAILED, w) < most
        due = (step + 1 == g.team.fail_at[i]) | is_failing_step(now, i, step + 1, w)
        fails = (by_chance | due) & (now.status[i, w] == WORKS)
        now.status[i, w] = select(fails, FAILED, now.status[i, w])


@compiled
def failed_velocity(p, velocity, brake, wind, v_clip):
    slower = velocity - clip(velocity, -brake, brake)
    blown = next_velocity(velocity, p.zero, p.one, wind, v_clip)
    return select(p.failure_kind == BRAKE, slower, blown)


@compiled
def move_failed(p, g, now, to, i, lo, hi):
    """Steps 1 and 2 of robot i where it does not work, after ``fail`` and the move that it lost."""
    limits = limits_of(g, i)
    for w in range(lo, hi):
        if now.status[i, w] != WORKS:
            k, q = w - lo, numbers_of(p, now, w)
            mass, f_max, v_clip = limits_in(limits, now, i, w)
            brake = f_max / mass
            vx, vy = now.vx[i, w], now.vy[i, w]
            wind_x, wind_y = wind_along(q, now, 0, w), wind_along(q, now, 1, w)
            if has_heading(g, i):
                cos, sin = now.cos[i, w], now.sin[i, w]
                wind = part_along(wind_x, wind_y, cos, sin)
                speed = failed_velocity(p, part_along(vx, vy, cos, sin), brake, wind, v_clip)
                vx, vy = speed * cos, speed * sin
                to.heading[k], to.cos[k], to.sin[k] = now.heading[i, w], cos, sin
            else:
                vx = failed_velocity(p, vx, brake, wind_x, v_clip)
                vy = failed_velocity(p, vy, brake, wind_y, v_clip)
            gone = is_gone(p, now, i, w)
            go(q, now, to, i, w, k, select(gone, p.zero, vx), select(gone, p.zero, vy))
            now.impulse_x[i, w], now.impulse_y[i, w] = to.own[k], to.share[k]


@compiled
def put_flag(ep, lo, hi, i, tile, k):
    """Write as entry k whether robot i does not work; return the number of entries, 0 or 1."""
    if may_rest(ep):
        for w in range(lo, hi):
            tile[k, w - lo] = ep.status[i, w] != WORKS
        return 1
    return 0


@compiled
def blank_gone(p, view, lo, hi, j, first, end):
    ep = view.ep
    if may_rest(ep) and p.some_gone:
        for entry in range(first, end):
            for w in range(lo, hi):
                view.tile[entry, w - lo] *= select(is_gone(p, ep, j, w), p.zero, p.one)


@compiled
def blank_absent(p, view, lo, hi):
    ep = view.ep
    if may_rest(ep) and p.teams_vary:
        for entry in range(view.tile.shape[0]):
            for w in range(lo, hi):
                absent = ep.status[view.i, w] == ABSENT
                view.tile[entry, w - lo] *= select(absent, p.zero, p.one)
