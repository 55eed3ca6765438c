"""One step of a block of worlds on the CPU: passes over the block, worlds innermost.

Each pass applies one scalar rule to every world of the block, so its loop is branch-free and LLVM
turns it into vector instructions; a block is small enough to stay in the first-level cache from
pass to pass. Nothing is shared between worlds: neither the block size nor the thread changes a
result. World indices are unsigned, which spares the loop Python's negative indexing. Where a loop's
rule branches, arrays are named before it: taken from their tuple inside it, they would be counted
as references at each turn.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from mbn_marl.engine import rules
from mbn_marl.engine.compiling import compiled, entry_point
from mbn_marl.engine.constants import unpack
from mbn_marl.engine.memory import (
    KEYS_PER_WORD,
    add_bits,
    filter_mask,
    filter_word,
    hash_position,
    refill_filter,
    stood_on,
)
from mbn_marl.engine.observation import column, observe, visit_code
from mbn_marl.engine.prefetch import prefetch
from mbn_marl.engine.reset import clear_output, finish_world, joint_state_known, reset_world
from mbn_marl.engine.rewards import (
    ANY_OUTSIDE,
    COLLISION,
    FORMAL,
    KNOWN_STATE,
    RELEASED,
    REVISIT,
    ROIS_SHIFT,
    STILL,
    SUCCESS,
    WALL,
    is_set,
    own_terms,
    robot_terms,
    team_reward,
    total,
)

BLOCK = 256
"""Worlds per block."""

ZERO, ONE = np.uint64(0), np.uint64(1)
SAME_STEP, NEXT_STEP = 1, 2
ENDED, RESTARTS = 1, 2


class Scratch(NamedTuple):
    """What the passes over a block hand to each other, one entry per world of the block."""

    x: Any  # real: where robot i would go, and with which velocity
    y: Any
    vx: Any
    vy: Any
    own: Any  # real: the robots' own rewards, summed
    share: Any  # real: a robot's reward
    seen: Any  # int32: see rules.cross_edge
    maybe: Any  # bool: the filter may know the position
    collided: Any  # bool
    place: Any  # (n, block) uint64: the positions' words and bits in the filter
    mask: Any  # (n, block) uint64
    tile: Any  # (observation size, block) float32


@compiled
def make_scratch(size, n, entries, real):
    """Scratch for a block of at most ``size`` worlds whose observations have ``entries``."""
    reals = np.empty((6, size), real)
    flags = np.empty((2, size), np.bool_)
    keys = np.empty((2, n, size), np.uint64)
    return Scratch(
        reals[0],
        reals[1],
        reals[2],
        reals[3],
        reals[4],
        reals[5],
        np.empty(size, np.int32),
        flags[0],
        flags[1],
        keys[0],
        keys[1],
        np.empty((entries, size), np.float32),
    )


@compiled
def accelerate(p, g, now, to, actions, i, lo, hi):
    """Steps 1 and 2: the new velocity, and where it would take robot i."""
    mass = g.masses[i]
    for w in range(lo, hi):
        fx = rules.force(actions[w, i, 0], p.f_max, p.one)
        fy = rules.force(actions[w, i, 1], p.f_max, p.one)
        vx = rules.next_velocity(now.vx[i, w], fx, mass, p.wind_x, p.v_clip)
        vy = rules.next_velocity(now.vy[i, w], fy, mass, p.wind_y, p.v_clip)
        to.vx[w - lo] = vx
        to.vy[w - lo] = vy
        to.x[w - lo] = rules.next_position(now.x[i, w], vx, p.tau)
        to.y[w - lo] = rules.next_position(now.y[i, w], vy, p.tau)
        now.impulse_x[i, w] += fx * p.tau
        now.impulse_y[i, w] += fy * p.tau


@compiled
def contain(g, to, lo, hi):
    """Whether the candidates are in the field: ``seen`` is not zero there."""
    edges = g.edges
    for k in range(hi - lo):
        to.seen[k] = 0
    for e in range(edges.shape[1]):
        if edges.shape[2] == 1:
            ax, ay, bx, by = edges[0, e, 0], edges[1, e, 0], edges[2, e, 0], edges[3, e, 0]
            for k in range(hi - lo):
                to.seen[k] = rules.cross_edge(to.seen[k], to.x[k], to.y[k], ax, ay, bx, by)
        else:
            for k in range(hi - lo):
                f = lo + k
                ax, ay, bx, by = edges[0, e, f], edges[1, e, f], edges[2, e, f], edges[3, e, f]
                to.seen[k] = rules.cross_edge(to.seen[k], to.x[k], to.y[k], ax, ay, bx, by)


@compiled
def move(p, now, out, to, i, lo, hi):
    """Steps 2 and 3: go there, or stop at the wall; then the arena."""
    for w in range(lo, hi):
        k = w - lo
        x, y = now.x[i, w], now.y[i, w]
        inside = to.seen[k] != 0
        new_x = rules.clip(rules.select(inside, to.x[k], x), p.zero, p.arena_x) + p.zero
        new_y = rules.clip(rules.select(inside, to.y[k], y), p.zero, p.arena_y) + p.zero
        now.x[i, w] = new_x
        now.y[i, w] = new_y
        to.x[k] = new_x - x
        to.y[k] = new_y - y
    for w in range(lo, hi):
        k = w - lo
        inside = to.seen[k] != 0
        now.vx[i, w] = rules.select(inside, to.vx[k], p.zero)
        now.vy[i, w] = rules.select(inside, to.vy[k], p.zero)
        now.wall_hits[i, w] += 0 if inside else 1
        out.events[i, w] = 0 if inside else WALL
    for w in range(lo, hi):
        k = w - lo
        now.path_length[i, w] += math.sqrt(to.x[k] * to.x[k] + to.y[k] * to.y[k])
        still = (to.x[k] == 0) & (to.y[k] == 0)
        out.events[i, w] |= STILL if still else 0


@compiled
def visit(p, g, now, out, i, lo, hi):
    """Step 5: every unvisited ROI within reach becomes visited, to robot i's credit."""
    for j in range(g.rois.shape[1]):
        for w in range(lo, hi):
            f = column(g, w)
            bit = g.roi_bits[j, f]
            dx, dy = now.x[i, w] - g.rois[0, j, f], now.y[i, w] - g.rois[1, j, f]
            near = rules.within(dx, dy, p.roi_squared)
            new = near & ((now.visited[w] & bit) == 0)
            now.visited[w] |= bit if new else 0
            out.events[i, w] += (1 << ROIS_SHIFT) if new else 0


@compiled
def record(mem, now, lo, hi):
    """Append the robots' positions to the trails."""
    n = np.uint64(now.x.shape[0])
    last = np.uint64(mem.trail.shape[1]) - n
    for i in range(n):
        for w in range(lo, hi):
            entry = min(np.uint64(now.steps[w] + 1) * n, last) + i
            mem.trail[w, entry, 0] = now.x[i, w]
            mem.trail[w, entry, 1] = now.y[i, w]


@compiled
def recall(mem, now, out, to, i, lo, hi):
    """Step 4, first half: which bits of the filter stand for robot i's position; fetch them.

    A robot that did not move is known without looking.
    """
    events, place, mask = out.events, to.place, to.mask
    for w in range(lo, hi):
        key = hash_position(mem.x_bits[i, w], mem.y_bits[i, w])
        known = is_set(events[i, w], STILL) & (now.steps[w] > 0)
        place[i, w - lo] = rules.select(known, ZERO, filter_word(key, mem.words[w]))
        mask[i, w - lo] = rules.select(known, ZERO, filter_mask(key))
        events[i, w] |= rules.select(known, REVISIT, 0)
    for w in range(lo, hi):
        prefetch(mem.filter, w, place[i, w - lo])


@compiled
def remember(mem, now, out, to, i, lo, hi):
    """Step 4: was any robot here before in this episode? From now on one was."""
    n = np.uint64(now.x.shape[0])
    place, mask, maybe = to.place, to.mask, to.maybe
    for w in range(lo, hi):
        k = w - lo
        bits = mask[i, k]
        maybe[k] = add_bits(mem.filter, w, place[i, k], bits) & (bits != ZERO)
    for w in range(lo, hi):
        if maybe[w - lo]:
            entry = np.uint64(now.steps[w] + 1) * n + np.uint64(i)
            if stood_on(mem.trail, mem.trail_key, w, n, entry):
                out.events[i, w] |= REVISIT


@compiled
def grow(mem, now, lo, hi):
    """Give worlds whose filter has become too small for the next step a larger one."""
    n = now.x.shape[0]
    for w in range(lo, hi):
        keys = (now.steps[w] + 1) * n
        if mem.words[w] * KEYS_PER_WORD < np.uint64(keys):
            mem.words[w] *= np.uint64(2)
            end = (now.steps[w] + 1) * n
            refill_filter(mem.filter, mem.trail_bits, w, n, end, mem.words[w])


@compiled
def collide(p, now, to, lo, hi):
    """Step 7: any two robots closer than the safety distance."""
    for k in range(hi - lo):
        to.collided[k] = False
    for i in range(now.x.shape[0]):
        for j in range(i):
            for w in range(lo, hi):
                dx, dy = now.x[i, w] - now.x[j, w], now.y[i, w] - now.y[j, w]
                to.collided[w - lo] |= rules.too_close(dx, dy, p.safety_squared)


@compiled
def judge(p, g, mem, now, out, to, lo, hi):
    """Steps 6 to 8: how the step ended, as outcome bits and flags."""
    everything = (1 << g.rois.shape[1]) - 1
    for w in range(lo, hi):
        success = now.visited[w] == everything
        lost = to.collided[w - lo]
        outcome = (SUCCESS if success else 0) | (COLLISION if lost else 0)
        now.steps[w] += 1
        ended = success | lost
        out.terminated[w] = ended
        out.truncated[w] = (now.steps[w] >= p.max_steps) & (not ended)
        out.outcomes[w] = outcome
    if p.rules == FORMAL:
        for w in range(lo, hi):
            for i in range(now.x.shape[0]):
                if (out.events[i, w] & WALL) != 0:
                    out.outcomes[w] |= ANY_OUTSIDE
            if joint_state_known(mem, now, w, visit_code(g, now.visited[w], w)):
                out.outcomes[w] |= KNOWN_STATE


@compiled
def reward(p, now, out, to, lo, hi):
    """The team's reward and the agents' shares of it."""
    n = now.x.shape[0]
    own, share = to.own, to.share
    for k in range(hi - lo):
        own[k] = p.zero
    for i in range(n):
        for w in range(lo, hi):
            terms = robot_terms(p, out.events[i, w], out.outcomes[w])
            own[w - lo] += own_terms(p, terms)
            share[w - lo] = total(terms)
        for w in range(lo, hi):
            out.rewards[w, i] = share[w - lo]
            now.returns[i, w] += share[w - lo]
    for w in range(lo, hi):
        value = team_reward(p, out.outcomes[w], own[w - lo])
        out.team_rewards[w] = value
        now.team_return[w] += value
    if p.team_sharing:
        for i in range(n):
            for w in range(lo, hi):
                now.returns[i, w] += out.team_rewards[w] - out.rewards[w, i]
                out.rewards[w, i] = out.team_rewards[w]


@compiled
def conclude(p, mem, out, w):
    """What becomes of world w after a step: any of the bits ``ENDED`` and ``RESTARTS``."""
    if mem.pending[w] & (p.autoreset == NEXT_STEP):
        mem.pending[w] = False
        clear_output(p, out, w)
        return RESTARTS
    if out.terminated[w] | out.truncated[w]:
        if p.autoreset == SAME_STEP:
            return ENDED | RESTARTS
        mem.pending[w] = True
        return ENDED
    return 0


@compiled
def settle(p, g, mem, now, final, out, to, lo, hi):
    """Observations, and the automatic reset of worlds whose episode has ended; how many have."""
    ended = 0
    pending, terminated, truncated = mem.pending, out.terminated, out.truncated
    for w in range(lo, hi):
        if not (pending[w] | terminated[w] | truncated[w]):
            continue
        fate = conclude(p, mem, out, w)
        ended += fate & ENDED
        if fate == ENDED | RESTARTS:
            for i in range(now.x.shape[0]):
                for entry in range(out.observations.shape[2]):  # a slice takes long to compile
                    out.final_observations[w, i, entry] = out.observations[w, i, entry]
            finish_world(now, final, w)
        if fate & RESTARTS:
            reset_world(p, g, mem, now, w)
            observe(p, g, now, w, w + ONE, to.tile, out.observations)
    return ended


@compiled
def act(p, g, mem, now, out, to, actions, lo, hi):
    """What every robot does: where it goes, what it visits; its memory is fetched ahead."""
    for i in range(now.x.shape[0]):
        accelerate(p, g, now, to, actions, i, lo, hi)
        contain(g, to, lo, hi)
        move(p, now, out, to, i, lo, hi)
        visit(p, g, now, out, i, lo, hi)
    if p.rules == RELEASED:
        record(mem, now, lo, hi)
        for i in range(now.x.shape[0]):
            recall(mem, now, out, to, i, lo, hi)


@compiled
def assess(p, g, mem, now, out, to, lo, hi):
    """What it all means: revisits, collisions, how the step ended, rewards."""
    if p.rules == RELEASED:
        for i in range(now.x.shape[0]):
            remember(mem, now, out, to, i, lo, hi)
    collide(p, now, to, lo, hi)
    judge(p, g, mem, now, out, to, lo, hi)
    reward(p, now, out, to, lo, hi)
    if p.rules == RELEASED:
        grow(mem, now, lo, hi)


@entry_point
def step_worlds(store, actions, lo, hi):
    """Step worlds ``lo`` to ``hi - 1`` with ``actions`` (W, n, 2); how many ended."""
    p = unpack(store.constants)
    g, mem, now, final, out = store.geometry, store.memory, store.now, store.final, store.output
    block, entries = min(hi - lo, np.uint64(BLOCK)), out.observations.shape[2]
    to = make_scratch(block, now.x.shape[0], entries, now.x.dtype)
    ended = 0
    while lo < hi:
        end = min(lo + np.uint64(BLOCK), hi)
        act(p, g, mem, now, out, to, actions, lo, end)
        observe(p, g, now, lo, end, to.tile, out.observations)
        assess(p, g, mem, now, out, to, lo, end)
        ended += settle(p, g, mem, now, final, out, to, lo, end)
        lo = end
    return ended
