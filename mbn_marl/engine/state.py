"""The engine's data: named tuples of arrays, which kernels take whole."""

# W is the number of worlds, n robots, m ROIs, E edges, T = max_steps; F is 1 if all worlds have the
# same field, otherwise W. ``real`` is the engine's dtype, float32 or float64.
#
# Robot quantities are structure-of-arrays, ``[robot, world]``, so that a loop over worlds reads and
# writes contiguously. The array of a feature that is off has no entries and another number of
# dimensions, which is part of its type: see ``Feature``.

from __future__ import annotations

from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.engine.mdp.assignment import plan_size
from mbn_marl.engine.mdp.disturbances import DISTURBANCES, OF_ACTIONS, OF_SIGHT, any_on
from mbn_marl.engine.mdp.drawn_numbers import is_drawn, rows_drawn
from mbn_marl.engine.mdp.dynamics import count_headings
from mbn_marl.engine.mdp.knowledge import knowledge_rows
from mbn_marl.engine.mdp.paths import Paths
from mbn_marl.engine.mdp.revisits import ODD_LINES, filter_size
from mbn_marl.engine.mdp.sight import count_sensed
from mbn_marl.field.generator.layout import Tables
from mbn_marl.jit.features import Feature

Array = NDArray[Any]


class Team(NamedTuple):
    limits: Array  # (3, n) real: the rows are config.LIMITS
    kinds: Array  # (n,) int32: dynamics; (0, 0) if all are point masses
    fail_at: Array  # (n,) int32: the step in which each robot fails, 0 for none; (0,) without
    ranges: Array  # (3, numbers) float64: see drawn_numbers.make_ranges; (0,) if none is drawn
    rays: Array  # (2, 8) real: lidar's rays, units; (0,) without it
    scales: Array  # (2,) real: see entities.SCALES; (0, 0) without it


class Sampler(NamedTuple):
    """The numbers that fields are drawn by, episode by episode; empty if fields are fixed."""

    numbers: Array  # (numbers + 1,) int64: FieldSampler.numbers and its seed; (0, 0) if fixed
    scratch: Array  # (rows, F) int64: room to make a field in; (0, 0) if fixed
    kept: Array  # (F,) bool: whether the next episode keeps the field; (0,) if fixed


class Geometry(NamedTuple):
    """The fields and the teams of the worlds, padded to common sizes."""

    field: Tables
    paths: Paths
    team: Team
    sampler: Sampler


draws_fields = Feature(lambda g: g.sampler.numbers.ndim == 1)


class Episode(NamedTuple):
    x: Array  # (n, W) real, units
    y: Array
    vx: Array  # (n, W) real, units/step
    vy: Array
    impulse_x: Array  # (n, W) real: sum over steps of u tau
    impulse_y: Array
    path_length: Array  # (n, W) real, units
    wall_hits: Array  # (n, W) int32
    returns: Array  # (n, W) float64: each agent's rewards, summed
    team_return: Array  # (W,) float64
    visited: Array  # (W,) int32: the visit code, and empty and padding ROIs set from the start
    codes: Array  # (W,) int32: Tables.codes of the episode's field, without empty ROIs
    steps: Array  # (W,) int32
    heading: Array  # (n, W) real, radians; (0, W) if no robot of the team has one
    cos: Array  # (n, W) real: of the heading, 0 for a robot without one; (0, W) likewise
    sin: Array
    gust: Array  # (2, W) real, units/step per step: x, y; (0, 0, W) without gusts
    queue: Array  # (2 n (delay + 1), W) real: the last actions sent; (0, 0, W) if undisturbed
    drawn: Array  # (rows_drawn, W) real: drawn numbers; (0, 0, W) if nothing is drawn
    status: Array  # (n, W) int8, see failures.WORKS ...; (0, 0, W) if all always work
    knows: Array  # (knowledge_rows, W) int32; (0, 0, W) if the team shares all it knows


class Memory(NamedTuple):
    x_bits: Array  # (n, W) uint: the bits of Episode.x, the same memory
    y_bits: Array
    trail: Array  # (W, (T + 1) n, 2) real: positions, entry step * n + robot, the start first
    trail_bits: Array  # (W, (T + 1) n, 2) uint: the bits of trail, the same memory
    trail_key: Array  # (W, (T + 1) n) uint64: the first 64 bits of each trail entry
    trail_velocity: Array  # (W, (T + 1) n, 2) real, 3 with the heading; formal rules, else 0
    trail_code: Array  # (W, T + 1) int32: visit codes; formal rules only, else (W, 0)
    words: Array  # (W,) uint64: how many words of the filter are in use
    filter: Array  # (W, words) uint64: the Bloom filter in front of the trail
    pending: Array  # (W,) bool: waits for a reset
    episode: Array  # (W,) int64: number of the episode, counted from 0 at a seeded reset
    seed: Array  # (1,) int64: key of all random numbers
    key: Array  # (W,) uint64: that of what disturbs each episode; (0,) if nothing can
    draw: Array  # (1,) int64: number of the next draw of random actions
    acted: Array  # (W, n, 2) real: the actions that arrived; (0, n, 2) if undisturbed
    sensed: Array  # (count_sensed, W) real: see sight; (0, 0, W) if robots see all as it is
    plan: Array  # (W, plan_size) real: who is to visit what; (W, 0, 0) if nothing is assigned


class Output(NamedTuple):
    observations: Array  # (W, n, size) float32
    rewards: Array  # (W, n) real
    team_rewards: Array  # (W,) real
    terminated: Array  # (W,) bool
    truncated: Array  # (W,) bool
    events: Array  # (n, W) int32, see rewards.WALL ...
    outcomes: Array  # (W,) int32, see rewards.SUCCESS ...
    final_observations: Array  # (W, n, size) float32, where an episode has ended


def make_episode(
    worlds: int, n: int, config: NavigationConfig, teams_vary: bool = False, xp: ModuleType = np
) -> Episode:
    """Zeroed episode arrays; ``xp`` is numpy or torch, which puts them on its default device."""
    robots, real = (n, worlds), getattr(xp, config.dtype)
    headings = (count_headings(config.of_each("dynamics", n)), worlds)
    reals = {name: xp.zeros(robots, dtype=real) for name in Episode._fields[:7]}
    reals |= {name: xp.zeros(headings, dtype=real) for name in ("heading", "cos", "sin")}
    off = (0, 0, worlds)
    sent, rows = 2 * n * (config.action_delay + 1), rows_drawn(config, n)
    own = (knowledge_rows(config, n), worlds) if config.knowledge == "own" else off
    return Episode(
        **reals,
        wall_hits=xp.zeros(robots, dtype=xp.int32),
        returns=xp.zeros(robots, dtype=xp.float64),
        team_return=xp.zeros(worlds, dtype=xp.float64),
        visited=xp.zeros(worlds, dtype=xp.int32),
        codes=xp.zeros(worlds, dtype=xp.int32),
        steps=xp.zeros(worlds, dtype=xp.int32),
        gust=xp.zeros((2, worlds) if any_on(config, ("gust",)) else off, dtype=real),
        queue=xp.zeros((sent, worlds) if any_on(config, OF_ACTIONS) else off, dtype=real),
        drawn=xp.zeros((rows, worlds) if rows else off, dtype=real),
        status=xp.zeros(robots if config.failures or teams_vary else off, dtype=xp.int8),
        knows=xp.zeros(own, dtype=xp.int32),
    )


def make_memory(
    worlds: int, n: int, m: int, config: NavigationConfig, now: Episode, xp: ModuleType = np
) -> Memory:
    real = getattr(xp, config.dtype)
    length = config.max_steps + 1
    formal = config.reward.rules == "formal"
    motion = 3 if now.heading.shape[0] else 2
    sensed = (count_sensed(n, m), worlds) if any_on(config, OF_SIGHT) else (0, 0, worlds)
    plan = (worlds, plan_size(n, m)) if config.assignment else (worlds, 0, 0)
    keyed = any_on(config, (*DISTURBANCES, "comm_loss")) or is_drawn(config)
    keyed |= config.failures is not None
    words = filter_size(length * (1 if formal else n)) + ODD_LINES
    # As long as an episode can get; of zeros, so that NumPy takes memory only for what is written.
    trail = xp.zeros((worlds, length * n, 2), dtype=real)
    memory = Memory(
        x_bits=now.x,
        y_bits=now.y,
        trail=trail,
        trail_bits=trail,
        trail_key=trail,
        trail_velocity=xp.zeros((worlds, length * n * formal, motion), dtype=real),
        trail_code=xp.zeros((worlds, length * formal), dtype=xp.int32),
        words=xp.full((worlds,), filter_size(1), dtype=xp.uint64),
        filter=xp.zeros((worlds, words), dtype=xp.uint64),
        pending=xp.ones(worlds, dtype=xp.bool),
        episode=xp.full((worlds,), -1, dtype=xp.int64),
        seed=xp.zeros(1, dtype=xp.int64),
        key=xp.zeros(worlds if keyed else 0, dtype=xp.uint64),
        draw=xp.zeros(1, dtype=xp.int64),
        acted=xp.zeros((worlds if now.queue.ndim == 2 else 0, n, 2), dtype=real),
        sensed=xp.zeros(sensed, dtype=real),
        plan=xp.full(plan, -1, dtype=real),  # nothing is assigned
    )
    return share_bits(memory, now, xp)


def share_bits(memory: Memory, now: Episode, xp: ModuleType = np) -> Memory:
    """The memory, whose arrays that view another array do so again, as after a copy."""
    bits = xp.uint32 if now.x.dtype == xp.float32 else xp.uint64
    return memory._replace(
        x_bits=now.x.view(bits),
        y_bits=now.y.view(bits),
        trail_bits=memory.trail.view(bits),
        trail_key=memory.trail.view(xp.uint64)[..., 0],
    )


def make_output(
    worlds: int, n: int, size: int, config: NavigationConfig, xp: ModuleType = np
) -> Output:
    rows, own = (worlds, n, size), getattr(xp, config.dtype)
    return Output(
        observations=xp.zeros(rows, dtype=xp.float32),
        rewards=xp.zeros((worlds, n), dtype=own),
        team_rewards=xp.zeros(worlds, dtype=own),
        terminated=xp.zeros(worlds, dtype=xp.bool),
        truncated=xp.zeros(worlds, dtype=xp.bool),
        events=xp.zeros((n, worlds), dtype=xp.int32),
        outcomes=xp.zeros(worlds, dtype=xp.int32),
        final_observations=xp.zeros(rows, dtype=xp.float32),
    )
