"""The CUDA kernels: a thread per world, around the very functions that the CPU's loops call."""

# A thread gathers its world into arrays whose world axis has length 1 and that live in registers,
# runs the passes of ``step`` on that batch of one, and puts the world back. Nothing of the MDP is
# written here, only where its data lies: structures of arrays, so that the threads of a warp read
# and write next to each other, and observations by way of shared memory, for the same reason.
#
# Whatever the threads of a launch read or write comes in named tuples, which kernels take whole.

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numba import cuda
from numba.core import config
from numba.core.compiler_lock import global_compiler_lock

from mbn_marl.engine.constants import AUTORESET_MODES
from mbn_marl.engine.kernels import draw_world, is_final, put_infos
from mbn_marl.engine.mdp.assignment import assign
from mbn_marl.engine.mdp.observations import put_state, write_observation
from mbn_marl.engine.mdp.paths import Paths
from mbn_marl.engine.reset import (
    ENDED,
    RESTARTS,
    clear_output,
    copy_episode,
    copy_motion,
    reset_world,
)
from mbn_marl.engine.state import Episode, Geometry, Memory, Output
from mbn_marl.engine.step import close_step, move_robots, score_step, scratch_of
from mbn_marl.field.generator.layout import Tables
from mbn_marl.jit.compile import compiled, generated, returning_views
from mbn_marl.jit.features import Settle
from mbn_marl.jit.functions import column

DISABLED = AUTORESET_MODES.index("disabled")
NOT_FINITE, WAITING, LEFT_OUT = 1, 2, 3
KINDS = 4
NO_FAULT = np.int64(2**62)
ZERO, ONE = np.uint64(0), np.uint64(1)
SIMULATED = bool(config.ENABLE_CUDASIM)
MOST_THREADS = 128
# The shared memory that a block has without asking the driver for more.
TILE_BYTES = 48 * 1024


if not SIMULATED and importlib.util.find_spec("numba_cuda"):
    from numba.cuda.core.rewrites.registry import rewrite_registry

    # numba-cuda compiles rules by its own copy of Numba's compiler, which has its own list.
    rewrite_registry.rewrites["before-inference"].append(Settle)


class Call(NamedTuple):
    actions: Any  # (W, n, 2) real
    active: Any  # (W,) bool: worlds to step, or to reset
    fault: Any  # (1,) int64: the first world with a fault * KINDS + its kind, or NO_FAULT


def threads_per_block(obs_size: int) -> int:
    """As many as there is shared memory for: a robot's observation in each world of a block."""
    threads = MOST_THREADS
    while obs_size * (threads + 1) * 4 > TILE_BYTES:
        threads //= 2
    return threads


@compiled
def fault_of(p, mem, call, w):
    for i in range(call.actions.shape[1]):
        for axis in range(2):
            if not math.isfinite(call.actions[w, i, axis]):
                return NOT_FINITE
    waits = mem.pending[w] if p.autoreset == DISABLED else mem.episode[w] < 0
    if waits == call.active[w]:
        return WAITING if call.active[w] else LEFT_OUT
    return 0


def _view_of(kind: Any, index: str, given: tuple[str, ...] = (), **places: str) -> Any:
    """``view(source, w, end, ...)``: world w of the arrays of ``kind``, as a batch of one."""
    # ``index`` is the place of a world in an array, ``places`` are those that differ; ``given`` are
    # the arrays that the caller has and passes.
    index_of = dict.fromkeys(kind._fields, index) | places
    arrays = (field if field in given else f"source.{field}{index_of[field]}" for field in index_of)
    head = f"def view({', '.join(('source', 'w', 'end', *given))}):"
    source = f"{head}\n    return Kind({', '.join(arrays)})\n"
    return generated("view", source, returning_views, Kind=kind)


# The parts of an episode, and those of the output, that a step keeps in registers.
MOTION = ("x", "y", "vx", "vy", "visited", "steps")
RESULTS = ("rewards", "team_rewards", "terminated", "truncated", "events", "outcomes")
LAST = "[..., w:end]"
field_of, paths_of = _view_of(Tables, LAST), _view_of(Paths, LAST)
episode_of, output_of = _view_of(Episode, LAST, MOTION), _view_of(Output, "[w:end]", RESULTS)
memory_of = _view_of(Memory, "[w:end]", ("x_bits", "y_bits"), seed="", draw="", sensed=LAST)


@compiled
def save_output(one, out, w):
    for i in range(one.events.shape[0]):
        out.rewards[w, i] = one.rewards[0, i]
        out.events[i, w] = one.events[i, 0]
    out.team_rewards[w] = one.team_rewards[0]
    out.terminated[w] = one.terminated[0]
    out.truncated[w] = one.truncated[0]
    out.outcomes[w] = one.outcomes[0]


@cuda.jit(device=True)
def write_observations(p, g, mem, ep, w, is_world, tile, rows):
    """Write the observations of the block's worlds; this thread's is ``w`` of ``ep``."""
    # A robot's observation is made in this thread's column of ``tile`` (size, threads + 1), in
    # shared memory, and the block then writes all columns together, entry next to entry.
    thread, threads = cuda.threadIdx.x, cuda.blockDim.x
    first = cuda.blockIdx.x * threads
    size = rows.shape[2]
    count = min(threads, rows.shape[0] - first)
    if is_world:
        assign(p, g, mem, ep, w, w + ONE)
    for i in range(rows.shape[1]):
        if is_world:
            write_observation(p, g, mem, ep, i, w, w + ONE, tile[:, thread : thread + 1])
        cuda.syncthreads()
        world, entry = thread // size, thread % size
        while world < count:
            rows[first + world, i, entry] = tile[entry, world]
            world += threads // size
            entry += threads % size
            if entry >= size:
                world += 1
                entry -= size
        cuda.syncthreads()


def exact(function: Callable[..., None]) -> Any:
    """The kernel of a function, compiled so that each product is rounded, as the CPU does."""
    # NVVM would contract ``a * b + c`` into one operation with one rounding. It has an option
    # against that, which numba-cuda does not offer, so it is added to those of the kernel's
    # compilation. Link-time optimisation would contract once more, and takes no such option.
    if SIMULATED:
        return cuda.jit(function)
    kernel = cuda.jit(function, lto=False)
    compile_kernel = kernel.compile

    def compile_exactly(signature: Any) -> Any:
        with rounded_products():
            return compile_kernel(signature)

    kernel.compile = compile_exactly
    return kernel


@contextmanager
def rounded_products() -> Iterator[None]:
    """While this lasts, numba-cuda compiles without contraction (NVVM's ``-fma=0``)."""
    from numba.cuda.cudadrv import nvvm

    with global_compiler_lock:
        compile_ir = nvvm.compile_ir
        nvvm.compile_ir = partial(compile_ir, fma=False)
        try:
            yield
        finally:
            nvvm.compile_ir = compile_ir


@cache
def step_kernel(n: int, obs_size: int, dtype: str) -> Any:
    real = np.dtype(dtype).type
    bits = np.uint32 if real == np.float32 else np.uint64
    # These are constants of the code: the robots' loops unroll, and a world's arrays are registers.
    columns = threads_per_block(obs_size) + 1  # odd: neither way of reading meets a bank twice

    def step(p, g, mem, now, final, out, call):
        w = np.uint64(cuda.grid(1))
        is_world = w < now.steps.shape[0]
        tile = cuda.shared.array((obs_size, columns), np.float32)
        mine = tile[:, cuda.threadIdx.x : cuda.threadIdx.x + 1]
        x, y = cuda.local.array((n, 1), real), cuda.local.array((n, 1), real)
        vx, vy = cuda.local.array((n, 1), real), cuda.local.array((n, 1), real)
        visited, steps = cuda.local.array(1, np.int32), cuda.local.array(1, np.int32)
        events, outcomes = cuda.local.array((n, 1), np.int32), cuda.local.array(1, np.int32)
        rewards = cuda.local.array((1, n), real)
        reals = cuda.local.array((10, 1), real)
        flags = cuda.local.array((5, 1), np.bool_)
        crossings = cuda.local.array(1, np.int32)
        keys = cuda.local.array((2, n, 1), np.uint64)
        end = w + ONE
        one = episode_of(now, w, end, x, y, vx, vy, visited, steps)
        f = column(g.field, w)
        field, paths = field_of(g.field, f, f + ONE), paths_of(g.paths, f, f + ONE)
        own = Geometry(field, paths, g.team, g.sampler)
        memory = memory_of(mem, w, end, x.view(bits), y.view(bits))
        given = output_of(out, w, end, rewards, reals[9], flags[3], flags[4], events, outcomes)
        to = scratch_of(reals, crossings, flags, keys, mine)
        if is_world:
            copy_motion(now, w, one, ZERO, n)
            fault, change = fault_of(p, mem, call, w), 0
            if fault != 0:
                cuda.atomic.min(call.fault, 0, np.int64(w) * KINDS + fault)
            if (fault != 0) | (not call.active[w]):
                clear_output(p, given, ZERO)
            else:
                move_robots(p, own, memory, one, given, to, call.actions[w:end], ZERO, ONE)
                score_step(p, own, memory, one, given, to, ZERO, ONE)
                change = close_step(p, memory, given, ZERO)
            if change == ENDED | RESTARTS:
                assign(p, own, memory, one, ZERO, ONE)
                for i in range(n):
                    write_observation(p, own, memory, one, i, ZERO, ONE, mine)
                    for entry in range(obs_size):
                        given.final_observations[0, i, entry] = mine[entry, 0]
            copy_motion(one, ZERO, now, w, n)
            save_output(given, out, w)
            if change == ENDED | RESTARTS:
                copy_episode(now, w, final, w, n, p.headings)
            if change & RESTARTS:
                reset_world(p, g, mem, now, w)
                copy_motion(now, w, one, ZERO, n)
        write_observations(p, own, memory, one, ZERO, is_world, tile, out.observations)

    return exact(step)


@cache
def reset_kernel(obs_size: int) -> Any:
    columns = threads_per_block(obs_size) + 1

    def reset(p, g, mem, now, out, call):
        w = np.uint64(cuda.grid(1))
        is_world = w < now.steps.shape[0]
        tile = cuda.shared.array((obs_size, columns), np.float32)
        if is_world and call.active[w]:
            reset_world(p, g, mem, now, w)
            mem.pending[w] = False
            clear_output(p, out, w)
        write_observations(p, g, mem, now, w, is_world, tile, out.observations)

    return exact(reset)


@exact
def infos(p, g, mem, now, final, out, rows):
    w = cuda.grid(1)
    if w < now.steps.shape[0]:
        if is_final(p, out, w):
            put_infos(p, final, out, w, rows[0])
        else:
            put_infos(p, now, out, w, rows[0])


@exact
def states(episode, rows):
    w = np.uint64(cuda.grid(1))
    if w < episode.steps.shape[0]:
        put_state(episode, w, w + ONE, rows[0][w : w + ONE].T)


@exact
def draw(p, mem, rows):
    w = cuda.grid(1)
    if w < rows[0].shape[0]:
        draw_world(p, mem, w, rows[0])
