"""Revisit memory: was a robot, or the whole team, here before? (mdp.md, "One step", 4)."""

# The memory *is* the episode's trajectory, kept in full (``trail``), so answers are exact. A Bloom
# filter in front of it, five bits in one 64-bit word per key, settles nearly every question with a
# single memory access: a key with an unset bit is new for certain. Only where all bits are set (a
# true revisit, or by chance, under 1 %) is the trajectory searched. A robot at rest is known.
#
# A world's filter doubles as its episode gets longer, and is then filled again from the trajectory:
# short episodes touch little memory, and that, not arithmetic, is what limits a large batch.
#
# Source: Choton, Woods, Hsu, section 3 (R_V, on joint states), and the authors' released code (on
# the positions of robots).

import numpy as np

from mbn_marl.jit.compile import compiled
from mbn_marl.jit.random_numbers import GOLDEN, mix

BITS_PER_KEY = 16
KEYS_PER_WORD = np.uint64(64 // BITS_PER_KEY)
BITS_SET = 5
LEAST_WORDS = 32
# Filters lie an odd number of cache lines apart, so that they spread over all cache sets.
ODD_LINES = 8

ONE = np.uint64(1)
BIT = np.uint64(63)
HALF_WORD = np.uint64(32)
CHUNK = np.uint64(64)
EMPTY = np.uint64(0)


def filter_size(keys: int) -> int:
    """The number of 64-bit words, a power of two, that filter ``keys`` keys."""
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
    mask = ONE << (key & BIT)
    for k in range(1, BITS_SET):
        mask |= ONE << ((key >> np.uint64(6 * k)) & BIT)
    return mask


@compiled
def filter_word(key, words):
    return (key >> HALF_WORD) & (words - ONE)


@compiled
def add_bits(filters, world, place, mask):
    word = filters[world, place]
    filters[world, place] = word | mask
    return (word & mask) == mask


@compiled
def clear_filter(filters, world, words):
    for k in range(words):
        filters[world, k] = EMPTY


@compiled
def refill_filter(filters, trail_bits, world, first, end, words):
    clear_filter(filters, world, words)
    for k in range(first, end):
        key = hash_position(trail_bits[world, k, 0], trail_bits[world, k, 1])
        add_bits(filters, world, filter_word(key, words), filter_mask(key))


@compiled
def stood_on(trail, trail_key, world, first, entry):
    """Return whether an entry of the trail from ``first`` to before ``entry`` has its position."""
    # Searched backwards, since a robot that returns mostly returns to where it has just been, and
    # in chunks without early exit, which vectorise. Keys that are equal are compared in full.
    key = trail_key[world, entry]
    stop = entry
    while stop > first:
        start = max(stop, first + CHUNK) - CHUNK
        matches = 0
        for k in range(start, stop):
            matches += trail_key[world, k] == key
        if matches > 0:
            for k in range(start, stop):
                same_x = trail[world, k, 0] == trail[world, entry, 0]
                if same_x and trail[world, k, 1] == trail[world, entry, 1]:
                    return True
        stop = start
    return False


@compiled
def same_joint_state(mem, now, w, step, code):
    same = mem.trail_code[w, step] == code
    n = now.x.shape[0]
    for i in range(n):
        k = step * n + i
        same &= (mem.trail[w, k, 0] == now.x[i, w]) & (mem.trail[w, k, 1] == now.y[i, w])
        same &= mem.trail_velocity[w, k, 0] == now.vx[i, w]
        same &= mem.trail_velocity[w, k, 1] == now.vy[i, w]
        if mem.trail_velocity.shape[2] > 2:
            same &= mem.trail_velocity[w, k, 2] == now.heading[i, w]
    return same


@compiled
def joint_state_known(mem, now, w, code):
    """R_V: was this joint state met before in the episode? It is noted either way."""
    # The state at the start counts as met. The filter is keyed by positions and code, which differ
    # in nearly all distinct states; the trail decides.
    n = now.x.shape[0]
    step = min(now.steps[w], mem.trail_code.shape[1] - 1)
    key = mix(np.uint64(code))
    for i in range(n):
        key = mix(key + np.uint64(mem.x_bits[i, w]) * GOLDEN)
        key = mix(key + np.uint64(mem.y_bits[i, w]) * GOLDEN)
    known = False
    if add_bits(mem.filter, w, filter_word(key, mem.words[w]), filter_mask(key)):
        for back in range(1, step + 1):
            known = known or same_joint_state(mem, now, w, step - back, code)
    for i in range(n):
        k = step * n + i
        mem.trail[w, k, 0] = now.x[i, w]
        mem.trail[w, k, 1] = now.y[i, w]
        mem.trail_velocity[w, k, 0] = now.vx[i, w]
        mem.trail_velocity[w, k, 1] = now.vy[i, w]
        if mem.trail_velocity.shape[2] > 2:
            mem.trail_velocity[w, k, 2] = now.heading[i, w]
    mem.trail_code[w, step] = code
    return known
