"""ROIs that are for robots of one kind (mdp.md, "Kinds")."""

# ``Tables.mine`` has the bits of the ROIs that each robot of a field may visit.
#
# Source: this package.

from mbn_marl.jit.compile import compiled
from mbn_marl.jit.features import Feature
from mbn_marl.jit.functions import column

has_kinds = Feature(lambda g: g.field.mine.ndim == 2)


@compiled
def is_mine(g, i, j, w):
    """Return whether robot i may visit ROI j."""
    if has_kinds(g):
        f = column(g.field, w)
        return (g.field.mine[i, f] & g.field.roi_bits[j, f]) != 0
    return True


@compiled
def are_alike(g, i, k, w):
    """Return whether two robots may visit the same ROIs."""
    if has_kinds(g):
        f = column(g.field, w)
        return g.field.mine[i, f] == g.field.mine[k, f]
    return True


@compiled
def put_mine(p, g, view, lo, hi, j, k):
    """Write as entry k whether the observer may visit ROI j; return how many entries, 0 or 1."""
    if has_kinds(g):
        for w in range(lo, hi):
            view.tile[k, w - lo] = p.one if is_mine(g, view.i, j, w) else p.zero
        return 1
    return 0
