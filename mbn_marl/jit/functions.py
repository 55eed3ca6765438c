"""Sine, cosine, tangent, exponential and length, the same bits on every processor."""

# They are made from + - x / and the square root, which all processors round alike; libraries
# differ in the last bit of them. Here they are float64 whatever the engine's precision, and no two
# operations are fused: the series of the sine, up to its term of degree 21, about the nearest point
# where the function is 0. Absolute errors are below 4e-16, a tangent's relative to its square.
# The exponential is its series for a part of x, squared. The length is a root, corrected once
# (specification.md, "Arithmetic").

from __future__ import annotations

import math

import numpy as np

from mbn_marl.jit.compile import compiled, generated

FIRST = np.uint64(0)
HALF, MANY = np.float32(0.5), np.float32(1e6)
PI, HALF_PI = math.pi, math.pi / 2


@compiled
def select(condition, a, b):
    """``a`` if the condition holds, else ``b``, without a branch: both have been read."""
    return a if condition else b


@compiled
def clip(value, low, high):
    return min(max(value, low), high)


@compiled
def is_set(word, flag):
    return (word & flag) != 0


@compiled
def count_bits(word):
    count = 0
    while word != 0:
        word &= word - 1
        count += 1
    return count


@compiled
def column(g, w):
    """The column of world w in the tables of ``g``, which have one for all worlds, or one each."""
    return np.uint64(w) if g.codes.shape[0] > 1 else FIRST


def _horner(coefficients: list[float]) -> str:
    """The source of a polynomial in ``x``, lowest power first, one product and sum a power."""
    *lower, text = map(repr, coefficients)
    for coefficient in reversed(lower):
        text = f"({text}) * x + {coefficient}"
    return text


SINE = [(-1.0) ** k / math.factorial(2 * k + 1) for k in range(11)]
# ``sin(a) / a`` from ``x = a^2``, for a in [-pi/2, pi/2].
sine_series = generated("series", f"def series(x):\n    return {_horner(SINE)}\n")

# ``exp(x)`` for x in [-1.25, 0], from powers of x.
EXPONENTIAL = [1.0 / math.factorial(k) for k in range(23)]
HALVINGS, LEAST = 5, -40.0
# ``exp(x)`` for x of at most 0, float64, to 3e-14 of it; below -40 it is that of -40.
exponential = generated(
    "exponential",
    "def exponential(x):\n"
    f"    x = max(x, {LEAST}) / {2.0**HALVINGS}\n"
    f"    power = {_horner(EXPONENTIAL)}\n"
    f"    for _ in range({HALVINGS}):\n        power *= power\n    return power\n",
)


@compiled
def sine(angle):
    x = np.float64(angle)
    x = select(x > HALF_PI, PI - x, select(x < -HALF_PI, -PI - x, x))
    return clip(x * sine_series(x * x), -1.0, 1.0)


@compiled
def cosine(angle):
    x = HALF_PI - abs(np.float64(angle))
    return clip(x * sine_series(x * x), -1.0, 1.0)


@compiled
def tangent(angle):
    return sine(angle) / cosine(angle)


@compiled
def turned(heading, turn, pi):
    angle, circle = heading + turn, pi + pi
    turns = angle / circle
    turns = clip(turns + select(turns > 0, HALF, -HALF), -MANY, MANY)
    angle -= np.float32(np.int32(turns)) * circle
    return select((angle >= -pi) & (angle < pi), angle, -pi)


@compiled
def length(x, y):
    """``sqrt(x^2 + y^2)``, float64: the root, corrected once."""
    # Borges, "Algorithm 1014: An Improved Algorithm for hypot(x, y)", without fused operations.
    a, b = abs(np.float64(x)), abs(np.float64(y))
    most, least = max(a, b), min(a, b)
    root = math.sqrt(most * most + least * least)
    if root <= 2.0 * least:
        rest = root - least
        error = most * (2.0 * rest - most) + (rest - 2.0 * (most - least)) * rest
    else:
        rest = root - most
        error = 2.0 * rest * (most - 2.0 * least) + ((4.0 * rest - least) * least + rest * rest)
    return root - error / (2.0 * root) if root > 0.0 else root
