"""How an episode ends (mdp.md, "One step", 6 to 8).

Source: Choton, Woods, Hsu, section 3; the time limit T_max is that of the released code.
"""

from __future__ import annotations

from mbn_marl.jit.compile import compiled


@compiled
def is_terminated(success, collided):
    """Return whether the episode ends in success or in a collision."""
    return success | collided


@compiled
def is_truncated(steps, max_steps, terminated):
    """Return whether the episode, after ``steps`` steps, reaches T_max without termination."""
    return (steps >= max_steps) & (not terminated)
