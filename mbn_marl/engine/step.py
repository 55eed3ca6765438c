"""One step of a block of worlds on the CPU: passes over the block, worlds innermost."""

# Each pass applies one scalar rule to every world of the block, so its loop is branch-free and LLVM
# turns it into vector instructions; a block is small enough to stay in the first-level cache from
# pass to pass. Nothing is shared between worlds: neither the block size nor the thread changes a
# result.
#
# Short names, here and in ``mdp``: p are the constants (``constants.Constants``), g is the
# geometry, mem the memory, now or ep an episode, out the output (``state``), to the scratch below;
# a pass is on worlds lo to hi - 1, of which w is number k = w - lo of the block; i and j count
# robots or ROIs.
#
# Numba compiles ``step_worlds`` into machine code, and every function marked ``@compiled`` into
# those that call it. ``if may_rest(now):`` and the like ask for a feature of the whole engine; the
# types of the arguments answer while Numba compiles, so code of what is off is not even there.
#
# Two packed words say what happened, so that rewards need nothing else: ``out.events[i, w]`` has
# flags of robot i (WALL, REVISIT, STILL) and above them how many ROIs it visited,
# ``out.outcomes[w]`` has those of world w (SUCCESS, COLLISION, ...).

import math
from typing import Any, NamedTuple

import numpy as np

from mbn_marl.engine.arguments import call_reset, worlds_of
from mbn_marl.engine.mdp import events, failures, revisits, rewards
from mbn_marl.engine.mdp.disturbances import change_gust, disturbs_actions, send
from mbn_marl.engine.mdp.drawn_numbers import numbers_of
from mbn_marl.engine.mdp.dynamics import keep_heading, propose_move
from mbn_marl.engine.mdp.failures import ABSENT, may_rest, status_of
from mbn_marl.engine.mdp.kinds import is_mine
from mbn_marl.engine.mdp.knowledge import learn
from mbn_marl.engine.mdp.observations import observe
from mbn_marl.engine.mdp.rewards import FORMAL, RELEASED
from mbn_marl.engine.reset import ENDED, RESTARTS, clear_output, copy_episode
from mbn_marl.jit.compile import compiled, entry_point, returning_views
from mbn_marl.jit.functions import clip, column, is_set, select
from mbn_marl.jit.intrinsics import prefetch

# Worlds per block.
BLOCK = 256

# Indices of worlds are unsigned, which spares the loops Python's negative indexing.
ZERO, ONE = np.uint64(0), np.uint64(1)
NOWHERE = np.float32(np.nan)
SAME_STEP, NEXT_STEP = 1, 2


class Scratch(NamedTuple):
    """Intermediate results of the passes over a block, one entry per world of the block."""

    x: Any  # real: where robot i would go, and with which velocity
    y: Any
    vx: Any
    vy: Any
    heading: Any  # real: the heading there, its cosine and its sine, if the robot has one
    cos: Any
    sin: Any
    own: Any  # real: the robots' own rewards, summed
    share: Any  # real: a robot's reward
    crossings: Any  # int32: see events.cross_edge
    maybe: Any  # bool: the filter may know the position
    restarts: Any  # bool
    collided: Any  # bool
    place: Any  # (n, block) uint64: the positions' words and bits in the filter
    mask: Any  # (n, block) uint64
    tile: Any  # (observation size, block) float32


@returning_views
def scratch_of(reals, crossings, flags, keys, tile):
    move, ahead = (reals[0], reals[1], reals[2], reals[3]), (reals[4], reals[5], reals[6])
    sums, filters = (reals[7], reals[8]), (flags[0], flags[1], flags[2], keys[0], keys[1])
    return Scratch(*move, *ahead, *sums, crossings, *filters, tile)


def make_scratch(worlds: int, n: int, entries: int, real: Any) -> Scratch:
    size = min(worlds, BLOCK)
    reals = np.empty((9, size), real)
    flags = np.empty((3, size), np.bool_)
    keys = np.empty((2, n, size), np.uint64)
    tile = np.empty((entries, size), np.float32)
    return Scratch._make([*reals, np.empty(size, np.int32), *flags, *keys, tile])


@compiled
def test_containment(g, to, lo, hi):
    """Step 2: find which candidates are in the field: ``crossings`` is not zero there."""
    edges, crossings = g.field.edges, to.crossings
    for k in range(hi - lo):
        crossings[k] = 0
    for e in range(edges.shape[1]):
        # The edges of a field that all worlds share are read once, and stay in registers.
        if edges.shape[2] == 1:
            ax, ay, bx, by = edges[0, e, 0], edges[1, e, 0], edges[2, e, 0], edges[3, e, 0]
            for k in range(hi - lo):
                crossings[k] = events.cross_edge(crossings[k], to.x[k], to.y[k], ax, ay, bx, by)
        else:
            for k in range(hi - lo):
                f = lo + k
                ax, ay, bx, by = edges[0, e, f], edges[1, e, f], edges[2, e, f], edges[3, e, f]
                crossings[k] = events.cross_edge(crossings[k], to.x[k], to.y[k], ax, ay, bx, by)


@compiled
def stop_at_walls(p, now, out, to, i, lo, hi):
    """Steps 2 and 3: go there, or stop at the wall; then the arena."""
    for w in range(lo, hi):
        k = w - lo
        x, y = now.x[i, w], now.y[i, w]
        inside = to.crossings[k] != 0
        # Adding 0 turns -0 into 0: positions are also compared by their bits.
        new_x = clip(select(inside, to.x[k], x), p.zero, p.arena_x) + p.zero
        new_y = clip(select(inside, to.y[k], y), p.zero, p.arena_y) + p.zero
        now.x[i, w] = new_x
        now.y[i, w] = new_y
        to.x[k] = new_x - x
        to.y[k] = new_y - y
    for w in range(lo, hi):
        k = w - lo
        inside = to.crossings[k] != 0
        now.vx[i, w] = select(inside, to.vx[k], p.zero)
        now.vy[i, w] = select(inside, to.vy[k], p.zero)
        counts = (not inside) & (status_of(now, i, w) == failures.WORKS)
        now.wall_hits[i, w] += 1 if counts else 0
        out.events[i, w] = rewards.WALL if counts else 0
    for w in range(lo, hi):
        k = w - lo
        now.path_length[i, w] += math.sqrt(to.x[k] * to.x[k] + to.y[k] * to.y[k])
        still = (to.x[k] == 0) & (to.y[k] == 0)
        out.events[i, w] |= rewards.STILL if still else 0


@compiled
def mark_visits(p, g, now, out, i, lo, hi):
    """Step 5: every unvisited ROI within reach becomes visited, to robot i's credit."""
    field = g.field
    for j in range(field.rois.shape[1]):
        for w in range(lo, hi):
            f = column(field, w)
            bit = field.roi_bits[j, f]
            dx, dy = now.x[i, w] - field.rois[0, j, f], now.y[i, w] - field.rois[1, j, f]
            near = events.within(dx, dy, numbers_of(p, now, w).roi_squared)
            near &= is_mine(g, i, j, w) & (not failures.is_gone(p, now, i, w))
            new = near & ((now.visited[w] & bit) == 0)
            now.visited[w] |= bit if new else 0
            # The upper bits of the event word count ROIs, so adding leaves the flags alone.
            out.events[i, w] += (1 << rewards.ROIS_SHIFT) if new else 0


@compiled
def record_positions(mem, now, lo, hi):
    n = np.uint64(now.x.shape[0])
    last = np.uint64(mem.trail.shape[1]) - n
    for i in range(n):
        for w in range(lo, hi):
            entry = min(np.uint64(now.steps[w] + 1) * n, last) + i
            mem.trail[w, entry, 0] = now.x[i, w]
            mem.trail[w, entry, 1] = now.y[i, w]
            if status_of(now, i, w) == ABSENT:
                mem.trail[w, entry, 0] = NOWHERE
                mem.trail[w, entry, 1] = NOWHERE


@compiled
def hash_positions(mem, now, out, to, i, lo, hi):
    """Step 4, first half: find the bits of the filter for robot i's position, and fetch them."""
    # A robot that did not move is known without looking; one that is absent leaves none.
    events, place, mask = out.events, to.place, to.mask
    for w in range(lo, hi):
        key = revisits.hash_position(mem.x_bits[i, w], mem.y_bits[i, w])
        known = is_set(events[i, w], rewards.STILL) & (now.steps[w] > 0)
        known |= status_of(now, i, w) == ABSENT
        place[i, w - lo] = select(known, ZERO, revisits.filter_word(key, mem.words[w]))
        mask[i, w - lo] = select(known, ZERO, revisits.filter_mask(key))
        events[i, w] |= select(known, rewards.REVISIT, 0)
    # The filters of many worlds are larger than the cache: what the second half of step 4 reads is
    # fetched here, and comes while observations are written.
    for w in range(lo, hi):
        prefetch(mem.filter, w, place[i, w - lo])


@compiled
def pass_time(p, g, mem, now, lo, hi):
    for w in range(lo, hi):
        now.steps[w] += 1
    learn(p, g, mem, now, lo, hi)
    change_gust(p, mem, now, lo, hi)


@compiled
def mark_revisits(mem, now, out, to, i, lo, hi):
    """Step 4: was any robot where robot i is, before in this episode? From now on one was."""
    n = np.uint64(now.x.shape[0])
    place, mask, maybe = to.place, to.mask, to.maybe
    for w in range(lo, hi):
        k = w - lo
        bits = mask[i, k]
        maybe[k] = revisits.add_bits(mem.filter, w, place[i, k], bits) & (bits != ZERO)
    # Few are left, so this loop may branch. It compares exactly; the filter only rules out.
    for w in range(lo, hi):
        if maybe[w - lo] & ~mem.pending[w]:
            entry = np.uint64(now.steps[w]) * n + np.uint64(i)
            if revisits.stood_on(mem.trail, mem.trail_key, w, n, entry):
                out.events[i, w] |= rewards.REVISIT


@compiled
def grow_filter(mem, now, lo, hi):
    """Give worlds whose filter has become too small for the next step a larger one."""
    # A filter starts at 256 bytes and doubles as its episode gets longer: so short episodes touch
    # little memory, and that, not arithmetic, is what limits a large batch. A world that waits has
    # no next step: its trail and its filter are as long as can be.
    n = now.x.shape[0]
    for w in range(lo, hi):
        keys = (now.steps[w] + 1) * n
        small = mem.words[w] * revisits.KEYS_PER_WORD < np.uint64(keys)
        if small & ~mem.pending[w]:
            mem.words[w] *= np.uint64(2)
            revisits.refill_filter(mem.filter, mem.trail_bits, w, n, keys, mem.words[w])


@compiled
def find_collisions(p, now, to, lo, hi):
    for k in range(hi - lo):
        to.collided[k] = False
    for i in range(now.x.shape[0]):
        for j in range(i):
            for w in range(lo, hi):
                dx, dy = now.x[i, w] - now.x[j, w], now.y[i, w] - now.y[j, w]
                there = not (failures.is_gone(p, now, i, w) | failures.is_gone(p, now, j, w))
                near = events.too_close(dx, dy, numbers_of(p, now, w).safety_squared)
                to.collided[w - lo] |= near & there


@compiled
def check_termination(p, g, mem, now, out, to, lo, hi):
    """Steps 6 to 8: how the step ended, as outcome bits and flags."""
    everything = events.all_visited(g.field.rois.shape[1])
    for w in range(lo, hi):
        success = now.visited[w] == everything
        lost = to.collided[w - lo]
        outcome = (rewards.SUCCESS if success else 0) | (rewards.COLLISION if lost else 0)
        # Both flags stay apart up to the learner: the value of the last state follows an episode
        # that the time limit cut off, 0 follows one that ended by itself.
        ended = events.is_terminated(success, lost)
        out.terminated[w] = ended
        out.truncated[w] = events.is_truncated(now.steps[w], p.max_steps, ended)
        out.outcomes[w] = outcome
    if p.rules == FORMAL:
        for w in range(lo, hi):
            for i in range(now.x.shape[0]):
                if (out.events[i, w] & rewards.WALL) != 0:
                    out.outcomes[w] |= rewards.ANY_OUTSIDE
            code = events.visit_code(now.visited[w], g.field.codes[column(g.field, w)])
            if revisits.joint_state_known(mem, now, w, code):
                out.outcomes[w] |= rewards.KNOWN_STATE


@compiled
def give_rewards(p, now, out, to, lo, hi):
    n = now.x.shape[0]
    own, share = to.own, to.share
    for k in range(hi - lo):
        own[k] = p.zero
    for i in range(n):
        for w in range(lo, hi):
            terms = rewards.earned(p, now, out.events[i, w], out.outcomes[w], i, w)
            own[w - lo] += rewards.total_own(terms)
            both = rewards.with_share(p, now, terms, out.outcomes[w], i, w)
            share[w - lo] = rewards.total(both)
        for w in range(lo, hi):
            out.rewards[w, i] = share[w - lo]
            now.returns[i, w] += share[w - lo]
    for w in range(lo, hi):
        value = rewards.team_reward(p, out.outcomes[w], own[w - lo])
        out.team_rewards[w] = value
        now.team_return[w] += value
    if p.team_sharing:
        for i in range(n):
            for w in range(lo, hi):
                given = select(status_of(now, i, w) == ABSENT, p.zero, out.team_rewards[w])
                now.returns[i, w] += given - out.rewards[w, i]
                out.rewards[w, i] = given


@compiled
def close_step(p, mem, out, w):
    """Return the bits ``ENDED`` and ``RESTARTS`` of the change of world w's episode."""
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
def autoreset(arguments, lo, hi):
    """Reset worlds whose episode has ended, if they restart; return how many have ended."""
    p, _, mem, now, final, out, to = worlds_of(arguments)
    ended, some = 0, False
    pending, terminated, truncated = mem.pending, out.terminated, out.truncated
    observations, finals = out.observations, out.final_observations
    for w in range(lo, hi):
        to.restarts[w - lo] = False
        if not (pending[w] | terminated[w] | truncated[w]):
            continue
        change = close_step(p, mem, out, w)
        ended += change & ENDED
        if change == ENDED | RESTARTS:
            # The reset is about to write over the last observation, which a learner needs for the
            # value of the state that an episode was cut off in.
            for i in range(observations.shape[1]):
                for entry in range(observations.shape[2]):  # a slice takes long to compile
                    finals[w, i, entry] = observations[w, i, entry]
            copy_episode(now, w, final, w, now.x.shape[0], p.headings)
        to.restarts[w - lo] = (change & RESTARTS) != 0
        some |= to.restarts[w - lo]
    # By its address, so that a reset is not compiled a second time as a part of the step.
    if some:
        call_reset(arguments, to.restarts, np.int64(lo), np.int64(hi))
    return ended


@compiled
def move_robots(p, g, mem, now, out, to, actions, lo, hi):
    """Steps 1 to 3 and 5: each robot goes where it can, and visits; then the time passes."""
    taken = actions
    if disturbs_actions(now):
        send(p, mem, now, actions, lo, hi)
        taken = mem.acted
    for i in range(now.x.shape[0]):
        if may_rest(now):
            failures.fail(p, g, mem, now, to, i, lo, hi)
        propose_move(p, g, now, to, taken, i, lo, hi)
        if may_rest(now):
            failures.move_failed(p, g, now, to, i, lo, hi)
        test_containment(g, to, lo, hi)
        stop_at_walls(p, now, out, to, i, lo, hi)
        keep_heading(g, now, to, i, lo, hi)
        mark_visits(p, g, now, out, i, lo, hi)
    if p.rules == RELEASED:
        record_positions(mem, now, lo, hi)
        for i in range(now.x.shape[0]):
            hash_positions(mem, now, out, to, i, lo, hi)
    pass_time(p, g, mem, now, lo, hi)


@compiled
def score_step(p, g, mem, now, out, to, lo, hi):
    """Steps 4 and 6 to 8: revisits, collisions, how the step ended, rewards."""
    if p.rules == RELEASED:
        for i in range(now.x.shape[0]):
            mark_revisits(mem, now, out, to, i, lo, hi)
    find_collisions(p, now, to, lo, hi)
    check_termination(p, g, mem, now, out, to, lo, hi)
    give_rewards(p, now, out, to, lo, hi)
    if p.rules == RELEASED:
        grow_filter(mem, now, lo, hi)


@entry_point
def step_worlds(arguments, actions, first, end):
    """Step worlds ``first`` to ``end - 1``, a block at a time; return how many episodes ended."""
    p, g, mem, now, _, out, to = worlds_of(arguments)
    lo, ended = np.uint64(first), 0
    while lo < np.uint64(end):
        hi = min(lo + np.uint64(BLOCK), np.uint64(end))
        move_robots(p, g, mem, now, out, to, actions, lo, hi)
        # No observation depends on a reward. Written here, observations give the filter's words,
        # which ``move_robots`` has begun to fetch and ``score_step`` reads, the time to arrive.
        observe(p, g, mem, now, lo, hi, to.tile, out.observations)
        score_step(p, g, mem, now, out, to, lo, hi)
        ended += autoreset(arguments, lo, hi)
        lo = hi
    return ended
