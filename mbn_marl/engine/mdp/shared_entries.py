"""The entries that several observations share."""

from __future__ import annotations

from typing import Any, NamedTuple

from mbn_marl.jit.compile import compiled

Row = tuple[str, float, float, str]
"""An entry: its name, bounds and unit."""


class View(NamedTuple):
    """The observer, robot i of an episode, and what its observation is made of and written to."""

    mem: Any
    ep: Any
    robots: Any  # the robots as robot i senses them: ``ep``, or ``sight.SensedRobots``
    i: Any
    tile: Any  # (size, at least hi - lo) float32: an entry a row, worlds side by side


def heading_rows(robot: str, turns: bool) -> list[Row]:
    return [(f"{robot}_{name}", -1.0, 1.0, f"{name} of heading") for name in ("cos", "sin")] * turns


def flag_row(robot: str, flag: str) -> list[Row]:
    return [(f"{robot}_{flag}", 0.0, 1.0, "flag")] * bool(flag)


@compiled
def put_heading(p, view, lo, hi, j, k):
    """The cosine and the sine of robot j's heading, both 0 if it has none; how many entries."""
    if p.headings == 0:
        return 0
    for w in range(lo, hi):
        view.tile[k, w - lo] = view.robots.cos[j, w]
        view.tile[k + 1, w - lo] = view.robots.sin[j, w]
    return 2


@compiled
def put_own_motion(p, view, lo, hi, k):
    robots, i = view.robots, view.i
    for w in range(lo, hi):
        view.tile[k, w - lo] = robots.vx[i, w] * p.per_speed
        view.tile[k + 1, w - lo] = robots.vy[i, w] * p.per_speed
    return k + 2 + put_heading(p, view, lo, hi, i, k + 2)
