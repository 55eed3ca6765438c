"""Beginning, ending and copying the episode of one world."""

import numpy as np

from mbn_marl.engine.mdp.assignment import assigns
from mbn_marl.engine.mdp.disturbances import begin_disturbances, disturbs_actions, has_gusts
from mbn_marl.engine.mdp.drawn_numbers import draw_numbers, draws_numbers, numbers_of
from mbn_marl.engine.mdp.dynamics import face_along_x
from mbn_marl.engine.mdp.events import all_visited, in_field, too_close, visit_code
from mbn_marl.engine.mdp.failures import begin_status, may_rest
from mbn_marl.engine.mdp.knowledge import begin_knowledge, draw_decoys
from mbn_marl.engine.mdp.paths import find_paths
from mbn_marl.engine.mdp.revisits import LEAST_WORDS, ODD_LINES, clear_filter, joint_state_known
from mbn_marl.engine.mdp.rewards import FORMAL, RELEASED, RESTED
from mbn_marl.engine.state import draws_fields
from mbn_marl.field.generator.families import make_field
from mbn_marl.jit import random_numbers as rng
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.functions import column

# The random starts that are tried for a robot before the field's own starts are used instead.
DRAWS_PER_ROBOT = 1000
# Bits of how the episode of a world changes after a step.
ENDED, RESTARTS = 1, 2


@compiled
def copy_rows(source, v, target, w, count):
    for k in range(count):
        target[k, w] = source[k, v]


@compiled
def copy_motion(source, v, target, w, n):
    # The parts of an episode that a step reads over and over, from world v to world w.
    copy_rows(source.x, v, target.x, w, n)
    copy_rows(source.y, v, target.y, w, n)
    copy_rows(source.vx, v, target.vx, w, n)
    copy_rows(source.vy, v, target.vy, w, n)
    target.visited[w] = source.visited[v]
    target.steps[w] = source.steps[v]


@compiled
def copy_episode(source, v, target, w, n, headings):
    copy_motion(source, v, target, w, n)
    copy_rows(source.impulse_x, v, target.impulse_x, w, n)
    copy_rows(source.impulse_y, v, target.impulse_y, w, n)
    copy_rows(source.path_length, v, target.path_length, w, n)
    copy_rows(source.wall_hits, v, target.wall_hits, w, n)
    copy_rows(source.returns, v, target.returns, w, n)
    copy_rows(source.heading, v, target.heading, w, headings)
    copy_rows(source.cos, v, target.cos, w, headings)
    copy_rows(source.sin, v, target.sin, w, headings)
    target.team_return[w] = source.team_return[v]
    target.codes[w] = source.codes[v]
    if has_gusts(source):
        copy_rows(source.gust, v, target.gust, w, 2)
    if disturbs_actions(source):
        copy_rows(source.queue, v, target.queue, w, source.queue.shape[0])
    if draws_numbers(source):
        copy_rows(source.drawn, v, target.drawn, w, source.drawn.shape[0])
    if may_rest(source):
        copy_rows(source.status, v, target.status, w, n)


@compiled
def place_at_random(p, g, key, now, team, w):
    """Put the ``team`` first robots at random points of the field, none closer than C."""
    # Return False if that failed.
    f, boxes = column(g.field, w), g.field.boxes
    key = rng.stream_of(key, rng.FOR_STARTS)
    counter, safety_squared = 0, numbers_of(p, now, w).safety_squared
    for i in range(team):
        placed = False
        for _ in range(DRAWS_PER_ROBOT):
            if not placed:
                x = boxes[0, f] + boxes[2, f] * rng.uniform(key, counter)
                y = boxes[1, f] + boxes[3, f] * rng.uniform(key, counter + 1)
                counter += 2
                placed = in_field(g.field, w, x, y)
                for j in range(i):
                    near = too_close(now.x[j, w] - x, now.y[j, w] - y, safety_squared)
                    placed = placed and not near
                now.x[i, w] = x
                now.y[i, w] = y
        if not placed:
            return False
    return True


@compiled
def reset_world(p, g, mem, now, w):
    f, field = column(g.field, w), g.field
    n = now.x.shape[0]
    mem.episode[w] += 1
    key = rng.episode_key(mem.seed[0], rng.world_number(p, w), mem.episode[w])
    if draws_fields(g):
        sampler = g.sampler
        if not sampler.kept[f]:
            seed, world = sampler.numbers[-1], rng.world_number(p, w)
            of_field = rng.stream_key(seed, world, mem.episode[w], rng.FOR_FIELDS)
            make_field(sampler.numbers, of_field, sampler.scratch, g.field, f)
            if assigns(mem):
                find_paths(g.field, g.paths, f)
        sampler.kept[f] = False
    team = field.robots_in[f]
    draw_numbers(p, g, now, key, team, w)
    at_random = False
    if p.random_starts:
        at_random = place_at_random(p, g, key, now, team, w)
    for i in range(n):
        if not (at_random & (i < team)):
            now.x[i, w] = field.starts[0, i, f]
            now.y[i, w] = field.starts[1, i, f]
        now.vx[i, w] = p.zero
        now.vy[i, w] = p.zero
        now.impulse_x[i, w] = p.zero
        now.impulse_y[i, w] = p.zero
        now.path_length[i, w] = p.zero
        now.wall_hits[i, w] = 0
        now.returns[i, w] = 0.0
        mem.trail[w, i, 0] = now.x[i, w]
        mem.trail[w, i, 1] = now.y[i, w]
    face_along_x(p, g, now, w)
    begin_status(now, team, w)
    now.team_return[w] = 0.0
    now.codes[w] = field.codes[f] & ~draw_decoys(p, g, now, key, w)
    now.visited[w] = all_visited(field.rois.shape[1]) & ~now.codes[w]
    now.steps[w] = 0
    begin_disturbances(p, mem, now, key, w)
    begin_knowledge(p, g, mem, now, w)
    mem.words[w] = np.uint64(
        LEAST_WORDS if p.rules == RELEASED else mem.filter.shape[1] - ODD_LINES
    )
    clear_filter(mem.filter, w, mem.words[w])
    if p.rules == FORMAL:
        joint_state_known(mem, now, w, visit_code(now.visited[w], field.codes[f]))


@compiled
def clear_output(p, out, w):
    """Note that world w was reset, or left out: it has earned nothing and has not ended."""
    for i in range(out.rewards.shape[1]):
        out.rewards[w, i] = p.zero
        out.events[i, w] = 0
    out.team_rewards[w] = p.zero
    out.terminated[w] = False
    out.truncated[w] = False
    out.outcomes[w] = RESTED
