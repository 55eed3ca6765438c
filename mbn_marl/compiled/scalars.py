"""Small functions on scalars that the rules share."""

from __future__ import annotations

import numpy as np

from mbn_marl.compiled.jit import compiled

FIRST = np.uint64(0)
HALF, MANY = np.float32(0.5), np.float32(1e6)


@compiled
def select(condition, a, b):
    """``a`` if the condition holds, else ``b``, without a branch: both have been read."""
    return a if condition else b


@compiled
def clip(value, low, high):
    """``value`` limited to ``[low, high]``."""
    return min(max(value, low), high)


@compiled
def is_set(word, flag):
    """Return whether ``flag`` is set in ``word``."""
    return (word & flag) != 0


@compiled
def count_bits(word):
    """How many bits of a non-negative integer are set."""
    count = 0
    while word != 0:
        word &= word - 1
        count += 1
    return count


@compiled
def column(g, w):
    """The column of world w in the tables of ``g``, which have one for all worlds, or one each."""
    return np.uint64(w) if g.codes.shape[0] > 1 else FIRST
