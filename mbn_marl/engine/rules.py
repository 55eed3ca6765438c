"""The rules of the MDP, one scalar function each (mdp.md, "One step, in this order").

Every number that the engine computes comes from a function of this module, of ``rewards`` or of
``observation``: the batched CPU passes, the single world and the CUDA kernel all call these. They
are written on scalars and without branches, so that a loop over worlds around them vectorises.
"""

from __future__ import annotations

from mbn_marl.engine.compiling import compiled


@compiled
def select(condition, a, b):
    """``a`` if the condition holds, else ``b``, without a branch: both have been read."""
    return a if condition else b


@compiled
def clip(value, low, high):
    """``value`` limited to ``[low, high]``."""
    return min(max(value, low), high)


@compiled
def force(action, f_max, one):
    """Force of an action: clipped to [-1, 1], times f_max. ``one`` carries the precision."""
    return clip(action, -one, one) * f_max


@compiled
def next_velocity(velocity, thrust, mass, wind, v_clip):
    """Step 1: ``v' = v + f / M + wind``, limited to v_clip, one axis."""
    return clip(velocity + thrust / mass + wind, -v_clip, v_clip)


@compiled
def next_position(position, velocity, tau):
    """Step 2: the candidate ``p' = p + v' tau``, one axis."""
    return position + velocity * tau


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
def within(dx, dy, radius_squared):
    """Step 5: a point at offset (dx, dy) is at most the radius away."""
    return dx * dx + dy * dy <= radius_squared


@compiled
def too_close(dx, dy, distance_squared):
    """Step 7: two robots at offset (dx, dy) are strictly closer than the safety distance."""
    return dx * dx + dy * dy < distance_squared
