"""The engine's data: named tuples of arrays, which kernels take whole.

W is the number of worlds, n robots, m ROIs, E edges, F fields, T = max_steps. Robot quantities are
structure-of-arrays, ``[robot, world]``, so that a loop over worlds reads and writes contiguously.
``real`` is the engine's dtype, float32 or float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.engine.memory import ODD_LINES, filter_size
from mbn_marl.field import Field

Array = NDArray[Any]


class Geometry(NamedTuple):
    """The fields of a batch, padded to common sizes, and the robots' masses."""

    edges: Array  # (4, E, F) real: ax, ay, bx, by; padding edges are a single vertex
    rois: Array  # (2, m, F) real
    starts: Array  # (2, n, F) real
    roi_bits: Array  # (m, F) int32: the bit of each ROI in the visit code, first ROI highest
    codes: Array  # (F,) int32: the visit code with all ROIs visited; bits above it are padding
    boxes: Array  # (4, F) real: lowest x, lowest y, width and height of each field
    masses: Array  # (n,) real


class Episode(NamedTuple):
    """Everything about one episode of each world that a reset clears."""

    x: Array  # (n, W) real, units
    y: Array
    vx: Array  # (n, W) real, units/step
    vy: Array
    impulse_x: Array  # (n, W) real: sum over steps of u tau
    impulse_y: Array
    path_length: Array  # (n, W) real, units
    wall_hits: Array  # (n, W) int32
    returns: Array  # (n, W) float64: what each agent has been given
    team_return: Array  # (W,) float64
    visited: Array  # (W,) int32: the visit code, and padding ROIs set from the start
    steps: Array  # (W,) int32


class Memory(NamedTuple):
    """What outlives or supports an episode."""

    x_bits: Array  # (n, W) uint: the bits of Episode.x, the same memory
    y_bits: Array
    trail: Array  # (W, (T + 1) n, 2) real: positions, entry step * n + robot, the start first
    trail_bits: Array  # (W, (T + 1) n, 2) uint: the bits of trail, the same memory
    trail_key: Array  # (W, (T + 1) n) uint64: the first 64 bits of each trail entry
    trail_velocity: Array  # (W, (T + 1) n, 2) real; formal rules only, else (W, 0, 2)
    trail_code: Array  # (W, T + 1) int32: visit codes; formal rules only, else (W, 0)
    words: Array  # (W,) uint64: how many words of the filter are in use
    filter: Array  # (W, words) uint64: the Bloom filter in front of the trail
    field: Array  # (W,) int32: the world's field
    pending: Array  # (W,) bool: waits for a reset
    episode: Array  # (W,) int64: number of the episode, counted from 0 at a seeded reset


class Output(NamedTuple):
    """What a step hands out; overwritten by the next one."""

    observations: Array  # (W, n, size) float32
    rewards: Array  # (W, n) real
    team_rewards: Array  # (W,) real
    terminated: Array  # (W,) bool
    truncated: Array  # (W,) bool
    events: Array  # (n, W) int32, see rewards.WALL ...
    outcomes: Array  # (W,) int32, see rewards.SUCCESS ...
    final_observations: Array  # (W, n, size) float32, where an episode has ended


def make_geometry(fields: Sequence[Field], config: NavigationConfig, n: int) -> Geometry:
    """Tables of the batch's fields. ROIs and edges are padded to the largest field."""
    real = np.dtype(config.dtype)
    count = len(fields)
    m = max(len(field.rois) for field in fields)
    most_edges = max(len(field.edges) for field in fields)
    edges = np.zeros((4, most_edges, count), real)
    rois = np.zeros((2, m, count), real)
    starts = np.zeros((2, n, count), real)
    roi_bits = np.zeros((m, count), np.int32)
    codes = np.zeros(count, np.int32)
    boxes = np.zeros((4, count), real)
    for f, field in enumerate(fields):
        own = len(field.rois)
        edges[:, :, f] = np.tile(field.vertices[0], 2)[:, None]
        edges[:, : len(field.edges), f] = field.edges.T
        rois[:, :, f] = field.rois[0][:, None]
        rois[:, :own, f] = field.rois.T
        starts[:, :, f] = field.starts[:n].T
        roi_bits[:, f] = [1 << (own - 1 - j) if j < own else 1 << j for j in range(m)]
        codes[f] = (1 << own) - 1
        boxes[:2, f] = field.vertices.min(axis=0)
        boxes[2:, f] = np.ptp(field.vertices, axis=0)
    masses = np.broadcast_to(np.asarray(config.mass, real), (n,)).copy()
    return Geometry(edges, rois, starts, roi_bits, codes, boxes, masses)


def make_episode(worlds: int, n: int, real: np.dtype[Any]) -> Episode:
    """Zeroed episode arrays."""
    robots = (n, worlds)
    reals = {name: np.zeros(robots, real) for name in Episode._fields[:7]}
    return Episode(
        **reals,
        wall_hits=np.zeros(robots, np.int32),
        returns=np.zeros(robots, np.float64),
        team_return=np.zeros(worlds, np.float64),
        visited=np.zeros(worlds, np.int32),
        steps=np.zeros(worlds, np.int32),
    )


def make_memory(worlds: int, n: int, config: NavigationConfig, now: Episode, fields: int) -> Memory:
    """Zeroed memory; trails are only touched, and so only cost memory, as far as episodes get."""
    real = np.dtype(config.dtype)
    bits = np.uint32 if real.itemsize == 4 else np.uint64
    length = config.max_steps + 1
    formal = config.reward.rules == "formal"
    words = filter_size(config.max_steps * (1 if formal else n)) + ODD_LINES
    trail = np.empty((worlds, length * n, 2), real)
    return Memory(
        x_bits=now.x.view(bits),
        y_bits=now.y.view(bits),
        trail=trail,
        trail_bits=trail.view(bits),
        trail_key=trail.view(np.uint64)[..., 0],
        trail_velocity=np.empty((worlds, length * n * formal, 2), real),
        trail_code=np.empty((worlds, length * formal), np.int32),
        words=np.zeros(worlds, np.uint64),
        filter=np.zeros((worlds, words), np.uint64),
        field=np.arange(worlds, dtype=np.int32) % np.int32(fields),
        pending=np.ones(worlds, np.bool_),
        episode=np.full(worlds, -1, np.int64),
    )


def make_output(worlds: int, n: int, size: int, real: np.dtype[Any]) -> Output:
    """Zeroed output arrays."""
    return Output(
        observations=np.zeros((worlds, n, size), np.float32),
        rewards=np.zeros((worlds, n), real),
        team_rewards=np.zeros(worlds, real),
        terminated=np.zeros(worlds, np.bool_),
        truncated=np.zeros(worlds, np.bool_),
        events=np.zeros((n, worlds), np.int32),
        outcomes=np.zeros(worlds, np.int32),
        final_observations=np.zeros((worlds, n, size), np.float32),
    )
