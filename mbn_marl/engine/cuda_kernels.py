"""The CUDA kernels: a thread per world, around the very functions that the CPU's loops call.

A thread gathers its world into arrays whose world axis has length 1 and that live in registers,
runs the passes of ``step`` on that batch of one, and puts the world back. Nothing of the MDP is
written here, only where its data lies: structures of arrays, so that the threads of a warp read and
write next to each other, and observations by way of shared memory, for the same reason.

Whatever the threads of a launch read or write comes in named tuples, which kernels take whole.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numba import cuda
from numba.core import config
from numba.core.compiler_lock import global_compiler_lock

from mbn_marl.engine.compiling import compiled
from mbn_marl.engine.constants import AUTORESET_MODES, Constants
from mbn_marl.engine.kernels import draw_world, put_infos
from mbn_marl.engine.observation import column, describe, put_state
from mbn_marl.engine.reset import clear_output, finish_world, reset_world
from mbn_marl.engine.state import Episode, Geometry, Memory, Output
from mbn_marl.engine.step import ENDED, RESTARTS, SAME_STEP, Scratch, act, assess, conclude

DISABLED = AUTORESET_MODES.index("disabled")
NOT_FINITE, WAITING, LEFT_OUT = 1, 2, 3
KINDS = 4
NO_FAULT = np.int64(2**62)
ZERO, ONE = np.uint64(0), np.uint64(1)
SIMULATED = bool(config.ENABLE_CUDASIM)
MOST_THREADS = 128
TILE_BYTES = 48 * 1024
"""What a block may take of shared memory without asking the driver for more."""


class Call(NamedTuple):
    """What is new in each launch of a step or a reset."""

    actions: Any  # (W, n, 2) real
    active: Any  # (W,) bool: worlds to step, or to reset


class Control(NamedTuple):
    """What the host may change between two launches of a captured graph, and reads when asked."""

    seed: Any  # (1,) int64
    draw: Any  # (1,) int64: number of the draw of random actions
    fault: Any  # (1,) int64: the first world with a fault * KINDS + its kind, or NO_FAULT


def threads_per_block(obs_size: int) -> int:
    """As many as there is shared memory for: a robot's observation in each world of a block."""
    threads = MOST_THREADS
    while obs_size * (threads + 1) * 4 > TILE_BYTES:
        threads //= 2
    return threads


@compiled
def with_seed(p, control):
    """The constants with the seed that holds now."""
    seed = (control.seed[0],)
    return Constants(*(p[:-1] + seed))


@compiled
def is_waiting(p, mem, w):
    """Whether world w cannot be stepped before a reset."""
    return mem.pending[w] if p.autoreset == DISABLED else mem.episode[w] < 0


@compiled
def fault_of(p, mem, call, w):
    """What is wrong with stepping world w, or 0."""
    for i in range(call.actions.shape[1]):
        for axis in range(2):
            if not math.isfinite(call.actions[w, i, axis]):
                return NOT_FINITE
    if is_waiting(p, mem, w) == call.active[w]:
        return WAITING if call.active[w] else LEFT_OUT
    return 0


@compiled
def memory_of(mem, x_bits, y_bits, w):
    """The memory of world w as a batch of one."""
    end = w + ONE
    return Memory(
        x_bits,
        y_bits,
        mem.trail[w:end],
        mem.trail_bits[w:end],
        mem.trail_key[w:end],
        mem.trail_velocity[w:end],
        mem.trail_code[w:end],
        mem.words[w:end],
        mem.filter[w:end],
        mem.pending[w:end],
        mem.episode[w:end],
    )


@compiled
def geometry_of(g, w):
    """The tables of world w, as those of a batch of one."""
    f = column(g, w)
    end = f + ONE
    return Geometry(
        g.edges[:, :, f:end],
        g.rois[:, :, f:end],
        g.starts[:, :, f:end],
        g.roi_bits[:, f:end],
        g.codes[f:end],
        g.boxes[:, f:end],
        g.masses,
        g.rays,
    )


@compiled
def load_episode(now, one, w):
    """Fetch what a step reads over and over: ``one`` holds it for world w."""
    for i in range(one.x.shape[0]):
        one.x[i, 0] = now.x[i, w]
        one.y[i, 0] = now.y[i, w]
        one.vx[i, 0] = now.vx[i, w]
        one.vy[i, 0] = now.vy[i, w]
    one.visited[0] = now.visited[w]
    one.steps[0] = now.steps[w]


@compiled
def save_episode(one, now, w):
    """Put back what :func:`load_episode` fetched."""
    for i in range(one.x.shape[0]):
        now.x[i, w] = one.x[i, 0]
        now.y[i, w] = one.y[i, 0]
        now.vx[i, w] = one.vx[i, 0]
        now.vy[i, w] = one.vy[i, 0]
    now.visited[w] = one.visited[0]
    now.steps[w] = one.steps[0]


@compiled
def save_output(one, out, w):
    """Hand out what the step of world w made, but for the observations."""
    for i in range(one.events.shape[0]):
        out.rewards[w, i] = one.rewards[0, i]
        out.events[i, w] = one.events[i, 0]
    out.team_rewards[w] = one.team_rewards[0]
    out.terminated[w] = one.terminated[0]
    out.truncated[w] = one.truncated[0]
    out.outcomes[w] = one.outcomes[0]


@cuda.jit(device=True)
def hand_out(p, g, ep, w, is_world, tile, rows):
    """Write the observations of the block's worlds to ``rows``; this thread's is ``w`` of ``ep``.

    A robot's observation is made in this thread's column of ``tile`` (size, threads + 1), in shared
    memory, and the block then writes all columns together, entry next to entry.
    """
    thread, threads = cuda.threadIdx.x, cuda.blockDim.x
    first = cuda.blockIdx.x * threads
    size = rows.shape[2]
    count = min(threads, rows.shape[0] - first)
    for i in range(rows.shape[1]):
        if is_world:
            describe(p, g, g.rays, ep, w, w + ONE, i, tile[:, thread : thread + 1])
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


def make_step(n: int, obs_size: int, real: Any, bits: Any) -> Callable[..., None]:
    """The step of all worlds, for a team and observation size and a precision.

    These are constants of the code: the robots' loops unroll, and a world's arrays are registers.
    """
    threads = threads_per_block(obs_size)
    columns = threads + 1  # an odd number, so that neither way of reading meets a bank twice

    def step(p, g, mem, now, final, out, call, control):
        w = np.uint64(cuda.grid(1))
        is_world = w < now.steps.shape[0]
        tile = cuda.shared.array((obs_size, columns), np.float32)
        mine = tile[:, cuda.threadIdx.x : cuda.threadIdx.x + 1]
        x = cuda.local.array((n, 1), real)
        y = cuda.local.array((n, 1), real)
        vx = cuda.local.array((n, 1), real)
        vy = cuda.local.array((n, 1), real)
        visited = cuda.local.array(1, np.int32)
        steps = cuda.local.array(1, np.int32)
        events = cuda.local.array((n, 1), np.int32)
        outcomes = cuda.local.array(1, np.int32)
        rewards = cuda.local.array((1, n), real)
        reals = cuda.local.array((7, 1), real)
        flags = cuda.local.array((4, 1), np.bool_)
        seen = cuda.local.array(1, np.int32)
        keys = cuda.local.array((2, n, 1), np.uint64)
        end = w + ONE
        one = Episode(
            x,
            y,
            vx,
            vy,
            now.impulse_x[:, w:end],
            now.impulse_y[:, w:end],
            now.path_length[:, w:end],
            now.wall_hits[:, w:end],
            now.returns[:, w:end],
            now.team_return[w:end],
            visited,
            steps,
        )
        own = geometry_of(g, w)
        memory = memory_of(mem, x.view(bits), y.view(bits), w)
        given = Output(
            out.observations[w:end],
            rewards,
            reals[6],
            flags[2],
            flags[3],
            events,
            outcomes,
            out.final_observations[w:end],
        )
        to = Scratch(
            reals[0],
            reals[1],
            reals[2],
            reals[3],
            reals[4],
            reals[5],
            seen,
            flags[0],
            flags[1],
            keys[0],
            keys[1],
            mine,
        )
        if is_world:
            load_episode(now, one, w)
            fault = fault_of(p, mem, call, w)
            fate = 0
            if fault != 0:
                cuda.atomic.min(control.fault, 0, np.int64(w) * KINDS + fault)
            if (fault != 0) | (not call.active[w]):
                clear_output(p, given, ZERO)
            else:
                act(p, own, memory, one, given, to, call.actions[w:end], ZERO, ONE)
                assess(p, own, memory, one, given, to, ZERO, ONE)
                fate = conclude(p, memory, given, ZERO)
            if fate == ENDED | RESTARTS:
                for i in range(n):
                    describe(p, own, own.rays, one, ZERO, ONE, i, mine)
                    for entry in range(obs_size):
                        given.final_observations[0, i, entry] = mine[entry, 0]
            save_episode(one, now, w)
            save_output(given, out, w)
            if fate == ENDED | RESTARTS:
                finish_world(now, final, w)
            if fate & RESTARTS:
                reset_world(with_seed(p, control), g, mem, now, w)
                load_episode(now, one, w)
        hand_out(p, own, one, ZERO, is_world, tile, out.observations)

    return step


def make_reset(obs_size: int) -> Callable[..., None]:
    """The reset of the worlds that ``call.active`` marks, and everyone's observations."""
    columns = threads_per_block(obs_size) + 1

    def reset(p, g, mem, now, out, call, control):
        w = np.uint64(cuda.grid(1))
        is_world = w < now.steps.shape[0]
        tile = cuda.shared.array((obs_size, columns), np.float32)
        if is_world and call.active[w]:
            mem.pending[w] = False
            reset_world(with_seed(p, control), g, mem, now, w)
            clear_output(p, out, w)
        hand_out(p, g, now, w, is_world, tile, out.observations)

    return reset


def infos(p, g, mem, now, final, out, rows):
    """As ``kernels.write_infos``, with ``rows`` in a tuple of one."""
    w = cuda.grid(1)
    if w < now.steps.shape[0]:
        ended = out.terminated[w] | out.truncated[w]
        if ended & (p.autoreset == SAME_STEP):
            put_infos(p, g, final, out, w, rows[0])
        else:
            put_infos(p, g, now, out, w, rows[0])


def states(g, mem, episode, rows):
    """As ``kernels.write_states``, of one of the episodes, with ``rows`` in a tuple of one."""
    w = np.uint64(cuda.grid(1))
    if w < episode.steps.shape[0]:
        put_state(g, episode, w, w + ONE, 0, rows[0][w : w + ONE].T)


def draw(control, rows):
    """As ``kernels.draw_actions``, with the actions in a tuple of one."""
    w = cuda.grid(1)
    if w < rows[0].shape[0]:
        draw_world(control.seed[0], control.draw[0], w, rows[0])


@cache
def step_kernel(n: int, obs_size: int, dtype: str) -> Any:
    """The step, shared by all engines of a process with this team, observation and precision."""
    real = np.dtype(dtype).type
    return exact(make_step(n, obs_size, real, np.uint32 if real == np.float32 else np.uint64))


@cache
def reset_kernel(obs_size: int) -> Any:
    """The reset, shared likewise."""
    return exact(make_reset(obs_size))


@cache
def plain_kernel(function: Callable[..., None]) -> Any:
    """Any of the other kernels of this module, compiled for the types of each call."""
    return exact(function)


def exact(function: Callable[..., None]) -> Any:
    """The kernel of a function, compiled so that each product is rounded, as the CPU does.

    NVVM would contract ``a * b + c`` into one operation with one rounding. It has an option against
    that, which numba-cuda does not offer, so it is added to those of the kernel's compilation.
    """
    kernel = cuda.jit(function)
    if SIMULATED:
        return kernel
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
