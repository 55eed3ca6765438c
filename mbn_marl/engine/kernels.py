"""The compiled entry points that ``BatchEngine`` calls, and how threads share the worlds."""

from __future__ import annotations

import os
from threading import Event
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from mbn_marl.engine import step
from mbn_marl.engine.arguments import Arguments, with_scratch, worlds_of
from mbn_marl.engine.mdp import rewards
from mbn_marl.engine.mdp.dynamics import objective
from mbn_marl.engine.mdp.events import visit_code
from mbn_marl.engine.mdp.failures import ABSENT, FAILED, status_of
from mbn_marl.engine.mdp.knowledge import hears
from mbn_marl.engine.mdp.observations import observe, put_state
from mbn_marl.engine.reset import clear_output, reset_world
from mbn_marl.jit.compile import address_of, compiled, entry_point, parallel_entry_point
from mbn_marl.jit.functions import count_bits, is_set
from mbn_marl.jit.intrinsics import call_step
from mbn_marl.jit.random_numbers import FOR_ACTIONS, stream_key, uniform, world_number

FIRST, NEXT = np.uint64(0), np.uint64(1)
# With fewer worlds than this for each thread, one does it all.
WORLDS_PER_THREAD = 256

MEASURES = (
    *("success", "rois_visited", "collision"),
    *("wall_hits", "path_length", "impulse", "failed"),
)
# The first measures are the team's, and after all measures come the terms of the reward.
TEAM_MEASURES, TERMS = MEASURES.index("wall_hits"), len(MEASURES)
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
def step_ranges(address, arguments, actions, cuts):
    """Step worlds ``cuts[k]`` to ``cuts[k + 1] - 1`` for every k; return how many ended."""
    # ``address`` is that of ``step_worlds``, which would otherwise be compiled three times more.
    ended = 0
    for k in prange(cuts.size - 1):
        ended += call_step(address, with_scratch(arguments, k), actions, cuts[k], cuts[k + 1])
    return ended


@entry_point
def reset_worlds(arguments, mask, lo, hi, asked):
    # Unless this was ``asked`` for, the outputs of the last step stay.
    p, g, mem, now, _, out, to = worlds_of(arguments)
    for w in range(np.uint64(lo), np.uint64(hi)):
        if mask[w - np.uint64(lo)]:
            reset_world(p, g, mem, now, w)
            if asked:
                mem.pending[w] = False
                clear_output(p, out, w)
            observe(p, g, mem, now, w, w + NEXT, to.tile, out.observations)


@entry_point
def rest_worlds(arguments, mask):
    """Make the outputs of the masked worlds those of a step in which nothing happened."""
    p, g, mem, now, _, out, to = worlds_of(arguments)
    for w in range(FIRST, np.uint64(mask.size)):
        if mask[w]:
            mem.pending[w] = True
            for i in range(now.x.shape[0]):
                last = now.steps[w] * now.x.shape[0] + i
                mem.trail[w, last, 0] = now.x[i, w]
                mem.trail[w, last, 1] = now.y[i, w]
            clear_output(p, out, w)
            observe(p, g, mem, now, w, w + NEXT, to.tile, out.observations)


@compiled
def put_infos(p, ep, out, w, rows):
    """Write the measures of each robot of world w, in the order of ``INFO_COLUMNS``."""
    # The row after the robots' has the team's: sums of the robots' own, and the terms of ``R``.
    outcome, n = out.outcomes[w], ep.x.shape[0]
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
        rows[w, i, 6] = status_of(ep, i, w) == FAILED
        for k in range(TEAM_MEASURES, TERMS):
            rows[w, n, k] += rows[w, i, k]
    if not is_set(outcome, rewards.RESTED):
        put_terms(p, ep, out, w, rows)


@compiled
def put_terms(p, ep, out, w, rows):
    outcome, n = out.outcomes[w], ep.x.shape[0]
    for i in range(n):
        own = rewards.earned(p, ep, out.events[i, w], outcome, i, w)
        terms = rewards.with_share(p, ep, own, outcome, i, w)
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
                rows[w, i, k] = 0.0 if status_of(ep, i, w) == ABSENT else rows[w, n, k]


@compiled
def is_final(p, out, w):
    return (out.terminated[w] | out.truncated[w]) & (p.autoreset == step.SAME_STEP)


@entry_point
def write_infos(arguments, rows):
    """Fill ``rows`` (W, n, columns) as of the last step, before any automatic reset."""
    p, _, _, now, final, out, _ = worlds_of(arguments)
    for w in range(FIRST, np.uint64(rows.shape[0])):
        episode = final if is_final(p, out, w) else now
        put_infos(p, episode, out, w, rows)


@entry_point
def write_states(arguments, final, rows):
    _, _, _, now, ended, _, _ = worlds_of(arguments)
    put_state(ended if final else now, FIRST, np.uint64(rows.shape[0]), rows.T)


@compiled
def draw_world(p, mem, w, actions):
    """Fill world w of ``actions`` (W, n, 2) with the next draw of its stream of actions."""
    two, one = np.float32(2.0), np.float32(1.0)
    _, robots, axes = actions.shape
    key = stream_key(mem.seed[0], world_number(p, w), mem.draw[0], FOR_ACTIONS)
    for k in range(robots * axes):
        actions[w, k // axes, k % axes] = two * uniform(key, k) - one


@entry_point
def draw_actions(arguments, actions):
    p, _, mem, _, _, _, _ = worlds_of(arguments)
    for w in range(actions.shape[0]):
        draw_world(p, mem, w, actions)


@entry_point
def write_heard(arguments, rows):
    """Fill ``rows`` (n, n): whether robot i of the first world receives words of robot j."""
    p, _, mem, now, _, _, _ = worlds_of(arguments)
    for i in range(now.x.shape[0]):
        for j in range(now.x.shape[0]):
            rows[i, j] = (i != j) & hears(p, mem, now, i, j, FIRST)


# -- threads ---------------------------------------------------------------------------------------

# OpenMP does not survive a fork: a child of a process that has used it steps on one thread.
_threaded, _forked = Event(), Event()


def _after_fork() -> None:
    if _threaded.is_set():
        _forked.set()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def cuts_of(worlds: int, threads: int | None) -> NDArray[np.int64]:
    """The first world of each thread's range, and the number of worlds, (threads + 1,)."""
    # ``None`` takes a thread per core where the batch is worth it.
    if threads is None:
        has_affinity = hasattr(os, "sched_getaffinity")
        cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
        threads = max(1, min(cores, worlds // WORLDS_PER_THREAD))
    return np.array([worlds * k // threads for k in range(threads + 1)])


def step_all(arguments: Arguments, actions: NDArray[Any], cuts: NDArray[np.int64]) -> int:
    # No two worlds share memory that is written, so neither the number of threads nor the cuts
    # change any result. The threads are those of Numba's threading layer: OpenMP where there is
    # one, since it starts work in microseconds.
    if cuts.size == 2 or _forked.is_set():
        return int(step.step_worlds(arguments, actions, 0, cuts[-1]))
    _threaded.set()
    if not arguments.step_address:  # it does for actions that cannot be written, too
        arguments.step_address = address_of(step.step_worlds, arguments, actions, 0, 0)
    return int(step_ranges(arguments.step_address, arguments, actions, cuts))
