"""A step of which only a part is done, to see where the time goes.

The same compiled passes as in :mod:`mbn_marl.engine.step`, in the same order, behind a switch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from benchmarks.speed.timing import Case, cpu_backend, random_case
from mbn_marl import BatchEngine
from mbn_marl.engine.constants import unpack
from mbn_marl.engine.mdp.dynamics import propose_move
from mbn_marl.engine.mdp.observations import observe
from mbn_marl.engine.reset import copy_episode, reset_world
from mbn_marl.engine.step import (
    BLOCK,
    autoreset,
    check_termination,
    find_collisions,
    give_rewards,
    grow_filter,
    hash_positions,
    make_scratch,
    mark_revisits,
    mark_visits,
    pass_time,
    record_positions,
    stop_at_walls,
    test_containment,
)

PHYSICS, REWARDS, MEMORY, OBSERVATIONS = range(4)
PARTS = ("physics", "rewards and collisions", "revisit memory", "observations")
"""Each part needs those before it. Worlds restart from ``REWARDS`` on."""


compiled = numba.njit(nogil=True, error_model="numpy", forceinline=True)
"""As the engine's functions are, but not kept on disk."""


@compiled
def restart(p, g, mem, now, final, out, lo, hi):  # type: ignore[no-untyped-def]
    """The automatic reset of worlds whose episode has ended, without their observations."""
    ended = 0
    for w in range(lo, hi):
        if out.terminated[w] | out.truncated[w]:
            ended += 1
            copy_episode(now, w, final, w, now.x.shape[0], p.headings)
            reset_world(p, g, mem, now, w)
    return ended


@compiled
def step_parts(store, actions, last, lo, hi):  # type: ignore[no-untyped-def]  # noqa: C901 - switches
    """``step_worlds`` under the released rules with automatic reset, up to part ``last``."""
    p = unpack(store.constants)
    g, mem, now, final, out = store.geometry, store.memory, store.now, store.final, store.output
    block, entries = min(hi - lo, np.uint64(BLOCK)), out.observations.shape[2]
    to = make_scratch(block, now.x.shape[0], entries, now.x.dtype)
    ended = 0
    while lo < hi:
        end = min(lo + np.uint64(BLOCK), hi)
        for i in range(now.x.shape[0]):
            propose_move(p, g, now, to, actions, i, lo, end)
            test_containment(g, to, lo, end)
            stop_at_walls(p, now, out, to, i, lo, end)
            mark_visits(p, g, now.status, now, out, i, lo, end)
        if last >= MEMORY:
            record_positions(mem, now.status, now, lo, end)
            for i in range(now.x.shape[0]):
                hash_positions(mem, now.status, now, out, to, i, lo, end)
        if last >= REWARDS:
            pass_time(p, now.drawn, mem.key, now.gust, now.steps, lo, end)
        if last >= OBSERVATIONS:
            observe(p, g, mem, now, lo, end, to.tile, out.observations)
        if last >= MEMORY:
            for i in range(now.x.shape[0]):
                mark_revisits(mem, now, out, to, i, lo, end)
        if last >= REWARDS:
            find_collisions(p, now.status, now, to, lo, end)
            check_termination(p, g, mem, now, out, to, lo, end)
            give_rewards(p, now.status, now, out, to, lo, end)
        if last >= MEMORY:
            grow_filter(mem, now, lo, end)
        if last >= OBSERVATIONS:
            ended += autoreset(p, g, mem, now, final, out, to, lo, end)
        elif last >= REWARDS:
            ended += restart(p, g, mem, now, final, out, lo, end)
        lo = end
    return ended


def partial_step(engine: BatchEngine, last: int) -> Callable[[Any], None]:
    """Reset an engine with released rules; return a step up to ``PARTS[last]``, unchecked."""
    engine.reset()
    store, worlds = cpu_backend(engine).store, np.array([0, engine.num_worlds], np.uint64)
    return lambda actions: step_parts(store, actions, last, *worlds)


def part_cases(worlds: int, warm_up: int) -> list[Case]:
    """For each part a case of steps up to it on field_01, in seconds per world-step."""
    cases = []
    for last, name in enumerate(PARTS):
        engine = BatchEngine("field_01", worlds)
        shape, step = (worlds, engine.n_robots, 2), partial_step(engine, last)
        cases.append(random_case(f"up to {name}", shape, step, worlds, warm_up))
    return cases
