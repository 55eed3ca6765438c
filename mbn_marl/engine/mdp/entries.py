"""The parts that several observations share.

Source: this package.
"""

from __future__ import annotations

from mbn_marl.jit.compile import compiled

Row = tuple[str, float, float, str]
"""An entry: its name, bounds and unit."""


def heading_rows(robot: str, turns: bool) -> list[Row]:
    """The entries of a robot's heading, if any robot has one."""
    return [(f"{robot}_{name}", -1.0, 1.0, f"{name} of heading") for name in ("cos", "sin")] * turns


def flag_row(robot: str, flag: str) -> list[Row]:
    """The entry that says whether a robot has failed or is absent, if robots can be."""
    return [(f"{robot}_{flag}", 0.0, 1.0, "flag")] * bool(flag)


@compiled
def put_heading(ep, lo, hi, i, tile, k):
    """The cosine and the sine of robot i's heading, both 0 if it has none."""
    for w in range(lo, hi):
        tile[k, w - lo] = ep.cos[i, w]
        tile[k + 1, w - lo] = ep.sin[i, w]


@compiled
def put_own_motion(p, ep, lo, hi, i, tile, k):
    """Robot i's own velocity and heading, from entry k on; how many entries there are by then."""
    for w in range(lo, hi):
        tile[k, w - lo] = ep.vx[i, w] * p.per_speed
        tile[k + 1, w - lo] = ep.vy[i, w] * p.per_speed
    if p.headings > 0:
        put_heading(ep, lo, hi, i, tile, k + 2)
        return k + 4
    return k + 2
