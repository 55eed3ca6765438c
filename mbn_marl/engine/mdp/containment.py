"""Which points are in the field F, a closed set (mdp.md, "One step", 2).

Source: Choton, Woods, Hsu, section 3, where F bounds the robots' positions.
"""

from __future__ import annotations

from mbn_marl.jit.compile import compiled
from mbn_marl.jit.functions import column

EDGE_CROSSED = 1
ON_EDGE = 2


@compiled
def cross_edge(seen, px, py, ax, ay, bx, by):
    """Account for the edge a-b of the field in the containment test of point p.

    A ray from p to +x crosses the outline an odd number of times if p is inside (bit
    ``EDGE_CROSSED`` of ``seen``); a point on an edge belongs to the field (bit ``ON_EDGE``). So p
    is in the closed field exactly if ``seen`` is not zero after all edges. Holes are just more
    edges.
    """
    side = (bx - ax) * (py - ay) - (by - ay) * (px - ax)
    straddles = (ay > py) != (by > py)
    crossed = straddles & ((side > 0) == (by > ay))
    between = (px - ax) * (px - bx) + (py - ay) * (py - by) <= 0
    touches = (side == 0) & between
    return (seen ^ (EDGE_CROSSED if crossed else 0)) | (ON_EDGE if touches else 0)


@compiled
def in_field(g, w, x, y):
    """Return whether a point is in the closed field of world w."""
    f = column(g, w)
    seen = 0
    for e in range(g.edges.shape[1]):
        ax, ay = g.edges[0, e, f], g.edges[1, e, f]
        bx, by = g.edges[2, e, f], g.edges[3, e, f]
        seen = cross_edge(seen, x, y, ax, ay, bx, by)
    return seen != 0
