"""Which ROIs are visited, and the visit code b (mdp.md, "One step", 5, and "State, visit code").

Source: Choton, Woods, Hsu, section 3 ("Problem Formulation").
"""

from __future__ import annotations

from mbn_marl.jit.compile import compiled


@compiled
def within(dx, dy, radius_squared):
    """``|p - w_j| <= rho``: a point at offset (dx, dy) is at most the radius away."""
    return dx * dx + dy * dy <= radius_squared


@compiled
def all_visited(n_rois):
    """The visit bits of a world whose ROIs are all visited, padding among them."""
    return (1 << n_rois) - 1


@compiled
def visit_code(visited, everything):
    """``b``: visit bits, the first ROI the highest, without those that ``everything`` has not."""
    return visited & everything
