"""The moves of a robot: its dynamics, by name (mdp.md, "One step", 1 and 2, and "Dynamics")."""

# A dynamics is a function on the robots i of a block of worlds. It writes the velocity that the
# robot would have next and where that would take it, and, if its robots have a heading, that too;
# walls and the arena come after it. A heading and its cosine and sine are in ``Episode``, whose
# arrays have no entries if no robot of the team has one.
#
# Source: Choton, Woods, Hsu, section 4 ("Environment Design"), for the point mass; the others are
# this package's.

from collections.abc import Sequence
from typing import get_args

from mbn_marl.config import Dynamics
from mbn_marl.engine.mdp.disturbances import add_wind, wind_along
from mbn_marl.engine.mdp.drawn_numbers import limits_in, limits_of, numbers_of
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.features import Feature
from mbn_marl.jit.functions import clip, cosine, length, select, sine, tangent, turned

POINT_MASS, HOLONOMIC, UNICYCLE, BICYCLE = range(4)
# Robots of those from the unicycle on have a heading.
DYNAMICS = {name: number for number, name in enumerate(get_args(Dynamics))}

mixes_dynamics = Feature(lambda g: g.team.kinds.ndim == 1)


@compiled
def has_heading(g, i):
    if mixes_dynamics(g):
        return g.team.kinds[i] >= UNICYCLE
    return False


def count_headings(names: Sequence[str]) -> int:
    """The number of headings in a team with these dynamics: one a robot if any has one, else 0."""
    return len(names) if any(DYNAMICS[name] >= UNICYCLE for name in names) else 0


@compiled
def force(action, f_max, one):
    """``u = f_max clip(a, -1, 1)``, one axis. ``one`` carries the precision."""
    return clip(action, -one, one) * f_max


@compiled
def next_velocity(velocity, thrust, mass, wind, v_clip):
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
    return length(impulse_x, impulse_y)


@compiled
def held_velocity(action, velocity, most, v_clip, one):
    """``clip(a v_clip - v, -f_max / M, f_max / M)``, one axis, with the quotient ``most``."""
    return clip(clip(action, -one, one) * v_clip - velocity, -most, most)


@compiled
def part_along(x, y, cos, sin):
    """The part of a vector along a heading, such as the speed ``s = v . (cos h, sin h)``."""
    return x * cos + y * sin


@compiled
def go(q, now, to, i, w, k, vx, vy):
    """Write the velocity of robot i of world w, which is number k of the block, and its end."""
    to.vx[k], to.vy[k] = vx, vy
    to.x[k] = next_position(now.x[i, w], vx, q.tau)
    to.y[k] = next_position(now.y[i, w], vy, q.tau)


@compiled
def move_point_mass(p, g, now, to, actions, i, lo, hi):
    limits = limits_of(g, i)
    for w in range(lo, hi):
        q, (mass, f_max, v_clip) = numbers_of(p, now, w), limits_in(limits, now, i, w)
        fx = force(actions[w, i, 0], f_max, p.one)
        fy = force(actions[w, i, 1], f_max, p.one)
        vx = next_velocity(now.vx[i, w], fx, mass, wind_along(q, now, 0, w), v_clip)
        vy = next_velocity(now.vy[i, w], fy, mass, wind_along(q, now, 1, w), v_clip)
        go(q, now, to, i, w, w - lo, vx, vy)
        now.impulse_x[i, w] = add_impulse(now.impulse_x[i, w], fx, q.tau)
        now.impulse_y[i, w] = add_impulse(now.impulse_y[i, w], fy, q.tau)


@compiled
def move_holonomic(p, g, now, to, actions, i, lo, hi):
    limits = limits_of(g, i)
    for w in range(lo, hi):
        q, (mass, f_max, v_clip) = numbers_of(p, now, w), limits_in(limits, now, i, w)
        most = f_max / mass
        dx = held_velocity(actions[w, i, 0], now.vx[i, w], most, v_clip, p.one)
        dy = held_velocity(actions[w, i, 1], now.vy[i, w], most, v_clip, p.one)
        vx = next_velocity(now.vx[i, w], dx, p.one, wind_along(q, now, 0, w), v_clip)
        vy = next_velocity(now.vy[i, w], dy, p.one, wind_along(q, now, 1, w), v_clip)
        go(q, now, to, i, w, w - lo, vx, vy)
        now.impulse_x[i, w] = add_impulse(now.impulse_x[i, w], mass * dx, q.tau)
        now.impulse_y[i, w] = add_impulse(now.impulse_y[i, w], mass * dy, q.tau)


@compiled
def face(to, lo, hi):
    for k in range(hi - lo):
        to.cos[k] = cosine(to.heading[k])
        to.sin[k] = sine(to.heading[k])


@compiled
def drive(p, limits, now, actions, i, w, cos, sin):
    """``s' = clip(s + u / M + wind . e, -v_clip, v_clip)`` with the force along e = (cos, sin)."""
    q, (mass, f_max, v_clip) = numbers_of(p, now, w), limits_in(limits, now, i, w)
    speed = part_along(now.vx[i, w], now.vy[i, w], now.cos[i, w], now.sin[i, w])
    thrust = force(actions[w, i, 0], f_max, p.one)
    now.impulse_x[i, w] = add_impulse(now.impulse_x[i, w], thrust * cos, q.tau)
    now.impulse_y[i, w] = add_impulse(now.impulse_y[i, w], thrust * sin, q.tau)
    wind_x, wind_y = wind_along(q, now, 0, w), wind_along(q, now, 1, w)
    return next_velocity(speed, thrust, mass, part_along(wind_x, wind_y, cos, sin), v_clip)


@compiled
def go_ahead(p, now, to, i, lo, hi):
    """Move robot i along its new headings by the speeds in ``to.vx``: ``v' = s' (cos, sin)``."""
    for w in range(lo, hi):
        k, speed = w - lo, to.vx[w - lo]
        go(numbers_of(p, now, w), now, to, i, w, k, speed * to.cos[k], speed * to.sin[k])


@compiled
def move_unicycle(p, g, now, to, actions, i, lo, hi):
    limits = limits_of(g, i)
    for w in range(lo, hi):
        q = numbers_of(p, now, w)
        turn = clip(actions[w, i, 1], -p.one, p.one) * q.turn_max * q.tau
        to.heading[w - lo] = turned(now.heading[i, w], turn, p.pi)
    face(to, lo, hi)
    for w in range(lo, hi):
        k = w - lo
        to.vx[k] = drive(p, limits, now, actions, i, w, to.cos[k], to.sin[k])
    go_ahead(p, now, to, i, lo, hi)


@compiled
def move_bicycle(p, g, now, to, actions, i, lo, hi):
    limits = limits_of(g, i)
    for w in range(lo, hi):  # the tangent is kept where it is rounded to the engine's precision
        steering = clip(actions[w, i, 1], -p.one, p.one) * numbers_of(p, now, w).steer_max
        to.sin[w - lo] = tangent(steering)
    for w in range(lo, hi):
        k, q = w - lo, numbers_of(p, now, w)
        speed = drive(p, limits, now, actions, i, w, now.cos[i, w], now.sin[i, w])
        turn = speed / q.wheelbase * to.sin[k] * q.tau
        to.heading[k] = turned(now.heading[i, w], turn, p.pi)
        to.vx[k] = speed
    face(to, lo, hi)
    go_ahead(p, now, to, i, lo, hi)


@compiled
def propose_move(p, g, now, to, actions, i, lo, hi):
    # Numba compiles the other dynamics only for teams that have one.
    if not mixes_dynamics(g):
        move_point_mass(p, g, now, to, actions, i, lo, hi)
    elif g.team.kinds[i] == HOLONOMIC:
        move_holonomic(p, g, now, to, actions, i, lo, hi)
    elif g.team.kinds[i] == UNICYCLE:
        move_unicycle(p, g, now, to, actions, i, lo, hi)
    elif g.team.kinds[i] == BICYCLE:
        move_bicycle(p, g, now, to, actions, i, lo, hi)
    else:
        move_point_mass(p, g, now, to, actions, i, lo, hi)


@compiled
def keep_heading(g, now, to, i, lo, hi):
    """Step 2: robot i faces where it went, or, if a wall stopped it, where it did before."""
    if mixes_dynamics(g) and has_heading(g, i):
        for w in range(lo, hi):
            k = w - lo
            inside = to.crossings[k] != 0
            now.heading[i, w] = select(inside, to.heading[k], now.heading[i, w])
            now.cos[i, w] = select(inside, to.cos[k], now.cos[i, w])
            now.sin[i, w] = select(inside, to.sin[k], now.sin[i, w])


@compiled
def face_along_x(p, g, now, w):
    if mixes_dynamics(g):
        for i in range(now.heading.shape[0]):
            now.heading[i, w] = p.zero
            now.cos[i, w] = select(has_heading(g, i), p.one, p.zero)
            now.sin[i, w] = p.zero
