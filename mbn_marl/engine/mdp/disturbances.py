"""Pushes besides the robots' own force: the wind (mdp.md, "One step", 1).

Source: Choton, Woods, Hsu, section 4.
"""

from __future__ import annotations

from mbn_marl.engine.jit import compiled


@compiled
def add_wind(velocity, wind):
    """``v + wind`` along an axis: v_a cos(beta_a) along x, v_a sin(beta_a) along y."""
    return velocity + wind
