"""Revisit memory: has any robot of this world stood exactly here? (mdp.md, step 4).

The memory *is* the episode's trajectory, kept in full (``trail``), so answers are exact. A Bloom
filter in front of it, five bits in one 64-bit word per key, settles nearly every question with a
single memory access: a key with an unset bit is new for certain. Only where all bits are set (a
true revisit, or by chance, under 1 %) is the trajectory searched. A robot at rest is known.

A world's filter doubles as its episode gets longer, and is then filled anew from the trajectory:
short episodes touch little memory, and that, not arithmetic, is what limits a large batch.
"""

from __future__ import annotations

import numpy as np

from mbn_marl.engine.compiling import compiled
from mbn_marl.engine.rng import GOLDEN, mix

BITS_PER_KEY = 16
KEYS_PER_WORD = np.uint64(64 // BITS_PER_KEY)
BITS_SET = 5
LEAST_WORDS = 32
ODD_LINES = 8
"""Filters lie an odd number of cache lines apart, lest they all compete for the same few sets."""

ONE = np.uint64(1)
BIT = np.uint64(63)
HALF_WORD = np.uint64(32)
CHUNK = np.uint64(64)
EMPTY = np.uint64(0)


def filter_size(keys: int) -> int:
    """How many 64-bit words, a power of two, filter ``keys`` keys."""
    words = LEAST_WORDS
    while words * 64 < keys * BITS_PER_KEY:
        words *= 2
    return words


@compiled
def hash_position(x_bits, y_bits):
    """64 mixed bits of a position; half-integer ones, made by full thrust, need mixing most."""
    return mix(mix(np.uint64(x_bits)) + np.uint64(y_bits) * GOLDEN)


@compiled
def filter_mask(key):
    """The five bits of the filter word that stand for ``key``."""
    mask = ONE << (key & BIT)
    for k in range(1, BITS_SET):
        mask |= ONE << ((key >> np.uint64(6 * k)) & BIT)
    return mask


@compiled
def filter_word(key, words):
    """Which of the ``words`` filter words stands for ``key``: its upper bits."""
    return (key >> HALF_WORD) & (words - ONE)


@compiled
def add_bits(filters, world, place, mask):
    """Set the bits of ``mask`` in word ``place`` of the world's filter; whether all were set."""
    word = filters[world, place]
    filters[world, place] = word | mask
    return (word & mask) == mask


@compiled
def clear_filter(filters, world, words):
    """Forget all keys."""
    for k in range(words):
        filters[world, k] = EMPTY


@compiled
def refill_filter(filters, trail_bits, world, first, end, words):
    """Fill the filter, now of ``words`` words, with trail entries ``first`` to ``end - 1``."""
    clear_filter(filters, world, words)
    for k in range(first, end):
        key = hash_position(trail_bits[world, k, 0], trail_bits[world, k, 1])
        add_bits(filters, world, filter_word(key, words), filter_mask(key))


@compiled
def stood_on(trail, trail_key, world, first, entry):
    """Whether the position in trail entry ``entry`` is also in one from ``first`` to before it.

    Searched backwards, since a robot that returns mostly returns to where it has just been, and in
    chunks without early exit, which vectorise. Keys that are equal are compared in full.
    """
    key = trail_key[world, entry]
    stop = entry
    while stop > first:
        start = max(stop, first + CHUNK) - CHUNK
        matches = 0
        for k in range(start, stop):
            matches += trail_key[world, k] == key
        if matches > 0:
            for k in range(start, stop):
                if (
                    trail[world, k, 0] == trail[world, entry, 0]
                    and trail[world, k, 1] == trail[world, entry, 1]
                ):
                    return True
        stop = start
    return False
