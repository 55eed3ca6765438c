"""Counter-based random numbers: each is a hash of what it is for, so no state is carried along.

The key is (seed, world, episode, purpose, counter). A world therefore draws the same numbers
whatever the batch size, the thread count or the device. The mixer is the finaliser of SplitMix64
(Steele, Lea, Flood, "Fast splittable pseudorandom number generators", 2014).
"""

from __future__ import annotations

import numpy as np

from mbn_marl.engine.jit import compiled

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
MIX_2 = np.uint64(0x94D049BB133111EB)
SHIFT_30, SHIFT_27, SHIFT_31 = np.uint64(30), np.uint64(27), np.uint64(31)
TO_UNIT_SHIFT = np.uint64(40)
TO_UNIT = np.float32(2.0**-24)

FOR_STARTS = np.uint64(1)
FOR_ACTIONS = np.uint64(2)


@compiled
def mix(bits):
    """Scramble 64 bits; a bijection in which each input bit moves about half of the output bits."""
    bits = (bits ^ (bits >> SHIFT_30)) * MIX_1
    bits = (bits ^ (bits >> SHIFT_27)) * MIX_2
    return bits ^ (bits >> SHIFT_31)


@compiled
def stream_key(seed, world, episode, purpose):
    """The key of one stream of random numbers."""
    key = mix(np.uint64(seed) + GOLDEN)
    key = mix(key + np.uint64(world) + GOLDEN)
    key = mix(key + np.uint64(episode) + GOLDEN)
    return mix(key + purpose + GOLDEN)


@compiled
def uniform(key, counter):
    """The ``counter``-th number of a stream: float32, uniform on [0, 1), 24 random bits."""
    return np.float32(mix(key + np.uint64(counter) * GOLDEN) >> TO_UNIT_SHIFT) * TO_UNIT
