"""The compiled entry points that ``BatchEngine`` calls; each takes whole arrays."""

from __future__ import annotations

import numpy as np
from numba import prange

from mbn_marl.compiled.jit import assembled, compiled, entry_point, parallel_entry_point
from mbn_marl.compiled.rng import FOR_ACTIONS, stream_key, uniform, world_number
from mbn_marl.compiled.scalars import count_bits, is_set
from mbn_marl.engine.constants import unpack
from mbn_marl.engine.intrinsics import call_step
from mbn_marl.engine.mdp import rewards
from mbn_marl.engine.mdp.dynamics import objective
from mbn_marl.engine.mdp.failures import has_failed
from mbn_marl.engine.mdp.observations import observe, put_state
from mbn_marl.engine.mdp.visits import visit_code
from mbn_marl.engine.reset import begin_world, clear_output
from mbn_marl.engine.step import SAME_STEP, sizes_of
from mbn_marl.engine.store import parts_of

FIRST, NEXT = np.uint64(0), np.uint64(1)

MEASURES = (
    *("success", "rois_visited", "collision"),
    *("wall_hits", "path_length", "impulse", "failed"),
)
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
        ended += call_step(address, store, actions, cuts[k], cuts[k + 1])
    return ended


@assembled
def reset_masked(store, tile, mask):
    """See :func:`reset_worlds`; ``tile`` is (observation size, 1)."""
    constants, g, mem, now, _, out = parts_of(store)
    p = unpack(constants)
    for w in range(FIRST, np.uint64(mask.size)):
        if mask[w]:
            begin_world(p, g, mem, now, out, w)
            observe(p, g, mem, now, w, w + NEXT, tile, out.observations)


@entry_point
def reset_worlds(store, mask):
    """Begin a new episode in the masked worlds."""
    _, entries = sizes_of(store)
    reset_masked(store, np.empty((entries, 1), np.float32), mask)


@assembled
def rest_masked(store, tile, mask):
    """See :func:`rest_worlds`."""
    constants, g, mem, now, _, out = parts_of(store)
    p = unpack(constants)
    for w in range(FIRST, np.uint64(mask.size)):
        if mask[w]:
            mem.pending[w] = True
            for i in range(now.x.shape[0]):
                last = now.steps[w] * now.x.shape[0] + i
                mem.trail[w, last, 0] = now.x[i, w]
                mem.trail[w, last, 1] = now.y[i, w]
            clear_output(p, out, w)
            observe(p, g, mem, now, w, w + NEXT, tile, out.observations)


@entry_point
def rest_worlds(store, mask):
    """Make the outputs of the masked worlds those of a step in which nothing happened."""
    _, entries = sizes_of(store)
    rest_masked(store, np.empty((entries, 1), np.float32), mask)


@compiled
def put_infos(p, ep, out, w, rows):
    """Write the measures of each robot of world w, in the order of ``INFO_COLUMNS``."""
    outcome, status = out.outcomes[w], ep.status
    rois_visited = count_bits(visit_code(ep.visited[w], ep.codes[w]))
    lost, rested = is_set(outcome, rewards.COLLISION), is_set(outcome, rewards.RESTED)
    success = is_set(outcome, rewards.SUCCESS) and not lost
    for i in range(rows.shape[1]):
        rows[w, i, 0] = success
        rows[w, i, 1] = rois_visited
        rows[w, i, 2] = lost
        rows[w, i, 3] = ep.wall_hits[i, w]
        rows[w, i, 4] = ep.path_length[i, w]
        rows[w, i, 5] = objective(ep.impulse_x[i, w], ep.impulse_y[i, w])
        rows[w, i, 6] = has_failed(status, i, w)
        own = rewards.earned(p, status, out.events[i, w], outcome, i, w)
        terms = rewards.with_share(p, status, own, outcome, i, w)
        for k in range(len(terms)):
            rows[w, i, len(MEASURES) + k] = 0.0 if rested else terms[k]


@compiled
def is_final(p, out, w):
    """Return whether the last step of world w is that of an episode which has been replaced."""
    return (out.terminated[w] | out.truncated[w]) & (p.autoreset == SAME_STEP)


@entry_point
def write_infos(store, rows):
    """Fill ``rows`` (W, n, columns) as of the last step, before any automatic reset."""
    p = unpack(store.constants)
    for w in range(FIRST, np.uint64(rows.shape[0])):
        episode = store.final if is_final(p, store.output, w) else store.now
        put_infos(p, episode, store.output, w, rows)


@entry_point
def write_states(store, final, states):
    """Write the paper's vector of every world, (W, size)."""
    episode = store.final if final else store.now
    hi = np.uint64(states.shape[0])
    put_state(episode, FIRST, hi, states.T)


@compiled
def draw_world(p, mem, w, actions):
    """Fill world w of ``actions`` (W, n, 2) with the next draw of its stream of actions."""
    two, one = np.float32(2.0), np.float32(1.0)
    _, robots, axes = actions.shape
    key = stream_key(mem.seed[0], world_number(p, w), mem.draw[0], FOR_ACTIONS)
    for k in range(robots * axes):
        actions[w, k // axes, k % axes] = two * uniform(key, k) - one


@entry_point
def draw_actions(store, actions):
    """Fill ``actions`` (W, n, 2) with the next draw of each world's stream of actions."""
    p = unpack(store.constants)
    for w in range(actions.shape[0]):
        draw_world(p, store.memory, w, actions)
