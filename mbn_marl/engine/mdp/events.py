"""The events of a step: walls, visits, collisions, the end (mdp.md, "One step", 2 and 5 to 8)."""

# Source: Choton, Woods, Hsu, section 3; the strict comparison of distances and the time limit T_max
# are those of the released code.

from mbn_marl.jit.compile import compiled
from mbn_marl.jit.functions import column

EDGE_CROSSED = 1
ON_EDGE = 2


@compiled
def cross_edge(crossings, px, py, ax, ay, bx, by):
    # A ray from p to +x crosses the outline an odd number of times if p is inside (bit
    # ``EDGE_CROSSED`` of ``crossings``); a point on an edge belongs to the field (bit ``ON_EDGE``).
    # So p is in the closed field exactly if they are not zero after all edges, holes' among them.
    side = (bx - ax) * (py - ay) - (by - ay) * (px - ax)
    straddles = (ay > py) != (by > py)
    crossed = straddles & ((side > 0) == (by > ay))
    between = (px - ax) * (px - bx) + (py - ay) * (py - by) <= 0
    touches = (side == 0) & between
    return (crossings ^ (EDGE_CROSSED if crossed else 0)) | (ON_EDGE if touches else 0)


@compiled
def in_field(field, w, x, y):
    f = column(field, w)
    crossings = 0
    for e in range(field.edges.shape[1]):
        ax, ay = field.edges[0, e, f], field.edges[1, e, f]
        bx, by = field.edges[2, e, f], field.edges[3, e, f]
        crossings = cross_edge(crossings, x, y, ax, ay, bx, by)
    return crossings != 0


@compiled
def within(dx, dy, radius_squared):
    """``|p - w_j| <= rho``: a point at offset (dx, dy) is at most the radius away."""
    return dx * dx + dy * dy <= radius_squared


@compiled
def all_visited(n_rois):
    return (1 << n_rois) - 1


@compiled
def visit_code(visited, everything):
    """``b``: visit bits, the first ROI the highest, without those that ``everything`` has not."""
    return visited & everything


@compiled
def too_close(dx, dy, distance_squared):
    """``|p_i - p_k| < C``: two robots at offset (dx, dy) are closer than the safety distance."""
    return dx * dx + dy * dy < distance_squared


@compiled
def is_terminated(success, collided):
    return success | collided


@compiled
def is_truncated(steps, max_steps, terminated):
    return (steps >= max_steps) & (not terminated)
