"""Beginning, ending and copying the episode of one world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mbn_marl.engine.mdp.collisions import too_close
from mbn_marl.engine.mdp.containment import in_field
from mbn_marl.engine.mdp.disturbances import begin_disturbances
from mbn_marl.engine.mdp.drawn import draw_numbers, numbers_of
from mbn_marl.engine.mdp.dynamics import face_along_x
from mbn_marl.engine.mdp.failures import begin_status
from mbn_marl.engine.mdp.revisits import LEAST_WORDS, ODD_LINES, clear_filter, joint_state_known
from mbn_marl.engine.mdp.rewards import FORMAL, RELEASED, RESTED
from mbn_marl.engine.mdp.visits import all_visited, visit_code
from mbn_marl.engine.mdp.ways import lay_ways
from mbn_marl.engine.state import HEADING, OPTIONAL, Episode
from mbn_marl.field.generator.families import make_field
from mbn_marl.jit.compile import compiled, generated
from mbn_marl.jit.functions import column
from mbn_marl.jit.random_numbers import (
    FOR_FIELDS,
    FOR_STARTS,
    episode_key,
    stream_key,
    stream_of,
    uniform,
    world_number,
)

DRAWS_PER_ROBOT = 1000
"""How many random starts are tried for a robot before the field's own starts are used instead."""
ENDED, RESTARTS = 1, 2
"""Bits of how the episode of a world changes after a step."""
MOTION = ("x", "y", "vx", "vy", "visited", "steps")
"""The parts of an episode that a step reads over and over."""


@compiled
def copy_world(source, v, target, w):
    """World v of ``source`` (k, W) to world w of ``target``, unless what they hold is off."""
    if source.ndim == 2:
        for k in range(source.shape[0]):
            target[k, w] = source[k, v]


def _copy_of(name: str, fields: Sequence[str]) -> Any:
    """``name(source, v, target, w, n, headings)``: copy these fields of an episode of n robots.

    From world v of the episodes ``source`` to world w of ``target``.
    """
    of_world = [field for field in fields if field in ("team_return", "visited", "codes", "steps")]
    lines = [f"def {name}(source, v, target, w, n, headings):", "    for i in range(n):"]
    for field in fields:
        if field not in (*of_world, *HEADING, *OPTIONAL):
            lines.append(f"        target.{field}[i, w] = source.{field}[i, v]")
    if turns := [field for field in fields if field in HEADING]:
        lines.append("    for i in range(headings):")
        lines += [f"        target.{field}[i, w] = source.{field}[i, v]" for field in turns]
    lines += [f"    target.{field}[w] = source.{field}[v]" for field in of_world]
    for field in (field for field in fields if field in OPTIONAL):
        lines.append(f"    copy_world(source.{field}, v, target.{field}, w)")
    return generated(name, "\n".join(lines), copy_world=copy_world)


copy_episode = _copy_of("copy_episode", Episode._fields)
copy_motion = _copy_of("copy_motion", MOTION)


@compiled
def place_at_random(p, g, key, now, team, w):
    """Put the ``team`` first robots at random points of the field, none closer than C.

    Return False if that failed.
    """
    f = column(g, w)
    key = stream_of(key, FOR_STARTS)
    counter, safety_squared = 0, numbers_of(p, now.drawn, w).safety_squared
    for i in range(team):
        placed = False
        for _ in range(DRAWS_PER_ROBOT):
            if not placed:
                x = g.boxes[0, f] + g.boxes[2, f] * uniform(key, counter)
                y = g.boxes[1, f] + g.boxes[3, f] * uniform(key, counter + 1)
                counter += 2
                placed = in_field(g, w, x, y)
                for j in range(i):
                    near = too_close(now.x[j, w] - x, now.y[j, w] - y, safety_squared)
                    placed = placed and not near
                now.x[i, w] = x
                now.y[i, w] = y
        if not placed:
            return False
    return True


@compiled
def draw_field(p, g, sampler, plan, episode, w):
    """Make the field of the episode that world w begins, unless it was given one."""
    if sampler.ndim == 1:
        f = column(g, w)
        if not g.kept[f]:
            key = stream_key(sampler[-1], world_number(p, w), episode, FOR_FIELDS)
            make_field(sampler, key, g.scratch, g, f)
            if plan.ndim == 2:
                lay_ways(g, f)
        g.kept[f] = False


@compiled
def reset_world(p, g, mem, now, w):
    """Begin the next episode of world w: robots at rest at the starts, nothing visited."""
    f = column(g, w)
    n = now.x.shape[0]
    mem.episode[w] += 1
    key = episode_key(mem.seed[0], world_number(p, w), mem.episode[w])
    draw_field(p, g, g.sampler, mem.plan, mem.episode[w], w)
    team = g.robots_in[f]
    draw_numbers(p, g.ranges, now.drawn, key, team, w)
    at_random = False
    if p.random_starts:
        at_random = place_at_random(p, g, key, now, team, w)
    for i in range(n):
        if not (at_random & (i < team)):
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
    face_along_x(p, g.kinds, now, w)
    begin_status(now.status, team, w)
    now.team_return[w] = 0.0
    now.codes[w] = g.codes[f]
    now.visited[w] = all_visited(g.rois.shape[1]) & ~g.codes[f]
    now.steps[w] = 0
    begin_disturbances(p, now.drawn, mem.key, now.gust, now.queue, key, w)
    mem.words[w] = np.uint64(
        LEAST_WORDS if p.rules == RELEASED else mem.filter.shape[1] - ODD_LINES
    )
    clear_filter(mem.filter, w, mem.words[w])
    if p.rules == FORMAL:
        joint_state_known(mem, now, w, visit_code(now.visited[w], g.codes[f]))


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
