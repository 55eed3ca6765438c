"""How a robot moves: its dynamics, by name (mdp.md, "One step", 1 and 2).

A dynamics is a function on the robots i of a block of worlds. It writes the velocity that the
robot would have next and where that would take it; walls and the arena come after it. One whose
robots have a heading changes ``Episode.heading``, which has no entries for the others.

Source: Choton, Woods, Hsu, section 4 ("Environment Design").
"""

from __future__ import annotations

import numpy as np

from mbn_marl.engine.jit import compiled
from mbn_marl.engine.mdp.disturbances import add_wind
from mbn_marl.engine.scalars import clip

POINT_MASS = 0
DYNAMICS = {"point_mass": POINT_MASS}
WITH_HEADING: frozenset[str] = frozenset()
"""The dynamics whose robots have a heading."""


def count_headings(name: str, n: int) -> int:
    """The number of headings in a team of n robots with the dynamics ``name``: n or 0."""
    return n if name in WITH_HEADING else 0


@compiled
def force(action, f_max, one):
    """``u = f_max clip(a, -1, 1)``, one axis. ``one`` carries the precision."""
    return clip(action, -one, one) * f_max


@compiled
def next_velocity(velocity, thrust, mass, wind, v_clip):
    """``v' = clip(v + u / M + wind, -v_clip, v_clip)``, one axis."""
    return clip(add_wind(velocity + thrust / mass, wind), -v_clip, v_clip)


@compiled
def next_position(position, velocity, tau):
    """The candidate ``p' = p + v' tau``, one axis."""
    return position + velocity * tau


@compiled
def add_impulse(impulse, thrust, tau):
    """``sum_t u_t tau``, one axis, after one more step."""
    return impulse + thrust * tau


@compiled
def objective(impulse_x, impulse_y):
    """``|sum_t u_t tau|``, of which the paper minimises the sum over robots (section 3)."""
    return np.hypot(impulse_x, impulse_y)


@compiled
def move_point_mass(p, g, now, to, actions, i, lo, hi):
    """The paper's robot i: a mass that its force accelerates along both axes."""
    mass = g.masses[i]
    for w in range(lo, hi):
        fx = force(actions[w, i, 0], p.f_max, p.one)
        fy = force(actions[w, i, 1], p.f_max, p.one)
        vx = next_velocity(now.vx[i, w], fx, mass, p.wind_x, p.v_clip)
        vy = next_velocity(now.vy[i, w], fy, mass, p.wind_y, p.v_clip)
        to.vx[w - lo] = vx
        to.vy[w - lo] = vy
        to.x[w - lo] = next_position(now.x[i, w], vx, p.tau)
        to.y[w - lo] = next_position(now.y[i, w], vy, p.tau)
        now.impulse_x[i, w] = add_impulse(now.impulse_x[i, w], fx, p.tau)
        now.impulse_y[i, w] = add_impulse(now.impulse_y[i, w], fy, p.tau)


@compiled
def propose_move(p, g, now, to, actions, i, lo, hi):
    """Steps 1 and 2: the velocity that robot i would have, and where it would take it."""
    if p.dynamics == POINT_MASS:
        move_point_mass(p, g, now, to, actions, i, lo, hi)
