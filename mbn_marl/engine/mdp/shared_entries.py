"""The entries that several observations share."""

from __future__ import annotations

from typing import Any, NamedTuple

from mbn_marl.jit.compile import compiled

Row = tuple[str, float, float, str]
"""An entry: its name, bounds and unit."""


class View(NamedTuple):
    """Robot i in a block of worlds, and all that its observation is made of."""

    p: Any
    g: Any
    mem: Any
    ep: Any
    robots: Any  # the robots as robot i senses them: ``ep``, or ``sight.SensedRobots``
    i: Any
    lo: Any
    hi: Any
    tile: Any  # (size, at least hi - lo) float32: an entry a row, worlds side by side


def heading_rows(robot: str, turns: bool) -> list[Row]:
    """The entries of a robot's heading, if any robot has one."""
    return [(f"{robot}_{name}", -1.0, 1.0, f"{name} of heading") for name in ("cos", "sin")] * turns


def flag_row(robot: str, flag: str) -> list[Row]:
    """The entry that says whether a robot has failed or is absent, if robots can be."""
    return [(f"{robot}_{flag}", 0.0, 1.0, "flag")] * bool(flag)


@compiled
def put_heading(view, j, k):
    """The cosine and the sine of robot j's heading, both 0 if it has none; how many entries."""
    if view.p.headings == 0:
        return 0
    for w in range(view.lo, view.hi):
        view.tile[k, w - view.lo] = view.robots.cos[j, w]
        view.tile[k + 1, w - view.lo] = view.robots.sin[j, w]
    return 2


@compiled
def put_own_motion(view, k):
    """Robot i's own velocity and heading, from entry k on; how many entries there are by then."""
    p, robots, i = view.p, view.robots, view.i
    for w in range(view.lo, view.hi):
        view.tile[k, w - view.lo] = robots.vx[i, w] * p.per_speed
        view.tile[k + 1, w - view.lo] = robots.vy[i, w] * p.per_speed
    return k + 2 + put_heading(view, i, k + 2)
