"""The compiled entry points that ``BatchEngine`` calls; each takes whole arrays."""

from __future__ import annotations

import numpy as np
from numba import prange

from mbn_marl.engine.mdp import rewards
from mbn_marl.engine.mdp.dynamics import objective
from mbn_marl.engine.mdp.failures import has_failed, is_absent
from mbn_marl.engine.mdp.observations import observe, put_state
from mbn_marl.engine.mdp.visits import visit_code
from mbn_marl.engine.reset import clear_output, reset_world
from mbn_marl.engine.step import SAME_STEP
from mbn_marl.engine.store import parts_of, with_scratch
from mbn_marl.jit.compile import compiled, entry_point, parallel_entry_point
from mbn_marl.jit.functions import count_bits, is_set
from mbn_marl.jit.intrinsics import call_step
from mbn_marl.jit.random_numbers import FOR_ACTIONS, stream_key, uniform, world_number

FIRST, NEXT = np.uint64(0), np.uint64(1)

MEASURES = (
    *("success", "rois_visited", "collision"),
    *("wall_hits", "path_length", "impulse", "failed"),
)
TEAM_MEASURES, TERMS = MEASURES.index("wall_hits"), len(MEASURES)
"""The first measures are the team's, and after all measures come the terms of the reward."""
INFO_COLUMNS = (*MEASURES, *(f"reward/{term}" for term in rewards.REWARD_TERMS))


@entry_point
def all_finite(actions):
    """Return whether all are finite: x * 0 is 0 for exactly those, and the sum keeps any NaN."""
    zero = actions.dtype.type(0)
    bad = False
    for value in actions.flat:
        bad |= value * zero != zero
    return not bad


@parallel_entry_point
def step_ranges(address, store, actions, cuts):
    """Step worlds ``cuts[k]`` to ``cuts[k + 1] - 1`` for every k; return how many ended.

    ``address`` is that of ``step_worlds``, which would otherwise be compiled three times more.
    """
    ended = 0
    for k in prange(cuts.size - 1):
        ended += call_step(address, with_scratch(store, k), actions, cuts[k], cuts[k + 1])
    return ended


@compiled
def reset_masked(store, mask, lo, hi, asked):
    """See :func:`reset_worlds`."""
    p, g, mem, now, _, out, to = parts_of(store)
    for w in range(lo, hi):
        if mask[w - lo]:
            reset_world(p, g, mem, now, w)
            if asked:
                mem.pending[w] = False
                clear_output(p, out, w)
            observe(p, g, mem, now, w, w + NEXT, to.tile, out.observations)


@entry_point
def reset_worlds(store, mask, lo, hi, asked):
    """Begin a new episode in the worlds from ``lo`` to ``hi - 1`` that ``mask`` marks.

    Unless this was ``asked`` for, the outputs of the last step stay.
    """
    reset_masked(store, mask, np.uint64(lo), np.uint64(hi), asked)


@compiled
def rest_masked(store, mask):
    """See :func:`rest_worlds`."""
    p, g, mem, now, _, out, to = parts_of(store)
    for w in range(FIRST, np.uint64(mask.size)):
        if mask[w]:
            mem.pending[w] = True
            for i in range(now.x.shape[0]):
                last = now.steps[w] * now.x.shape[0] + i
                mem.trail[w, last, 0] = now.x[i, w]
                mem.trail[w, last, 1] = now.y[i, w]
            clear_output(p, out, w)
            observe(p, g, mem, now, w, w + NEXT, to.tile, out.observations)


@entry_point
def rest_worlds(store, mask):
    """Make the outputs of the masked worlds those of a step in which nothing happened."""
    rest_masked(store, mask)


@compiled
def put_infos(p, ep, out, w, rows):
    """Write the measures of each robot of world w, in the order of ``INFO_COLUMNS``.

    The row after the robots' has the team's: sums of the robots' own, and the terms of ``R``.
    """
    outcome, status, n = out.outcomes[w], ep.status, ep.x.shape[0]
    rois_visited = count_bits(visit_code(ep.visited[w], ep.codes[w]))
    lost = is_set(outcome, rewards.COLLISION)
    success = is_set(outcome, rewards.SUCCESS) and not lost
    for i in range(n + 1):
        rows[w, i, 0] = success
        rows[w, i, 1] = rois_visited
        rows[w, i, 2] = lost
        for k in range(TEAM_MEASURES, rows.shape[2]):
            rows[w, i, k] = 0.0
    for i in range(n):
        rows[w, i, 3] = ep.wall_hits[i, w]
        rows[w, i, 4] = ep.path_length[i, w]
        rows[w, i, 5] = objective(ep.impulse_x[i, w], ep.impulse_y[i, w])
        rows[w, i, 6] = has_failed(status, i, w)
        for k in range(TEAM_MEASURES, TERMS):
            rows[w, n, k] += rows[w, i, k]
    if not is_set(outcome, rewards.RESTED):
        put_terms(p, status, out, w, n, rows)


@compiled
def put_terms(p, status, out, w, n, rows):
    """Write the terms of each robot's reward in world w, and those of the team's."""
    outcome = out.outcomes[w]
    for i in range(n):
        own = rewards.earned(p, status, out.events[i, w], outcome, i, w)
        terms = rewards.with_share(p, status, own, outcome, i, w)
        for k in range(len(terms)):
            rows[w, i, TERMS + k] = terms[k]
        for k in range(len(own)):
            rows[w, n, TERMS + k] += own[k]
    team = rewards.team_terms(p, p.whole, outcome)
    for k in range(len(team)):
        rows[w, n, TERMS + rewards.TEAM_COLUMNS[k]] += team[k]
    if p.team_sharing:
        for i in range(n):
            for k in range(TERMS, rows.shape[2]):
                rows[w, i, k] = 0.0 if is_absent(status, i, w) else rows[w, n, k]


@compiled
def is_final(p, out, w):
    """Return whether the last step of world w is that of an episode which has been replaced."""
    return (out.terminated[w] | out.truncated[w]) & (p.autoreset == SAME_STEP)


@compiled
def put_all_infos(store, rows):
    """See :func:`write_infos`."""
    p, _, _, now, final, out, _ = parts_of(store)
    for w in range(FIRST, np.uint64(rows.shape[0])):
        episode = final if is_final(p, out, w) else now
        put_infos(p, episode, out, w, rows)


@entry_point
def write_infos(store, rows):
    """Fill ``rows`` (W, n, columns) as of the last step, before any automatic reset."""
    put_all_infos(store, rows)


@compiled
def put_all_states(store, final, rows):
    """See :func:`write_states`."""
    _, _, _, now, ended, _, _ = parts_of(store)
    put_state(ended if final else now, FIRST, np.uint64(rows.shape[0]), rows.T)


@entry_point
def write_states(store, final, rows):
    """Write the paper's vector of every world, (W, size)."""
    put_all_states(store, final, rows)


@compiled
def draw_world(p, mem, w, actions):
    """Fill world w of ``actions`` (W, n, 2) with the next draw of its stream of actions."""
    two, one = np.float32(2.0), np.float32(1.0)
    _, robots, axes = actions.shape
    key = stream_key(mem.seed[0], world_number(p, w), mem.draw[0], FOR_ACTIONS)
    for k in range(robots * axes):
        actions[w, k // axes, k % axes] = two * uniform(key, k) - one


@compiled
def draw_worlds(store, actions):
    """See :func:`draw_actions`."""
    p, _, mem, _, _, _, _ = parts_of(store)
    for w in range(actions.shape[0]):
        draw_world(p, mem, w, actions)


@entry_point
def draw_actions(store, actions):
    """Fill ``actions`` (W, n, 2) with the next draw of each world's stream of actions."""
    draw_worlds(store, actions)
