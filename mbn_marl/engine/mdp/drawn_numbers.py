"""Numbers of the configuration that each episode draws (conditions.md, "Drawn numbers")."""

# ``Episode.drawn`` has them for each world: what they are made into, then the numbers themselves.
# If nothing is drawn, ``numbers_of`` and ``limits_in`` return the constants.
#
# Source: this package.

import math
from collections import namedtuple
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import LIMITS, MAX_ROBOTS, NUMBERS, NavigationConfig, Uniform
from mbn_marl.jit.compile import compiled, generated
from mbn_marl.jit.features import Feature
from mbn_marl.jit.functions import cosine, exponential, sine, turned
from mbn_marl.jit.random_numbers import FOR_NUMBERS, stream_of, uniform

# The names of the numbers that are not a robot's own, in the order of ``numbers``.
SINGLE = ("wind_speed", "wind_angle", *NUMBERS, "failure_rate")
# The first rows of ``Episode.drawn``; those of ``SINGLE`` and of each robot follow.
MADE = (
    *("wind_x", "wind_y", "gust_kept", "gust_added", "safety_squared", "roi_squared"),
    *("failing_robot", "failing_step"),
)
WIND_X, WIND_Y, GUST_KEPT, GUST_ADDED, SAFETY, ROI, ROBOT, STEP = range(len(MADE))
SPEED, ANGLE, GUST, GUST_TIME = map(SINGLE.index, ("wind_speed", "wind_angle", *NUMBERS[:2]))
DISTANCE, RADIUS = SINGLE.index("safety_distance"), SINGLE.index("roi_radius")
FIRST, FIRST_LIMIT = len(MADE), len(MADE) + len(SINGLE)
# The rows of ``Team.limits``.
MASS, F_MAX, V_CLIP = range(len(LIMITS))
# The rows of ``Team.ranges``, whose columns are the numbers of ``SINGLE`` and each robot's.
LOW, WIDTH, COUNTER = range(3)
# The counter of the draw of the robot that fails; its step's is the next.
FAILING = 1000
RADIANS = math.pi / 180.0


NAMES = (*MADE[:ROBOT], *NUMBERS, "failure_rate")
# The constants of a step that an episode may draw, for one world.
Numbers = namedtuple("Numbers", NAMES)  # type: ignore[misc]


def _row(name: str) -> int:
    return MADE.index(name) if name in MADE else FIRST + SINGLE.index(name)


draws_numbers = Feature(lambda ep: ep.drawn.ndim == 2)

_DRAWN = ", ".join(f"ep.drawn[{_row(name)}, w]" for name in NAMES)
_FIXED = ", ".join(f"p.{name}" for name in NAMES)
# Seventeen names, twice: written by a loop over them.
# The numbers of world w: its own, or the constants ``p`` where nothing is drawn.
numbers_of = generated(
    "numbers_of",
    "def numbers_of(p, ep, w):\n"
    f"    if draws_numbers(ep):\n        return Numbers({_DRAWN})\n"
    f"    return Numbers({_FIXED})\n",
    Numbers=Numbers,
    draws_numbers=draws_numbers,
)


def is_drawn(config: NavigationConfig) -> bool:
    failures = config.failures
    return bool(config.drawn) or (failures is not None and failures.between is not None)


def _columns(config: NavigationConfig, n: int) -> list[tuple[str, float | Uniform]]:
    known = dict(config.numbers())
    own = [(limit if limit in known else f"{limit}_{i}") for limit in LIMITS for i in range(n)]
    return [(name, known[name]) for name in (*SINGLE, *own)]


def make_ranges(config: NavigationConfig, n: int) -> NDArray[np.float64]:
    """The table of what is drawn, (3, numbers): lowest value, range and counter; or (0,)."""
    if not is_drawn(config):
        return np.zeros(0)
    columns = _columns(config, n)
    counters = [*range(len(SINGLE))]
    counters += [len(SINGLE) + MAX_ROBOTS * k + i for k in range(len(LIMITS)) for i in range(n)]
    names = [name for name, _ in columns]
    first = dict(reversed([*zip(names, counters, strict=True)]))
    ends = [(v.low, v.high) if isinstance(v, Uniform) else (v, v) for _, v in columns]
    lows, highs = np.array(ends, np.float64).T
    return np.array([lows, highs - lows, [first[name] for name in names]])


def rows_drawn(config: NavigationConfig, n: int) -> int:
    return FIRST_LIMIT + len(LIMITS) * n if is_drawn(config) else 0


def drawn_limits(ranges: NDArray[np.float64], real: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """The least and the greatest value of each row of ``Episode.drawn``, (rows, 1); 0 as well."""
    most = np.full((FIRST, 1), np.finfo(real).max)
    low, high = ranges[LOW, :, None], (ranges[LOW] + ranges[WIDTH])[:, None]
    rows = np.append(-most, np.minimum(low, 0)), np.append(most, np.maximum(high, 0))
    least, greatest = (ends[:, None].astype(real) for ends in rows)
    return least, greatest


def rows_of_drawn(config: NavigationConfig, n: int) -> dict[str, int]:
    names = [name for name, _ in _columns(config, n)]
    return {name: FIRST + names.index(name) for name in config.drawn}


@compiled
def limits_of(g, i):
    """The mass, the force and the speed limit of robot i: read before a loop, kept in registers."""
    return g.team.limits[MASS, i], g.team.limits[F_MAX, i], g.team.limits[V_CLIP, i]


@compiled
def limits_in(limits, ep, i, w):
    # A speed limit that is drawn is at most that of all worlds.
    if draws_numbers(ep):
        n = (ep.drawn.shape[0] - FIRST_LIMIT) // len(LIMITS)
        first = FIRST_LIMIT + i
        top = min(ep.drawn[first + 2 * n, w], limits[V_CLIP])
        return ep.drawn[first, w], ep.drawn[first + n, w], top
    return limits


@compiled
def draw(ranges, key, k):
    return ranges[LOW, k] + ranges[WIDTH, k] * np.float64(uniform(key, ranges[COUNTER, k]))


@compiled
def varies(ranges, k):
    return ranges[WIDTH, k] > 0.0


@compiled
def squared(number):
    return number * number


@compiled
def is_failing_step(ep, i, step, w):
    if draws_numbers(ep):
        return (ep.drawn[STEP, w] == step) & (ep.drawn[ROBOT, w] == i)
    return False


@compiled
def draw_numbers(p, g, ep, episode_key, team, w):
    ranges, drawn = g.team.ranges, ep.drawn
    if draws_numbers(ep):
        key = stream_of(episode_key, FOR_NUMBERS)
        for k in range(ranges.shape[1]):
            drawn[FIRST + k, w] = draw(ranges, key, k)
        drawn[WIND_X, w], drawn[WIND_Y, w] = p.wind_x, p.wind_y
        if varies(ranges, SPEED) | varies(ranges, ANGLE):
            speed = draw(ranges, key, SPEED)
            angle = turned(0.0, draw(ranges, key, ANGLE) * RADIANS, math.pi)
            drawn[WIND_X, w], drawn[WIND_Y, w] = speed * cosine(angle), speed * sine(angle)
        drawn[GUST_KEPT, w], drawn[GUST_ADDED, w] = p.gust_kept, p.gust_added
        if varies(ranges, GUST) | varies(ranges, GUST_TIME):
            kept = exponential(-1.0 / draw(ranges, key, GUST_TIME))
            drawn[GUST_KEPT, w] = kept
            drawn[GUST_ADDED, w] = draw(ranges, key, GUST) * math.sqrt(1.0 - kept * kept)
        drawn[SAFETY, w] = squared(draw(ranges, key, DISTANCE))
        drawn[ROI, w] = squared(draw(ranges, key, RADIUS))
        # One of the robots that are there fails, in a step of the range; 0 is none.
        count = p.failing_last - p.failing_first + 1
        drawn[ROBOT, w] = np.int64(np.float64(uniform(key, FAILING)) * team)
        step = p.failing_first + np.int64(np.float64(uniform(key, FAILING + 1)) * count)
        drawn[STEP, w] = step if p.failing_last > 0 else 0
