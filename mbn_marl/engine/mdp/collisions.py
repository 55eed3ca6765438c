"""Collisions of two robots (mdp.md, "One step", 7).

Source: Choton, Woods, Hsu, section 3; the strict comparison is that of the released code.
"""

from __future__ import annotations

from mbn_marl.jit.compile import compiled


@compiled
def too_close(dx, dy, distance_squared):
    """``|p_i - p_k| < C``: two robots at offset (dx, dy) are closer than the safety distance."""
    return dx * dx + dy * dy < distance_squared
