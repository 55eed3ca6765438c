"""Counter-based random numbers: each is a hash of what it is for, so no state is carried along."""

# The key is (seed, world, episode, purpose, counter). A world therefore draws the same numbers
# whatever the batch size, the thread count or the device. The mixer is the finaliser of SplitMix64
# (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", 2014).

from __future__ import annotations

import numpy as np

from mbn_marl.jit.compile import compiled

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
MIX_2 = np.uint64(0x94D049BB133111EB)
SHIFT_30, SHIFT_27, SHIFT_31 = np.uint64(30), np.uint64(27), np.uint64(31)
TO_UNIT_SHIFT = np.uint64(40)
TO_UNIT = np.float32(2.0**-24)

FOR_STARTS = np.uint64(1)
FOR_ACTIONS = np.uint64(2)
FOR_FAILURES = np.uint64(3)
FOR_GUSTS = np.uint64(4)
FOR_SENDING = np.uint64(5)
FOR_SIGHT = np.uint64(6)
FOR_NUMBERS = np.uint64(7)
FOR_FIELDS = np.uint64(8)
FOR_DECOYS = np.uint64(9)
FOR_TELLING = np.uint64(10)

# The start of the 40 bits that are counted; below them are two numbers of twelve bits.
HIGH, LOW, TWELVE = np.uint64(24), np.uint64(0xFFF), np.uint64(12)
PAIRS, QUADS = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
BYTES, EACH_BYTE = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)
BY_1, BY_2, BY_4, TOP_BYTE = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)
PER_ONE, CENTRE = np.int32(4096), np.int32(21 * 4096 - 1)
TO_ONES = np.float32(1 / 4096)
# Of the sum of bits, so that variance and kurtosis are those of the normal distribution.
LINEAR, CUBIC = np.float32(0.31164049), np.float32(6.6003307e-5)


@compiled
def mix(bits):
    """Scramble 64 bits; a bijection in which each input bit moves about half of the output bits."""
    bits = (bits ^ (bits >> SHIFT_30)) * MIX_1
    bits = (bits ^ (bits >> SHIFT_27)) * MIX_2
    return bits ^ (bits >> SHIFT_31)


@compiled
def world_number(p, w):
    """The number of the world with index w: its place in all random numbers."""
    return np.uint64(w) + np.uint64(p.first_world)


@compiled
def episode_key(seed, world, episode):
    key = mix(np.uint64(seed) + GOLDEN)
    key = mix(key + np.uint64(world) + GOLDEN)
    return mix(key + np.uint64(episode) + GOLDEN)


@compiled
def stream_of(key, purpose):
    return mix(key + purpose + GOLDEN)


@compiled
def stream_key(seed, world, episode, purpose):
    return stream_of(episode_key(seed, world, episode), purpose)


@compiled
def uniform(key, counter):
    """The ``counter``-th number of a stream: float32, uniform on [0, 1), 24 random bits."""
    return np.float32(mix(key + np.uint64(counter) * GOLDEN) >> TO_UNIT_SHIFT) * TO_UNIT


@compiled
def normal(key, counter):
    """The ``counter``-th number of a stream: float32, normal with mean 0 and variance 1."""
    # The ones among 40 random bits are binomial; two random numbers of twelve bits fill the gaps
    # between whole numbers, and a cubic corrects the kurtosis. The distribution function differs
    # from the normal one by less than 1.3e-4, and no number is above 7.2.
    bits = mix(key + np.uint64(counter) * GOLDEN)
    counts = bits >> HIGH
    counts -= (counts >> BY_1) & PAIRS
    counts = (counts & QUADS) + ((counts >> BY_2) & QUADS)
    counts = (counts + (counts >> BY_4)) & BYTES
    ones = np.int32((counts * EACH_BYTE) >> TOP_BYTE)
    fill = np.int32((bits & LOW) + ((bits >> TWELVE) & LOW))
    t = np.float32(ones * PER_ONE + fill - CENTRE) * TO_ONES
    return t * (LINEAR + CUBIC * (t * t))
