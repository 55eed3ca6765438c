"""Robots that know only what they have seen and heard (mdp.md, "Knowledge")."""

# ``Episode.knows`` has a block of words after the other, each with a row for each robot: the ROIs
# that it knows to be done, visited or empty, and if ROIs are hidden a row for those it has found.
# The first block is what robots know now. The others are what they knew before they told each
# other, in this step and in as many steps before it as words are late.
#
# Source: this package.

import numpy as np

from mbn_marl.config import MAX_ROBOTS, MAX_ROIS, NavigationConfig
from mbn_marl.engine.mdp.drawn_numbers import numbers_of
from mbn_marl.engine.mdp.events import all_visited, within
from mbn_marl.engine.mdp.failures import is_gone
from mbn_marl.jit.compile import compiled
from mbn_marl.jit.features import Feature
from mbn_marl.jit.functions import column, count_bits, select
from mbn_marl.jit.random_numbers import FOR_DECOYS, FOR_TELLING, stream_of, uniform

MOST_ROBOTS = np.uint64(MAX_ROBOTS)

knows_own = Feature(lambda ep: ep.knows.ndim == 2)


def knowledge_rows(config: NavigationConfig, n: int) -> int:
    return n * (1 + config.hidden_rois) * (2 + config.comm_delay)


@compiled
def draw_decoys(p, g, now, episode_key, w):
    """The bits of the ROIs of world w that are empty: given, or each set of as many as likely."""
    empty = np.int32(0)
    if knows_own(now):
        f, key = column(g.field, w), stream_of(episode_key, FOR_DECOYS)
        rois, span = count_bits(g.field.codes[f]), p.most_decoys - p.least_decoys + 1
        missing = p.least_decoys + np.int64(uniform(key, MAX_ROIS) * np.float32(span))
        for j in range(rois):
            drawn = uniform(key, j) * np.float32(rois - j) < np.float32(missing)
            missing -= np.int64(drawn)
            if drawn or (p.empty_rois >> j) & 1 == 1:
                empty |= g.field.roi_bits[j, f]
    return empty


@compiled
def begin_knowledge(p, g, mem, now, w):
    """Robots know what they see from their starts, and which ROIs the field does not have."""
    if knows_own(now):
        n = now.x.shape[0]
        padding = all_visited(g.field.rois.shape[1]) & ~g.field.codes[column(g.field, w)]
        for row in range(now.knows.shape[0]):
            now.knows[row, w] = select(row < n, padding, 0)
        learn(p, g, mem, now, w, w + np.uint64(1))


@compiled
def learn(p, g, mem, now, lo, hi):
    """Steps 5a to 5c: robots look and find, then tell each other; ``steps`` counts this step."""
    if knows_own(now):
        look_around(p, g, now, lo, hi)
        count = now.x.shape[0] * (1 + p.hidden_rois)
        for row in range(now.knows.shape[0] - 1, count - 1, -1):
            for w in range(lo, hi):
                now.knows[row, w] = now.knows[row - count, w]
        tell(p, mem, now, count, lo, hi)


@compiled
def look_around(p, g, now, lo, hi):
    field, knows, n = g.field, now.knows, now.x.shape[0]
    for i in range(n):
        for j in range(field.rois.shape[1]):
            for w in range(lo, hi):
                f = column(field, w)
                dx, dy = now.x[i, w] - field.rois[0, j, f], now.y[i, w] - field.rois[1, j, f]
                rho_squared = numbers_of(p, now, w).roi_squared
                radius_squared = select(p.look_squared < 0, rho_squared, p.look_squared)
                near = within(dx, dy, radius_squared) & (not is_gone(p, now, i, w))
                knows[i, w] |= now.visited[w] & field.roi_bits[j, f] if near else 0
            if p.hidden_rois:
                for w in range(lo, hi):
                    f = column(field, w)
                    dx, dy = now.x[i, w] - field.rois[0, j, f], now.y[i, w] - field.rois[1, j, f]
                    near = within(dx, dy, p.sensing_squared) & (not is_gone(p, now, i, w))
                    knows[n + i, w] |= field.roi_bits[j, f] if near else 0


@compiled
def hears(p, mem, now, i, j, w):
    """Return whether robot i receives what robot j tells it in this step."""
    dx, dy = now.x[i, w] - now.x[j, w], now.y[i, w] - now.y[j, w]
    gone = is_gone(p, now, i, w) | is_gone(p, now, j, w)
    near = within(dx, dy, p.comm_squared) & (not gone)
    if p.comm_loss > 0:
        step = np.uint64(now.steps[w]) * MOST_ROBOTS
        counter = (step + np.uint64(i)) * MOST_ROBOTS + np.uint64(j)
        near &= uniform(stream_of(mem.key[w], FOR_TELLING), counter) >= p.comm_loss
    return near


@compiled
def tell(p, mem, now, count, lo, hi):
    """All robots at once receive the words of those near them, from the last block."""
    knows, n = now.knows, now.x.shape[0]
    last = knows.shape[0] - count
    for first in range(0, count, n):
        for i in range(n):
            for j in range(n):
                if i != j:
                    for w in range(lo, hi):
                        heard = knows[last + first + j, w]
                        knows[first + i, w] |= heard if hears(p, mem, now, i, j, w) else 0


@compiled
def is_done(g, ep, i, j, w):
    """Return whether robot i knows that ROI j is visited or empty."""
    bit = g.field.roi_bits[j, column(g.field, w)]
    if knows_own(ep):
        return (ep.knows[i, w] & bit) != 0
    return (ep.visited[w] & bit) != 0


@compiled
def is_left(p, g, ep, i, j, w):
    left = not is_done(g, ep, i, j, w)
    if knows_own(ep):
        found = ep.knows[ep.x.shape[0] + i, w] & g.field.roi_bits[j, column(g.field, w)]
        left &= (found != 0) | (p.hidden_rois == 0)
    return left


@compiled
def notices(p, view, j, w):
    """Return whether the observer senses robot j, or hears it."""
    robots, i = view.robots, view.i
    dx, dy = robots.x[j, w] - robots.x[i, w], robots.y[j, w] - robots.y[i, w]
    return within(dx, dy, p.notice_squared)


@compiled
def hide_unnoticed(p, view, lo, hi, j, first, end):
    for entry in range(first, end):
        for w in range(lo, hi):
            view.tile[entry, w - lo] *= select(notices(p, view, j, w), p.one, p.zero)
