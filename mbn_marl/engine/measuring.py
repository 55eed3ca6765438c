"""The compiled halves of a step for a world whose robots move elsewhere; see ``measured``."""

from __future__ import annotations

import numpy as np

from mbn_marl.engine import rules
from mbn_marl.engine.compiling import entry_point
from mbn_marl.engine.constants import unpack
from mbn_marl.engine.observation import observe
from mbn_marl.engine.rewards import RELEASED, WALL
from mbn_marl.engine.step import (
    accelerate,
    assess,
    contain,
    make_scratch,
    move,
    recall,
    record,
    settle,
    visit,
)

LO, HI = np.uint64(0), np.uint64(1)
INSIDE = 1


@entry_point
def choose_velocities(store, actions, velocities, allowed):
    """Steps 1 and 2: write the next velocities (1, n, 2), and whether their ends are inside."""
    p = unpack(store.constants)
    g, now = store.geometry, store.now
    n = now.x.shape[0]
    to = make_scratch(HI, n, 1, now.x.dtype)
    for i in range(n):
        accelerate(p, g, now, to, actions, i, LO, HI)
        contain(g, to, LO, HI)
        inside = to.seen[0] != 0
        allowed[i] = inside
        velocities[0, i, 0] = rules.select(inside, to.vx[0], p.zero)
        velocities[0, i, 1] = rules.select(inside, to.vy[0], p.zero)


@entry_point
def judge_positions(store, positions, velocities, allowed):
    """Steps 3 to 8 for robots that came to ``positions`` with ``velocities``, (1, n, 2)."""
    p = unpack(store.constants)
    g, mem, now, final, out = store.geometry, store.memory, store.now, store.final, store.output
    n = now.x.shape[0]
    to = make_scratch(HI, n, out.observations.shape[2], now.x.dtype)
    for i in range(n):
        to.x[0], to.y[0] = positions[0, i, 0], positions[0, i, 1]
        to.vx[0] = rules.clip(velocities[0, i, 0], -p.v_clip, p.v_clip)
        to.vy[0] = rules.clip(velocities[0, i, 1], -p.v_clip, p.v_clip)
        contain(g, to, LO, HI)
        stayed = allowed[i] & (to.seen[0] != 0)
        to.seen[0] = INSIDE
        move(p, now, out, to, i, LO, HI)
        now.wall_hits[i, 0] += 0 if stayed else 1
        out.events[i, 0] |= 0 if stayed else WALL
        visit(p, g, now, out, i, LO, HI)
    if p.rules == RELEASED:
        record(mem, now, LO, HI)
        for i in range(n):
            recall(mem, now, out, to, i, LO, HI)
    observe(p, g, now, LO, HI, to.tile, out.observations)
    assess(p, g, mem, now, out, to, LO, HI)
    return settle(p, g, mem, now, final, out, to, LO, HI)
