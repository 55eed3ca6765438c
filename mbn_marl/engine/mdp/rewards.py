"""The reward terms of both rule sets, each written once (mdp.md, "Reward profiles")."""

# The engine stores what *happened* in compact words (the bits below); rewards and logged terms are
# both computed from those. A robot's reward is the sum of what it earned itself, ``own_terms``, and
# its share of what the whole team gets, ``team_terms``; the team's reward is the sum of all robots'
# own terms and of the whole ``team_terms``.
#
# Source: Choton, Woods, Hsu, section 3 (``formal``) and the authors' released code (``released``).

from typing import Any

import numpy as np

from mbn_marl.engine.mdp.failures import ABSENT, FAILED, WORKS, count_status, may_rest
from mbn_marl.jit.compile import compiled, generated
from mbn_marl.jit.functions import is_set, select

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

OWN_TERMS = ("step", "revisit", "wall", "roi")
TEAM_TERMS = ("step", "revisit", "success", "collision")
# ``step`` and ``revisit`` are a robot's own when ``released``, the team's when ``formal``.
SHARED = 2
REWARD_TERMS = (*OWN_TERMS, *TEAM_TERMS[SHARED:])
# The places of the ``TEAM_TERMS`` among the ``REWARD_TERMS``.
TEAM_COLUMNS = tuple(map(REWARD_TERMS.index, TEAM_TERMS))


@compiled
def own_terms(p, event, outcome):
    """The rewards of a robot alone, as ``OWN_TERMS``: r_s or r_m for ground, r_l for the rest."""
    # ``released``: a collision replaces everything else that the step earned (step 7).
    # ``formal``: success replaces the reward of ROIs, as in R_I; ground is the team's, as in R_V.
    released = p.rules == RELEASED
    replaced = released & is_set(outcome, COLLISION)
    charged = released & (not replaced)
    known = is_set(event, REVISIT)
    rewarded = not (replaced | ((not released) & is_set(outcome, SUCCESS)))
    return (
        -p.whole.small if charged & (not known) else p.zero,
        -p.whole.medium if charged & known else p.zero,
        -p.whole.large if is_set(event, WALL) & (not replaced) else p.zero,
        p.whole.large * p.one * np.float32(event >> ROIS_SHIFT) if rewarded else p.zero,
    )


@compiled
def team_terms(p, weights, outcome):
    """The rewards of the team, as ``TEAM_TERMS``, by ``weights``: whole, or a robot's share."""
    # Success is R_I = r_inf, collision R_C = -r_inf. ``formal`` adds the -r_s of R_F if no robot is
    # outside, and R_V: -r_m in a known joint state, else +r_s, which cancels it on a clean step.
    formal = p.rules == FORMAL
    lost, done = is_set(outcome, COLLISION), is_set(outcome, SUCCESS)
    known = is_set(outcome, KNOWN_STATE)
    inside = -weights.small if formal & (not is_set(outcome, ANY_OUTSIDE)) else p.zero
    return (
        inside + (weights.small if formal & (not known) else p.zero),
        -weights.medium if formal & known else p.zero,
        weights.infinite if done & (formal | (not lost)) else p.zero,
        -weights.infinite if lost else p.zero,
    )


def _total_of(names: tuple[str, ...]) -> Any:
    terms = " + ".join(f"terms[{k}]" for k in range(len(names)))
    return generated("total", f"def total(terms):\n    return {terms}\n")


def _part_of(names: tuple[str, ...]) -> Any:
    """``part(p, terms, none, count)``: the terms over ``count``, or all 0 if ``none``."""
    terms = ", ".join(f"select(none, p.zero, terms[{k}] / count)" for k in range(len(names)))
    source = f"def part(p, terms, none, count):\n    return ({terms},)\n"
    return generated("part", source, select=select)


# Generated, so that a new term needs no edit here; without loops, which would not vectorise.
total_own, total_team, total = map(_total_of, (OWN_TERMS, TEAM_TERMS, REWARD_TERMS))
part_own, part_team = map(_part_of, (OWN_TERMS, TEAM_TERMS))


@compiled
def team_reward(p, outcome, own):
    """``R``, from the sum of the robots' own terms."""
    # Computed as such and not as a sum of shares: n shares of a third would not be exact.
    return own + total_team(team_terms(p, p.whole, outcome))


@compiled
def earned(p, ep, event, outcome, i, w):
    """``own_terms`` of robot i of world w; none of them unless it works."""
    own = own_terms(p, event, outcome)
    if may_rest(ep):
        return part_own(p, own, ep.status[i, w] != WORKS, p.one)
    return own


@compiled
def with_share(p, ep, own, outcome, i, w):
    """The terms of robot i's reward ``r_i``, as ``REWARD_TERMS``, from its own terms."""
    # The team's reward is shared by all n robots, or by those that have not failed.
    team = team_terms(p, p.share, outcome)
    if may_rest(ep):
        there = ep.status.shape[0] - count_status(ep, ABSENT, w)
        failed = count_status(ep, FAILED, w)
        some_work = failed < there
        parts = p.one * np.float32(there - select(some_work, failed, 0))
        none = (ep.status[i, w] == ABSENT) | ((ep.status[i, w] == FAILED) & some_work)
        team = part_team(p, team_terms(p, p.whole, outcome), none, parts)
    return (own[0] + team[0], own[1] + team[1], *own[SHARED:], *team[SHARED:])
