"""Starting and finishing one world's episode, and the joint-state memory of the formal rules."""

from __future__ import annotations

import numpy as np

from mbn_marl.engine import rules
from mbn_marl.engine.compiling import compiled
from mbn_marl.engine.memory import (
    LEAST_WORDS,
    ODD_LINES,
    add_bits,
    clear_filter,
    filter_mask,
    filter_word,
)
from mbn_marl.engine.observation import column, visit_code
from mbn_marl.engine.rewards import FORMAL, RELEASED, RESTED
from mbn_marl.engine.rng import FOR_STARTS, GOLDEN, mix, stream_key, uniform

DRAWS_PER_ROBOT = 1000
"""How many random starts are tried for a robot before the field's own starts are used instead."""


@compiled
def in_field(g, w, x, y):
    """Whether a point is in the closed field of world w."""
    f = column(g, w)
    seen = 0
    for e in range(g.edges.shape[1]):
        ax, ay = g.edges[0, e, f], g.edges[1, e, f]
        bx, by = g.edges[2, e, f], g.edges[3, e, f]
        seen = rules.cross_edge(seen, x, y, ax, ay, bx, by)
    return seen != 0


@compiled
def place_at_random(p, g, mem, now, w):
    """Put the robots at random points of the field, none closer than C; False if that failed."""
    f = column(g, w)
    key = stream_key(p.seed, w, mem.episode[w], FOR_STARTS)
    counter = 0
    for i in range(now.x.shape[0]):
        placed = False
        for _ in range(DRAWS_PER_ROBOT):
            if not placed:
                x = g.boxes[0, f] + g.boxes[2, f] * uniform(key, counter)
                y = g.boxes[1, f] + g.boxes[3, f] * uniform(key, counter + 1)
                counter += 2
                placed = in_field(g, w, x, y)
                for j in range(i):
                    near = rules.too_close(now.x[j, w] - x, now.y[j, w] - y, p.safety_squared)
                    placed = placed and not near
                now.x[i, w] = x
                now.y[i, w] = y
        if not placed:
            return False
    return True


@compiled
def reset_world(p, g, mem, now, w):
    """Begin the next episode of world w: robots at rest at the starts, nothing visited."""
    f = column(g, w)
    n = now.x.shape[0]
    mem.episode[w] += 1
    at_random = False
    if p.random_starts:
        at_random = place_at_random(p, g, mem, now, w)
    for i in range(n):
        if not at_random:
            now.x[i, w] = g.starts[0, i, f]
            now.y[i, w] = g.starts[1, i, f]
        now.vx[i, w] = p.zero
        now.vy[i, w] = p.zero
        now.impulse_x[i, w] = p.zero
        now.impulse_y[i, w] = p.zero
        now.path_length[i, w] = p.zero
        now.wall_hits[i, w] = 0
        now.returns[i, w] = 0.0
        mem.trail[w, i, 0] = now.x[i, w]
        mem.trail[w, i, 1] = now.y[i, w]
    now.team_return[w] = 0.0
    now.visited[w] = ((1 << g.rois.shape[1]) - 1) & ~g.codes[f]
    now.steps[w] = 0
    mem.words[w] = np.uint64(
        LEAST_WORDS if p.rules == RELEASED else mem.filter.shape[1] - ODD_LINES
    )
    clear_filter(mem.filter, w, mem.words[w])
    if p.rules == FORMAL:
        joint_state_known(mem, now, w, visit_code(g, now.visited[w], w))


@compiled
def clear_output(p, out, w):
    """A world that has just been reset on its own has earned nothing and has not ended."""
    for i in range(out.rewards.shape[1]):
        out.rewards[w, i] = p.zero
        out.events[i, w] = 0
    out.team_rewards[w] = p.zero
    out.terminated[w] = False
    out.truncated[w] = False
    out.outcomes[w] = RESTED


@compiled
def finish_world(now, final, w):
    """Keep how the episode of world w ended, before a reset wipes it."""
    for i in range(now.x.shape[0]):
        final.x[i, w] = now.x[i, w]
        final.y[i, w] = now.y[i, w]
        final.vx[i, w] = now.vx[i, w]
        final.vy[i, w] = now.vy[i, w]
        final.impulse_x[i, w] = now.impulse_x[i, w]
        final.impulse_y[i, w] = now.impulse_y[i, w]
        final.path_length[i, w] = now.path_length[i, w]
        final.wall_hits[i, w] = now.wall_hits[i, w]
        final.returns[i, w] = now.returns[i, w]
    final.team_return[w] = now.team_return[w]
    final.visited[w] = now.visited[w]
    final.steps[w] = now.steps[w]


@compiled
def same_joint_state(mem, now, w, step, code):
    """Whether the world was in its present joint state after step ``step`` of the episode."""
    same = mem.trail_code[w, step] == code
    n = now.x.shape[0]
    for i in range(n):
        k = step * n + i
        same &= (mem.trail[w, k, 0] == now.x[i, w]) & (mem.trail[w, k, 1] == now.y[i, w])
        same &= mem.trail_velocity[w, k, 0] == now.vx[i, w]
        same &= mem.trail_velocity[w, k, 1] == now.vy[i, w]
    return same


@compiled
def joint_state_known(mem, now, w, code):
    """Formal rules: was this joint state met before in the episode? It is remembered either way.

    The state at the start counts as met. The filter is keyed by positions and code, which differ in
    nearly all distinct states; the trail decides.
    """
    n = now.x.shape[0]
    step = min(now.steps[w], mem.trail_code.shape[1] - 1)
    key = mix(np.uint64(code))
    for i in range(n):
        key = mix(key + np.uint64(mem.x_bits[i, w]) * GOLDEN)
        key = mix(key + np.uint64(mem.y_bits[i, w]) * GOLDEN)
    known = False
    if add_bits(mem.filter, w, filter_word(key, mem.words[w]), filter_mask(key)):
        for back in range(1, step + 1):
            known = known or same_joint_state(mem, now, w, step - back, code)
    for i in range(n):
        k = step * n + i
        mem.trail[w, k, 0] = now.x[i, w]
        mem.trail[w, k, 1] = now.y[i, w]
        mem.trail_velocity[w, k, 0] = now.vx[i, w]
        mem.trail_velocity[w, k, 1] = now.vy[i, w]
    mem.trail_code[w, step] = code
    return known
