"""The reward terms of both rule sets, written once (mdp.md, "Reward profiles").

A robot's share of the reward is the sum of six named terms. The engine stores what *happened* in
compact words (the bits below); the reward and the logged terms are both computed from those.
"""

from __future__ import annotations

import numpy as np

from mbn_marl.engine.compiling import compiled
from mbn_marl.engine.rules import select

REWARD_TERMS = ("step", "revisit", "wall", "roi", "success", "collision")
RELEASED, FORMAL = 0, 1
RULES = {"released": RELEASED, "formal": FORMAL}

# A robot's event word: what it did in the step; the number of ROIs it visited sits above the flags.
WALL = 1
REVISIT = 2
STILL = 4
ROIS_SHIFT = 3
# A world's outcome word.
SUCCESS = 1
COLLISION = 2
ANY_OUTSIDE = 4
KNOWN_STATE = 8
RESTED = 16  # the world was reset, or left out: nothing happened, nothing was earned


@compiled
def is_set(word, flag):
    """Whether ``flag`` is set in ``word``."""
    return (word & flag) != 0


@compiled
def count_bits(word):
    """How many bits of a non-negative integer are set."""
    count = 0
    while word != 0:
        word &= word - 1
        count += 1
    return count


@compiled
def rois_gained(p, event):
    """How many ROIs the robot visited in the step, in the engine's precision."""
    return p.one * np.float32(event >> ROIS_SHIFT)


@compiled
def released_terms(p, event, outcome):
    """The six terms of one robot under the released rules, in the order of ``REWARD_TERMS``.

    A collision replaces everything else that the step earned (step 7).
    """
    alive = not is_set(outcome, COLLISION)
    known = is_set(event, REVISIT)
    return (
        -p.small if alive & (not known) else p.zero,
        -p.medium if alive & known else p.zero,
        -p.large if alive & is_set(event, WALL) else p.zero,
        p.large * rois_gained(p, event) if alive else p.zero,
        p.infinite_share if alive & is_set(outcome, SUCCESS) else p.zero,
        p.zero if alive else -p.infinite_share,
    )


@compiled
def formal_terms(p, event, outcome):
    """The six terms of one robot under the paper's section 3; team-wide terms are shared equally.

    ``step`` holds both r_s terms, which cancel on a clean step to a new joint state.
    """
    done = is_set(outcome, SUCCESS)
    known = is_set(outcome, KNOWN_STATE)
    inside = p.zero if is_set(outcome, ANY_OUTSIDE) else -p.small_share
    return (
        inside + (p.zero if known else p.small_share),
        -p.medium_share if known else p.zero,
        -p.large if is_set(event, WALL) else p.zero,
        p.zero if done else p.large * rois_gained(p, event),
        p.infinite_share if done else p.zero,
        -p.infinite_share if is_set(outcome, COLLISION) else p.zero,
    )


@compiled
def team_reward(p, outcome, own):
    """The team's reward, from the sum of ``own_terms`` over robots.

    Computed as such and not as a sum of shares: n shares of a third would not be exact.
    """
    done = is_set(outcome, SUCCESS)
    lost = is_set(outcome, COLLISION)
    if p.rules == RELEASED:
        return -p.infinite if lost else own + (p.infinite if done else p.zero)
    known = is_set(outcome, KNOWN_STATE)
    inside = p.zero if is_set(outcome, ANY_OUTSIDE) else -p.small
    shared = inside + (-p.medium if known else p.small)
    goal = p.infinite if done else p.zero
    return own + shared + goal - (p.infinite if lost else p.zero)


@compiled
def own_terms(p, terms):
    """What one robot earned by itself: its terms less the shares of team-wide ones."""
    ground = select(p.rules == RELEASED, terms[0] + terms[1], p.zero)
    return ground + terms[2] + terms[3]


@compiled
def robot_terms(p, event, outcome):
    """The six terms of one robot under the configured rules."""
    return (
        released_terms(p, event, outcome)
        if p.rules == RELEASED
        else formal_terms(p, event, outcome)
    )


@compiled
def total(terms):
    """The robot's reward: the sum of its terms."""
    return terms[0] + terms[1] + terms[2] + terms[3] + terms[4] + terms[5]
