"""All golden episodes, through every form of the environment, in both precisions.

In float64 every number is matched. In float32 every event is: the rewards of a step are whole
numbers that tell which robots hit a wall, stood on known ground or reached an ROI.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from mbn_marl import Field
from mbn_marl.field import catalogue_names, load_field
from tests.golden import FIELDS, Episode, load_episodes
from tests.support.forms import BatchForm, CentralizedForm, Form, ParallelForm, TeamSharingForm

WORLDS = 131  # more than a block of the engine, and no multiple of any vector width
FORMS = {
    "parallel": ParallelForm,
    "parallel, team": TeamSharingForm,
    "centralized": CentralizedForm,
    "batch": lambda field, **settings: BatchForm(
        field, WORLDS, WORLDS - 1, same_actions=True, threads=2, **settings
    ),
}
SUMS_OF_SHARES = {"parallel": {"float64": 1e-12, "float32": 1e-6}}
"""Relative tolerance of the team's reward where it is a sum over robots: a third is no float."""
POSITION_TOLERANCE = {"float64": 1e-9, "float32": 0.005}


@cache
def golden_field(name: str) -> Field:
    """The catalogue's own field, or one of the larger fields made for the episodes."""
    return load_field(name) if name in catalogue_names() else Field(**FIELDS[name])


def replay(
    form: Form, episode: Episode, position_tolerance: float, reward_tolerance: float
) -> None:
    """Step through ``episode`` and compare everything that it records."""
    state = form.reset()
    n, total = episode.n_robots, 0.0
    for t, actions in enumerate(episode.actions):
        recorded = np.hstack([episode.positions[t].ravel(), episode.velocities[t].ravel()])
        np.testing.assert_allclose(state[: 4 * n], recorded, rtol=0, atol=position_tolerance)
        assert state[4 * n] == episode.codes[t]
        outcome = form.step(actions)
        state = outcome.state
        assert outcome.team_reward == pytest.approx(episode.rewards[t], rel=reward_tolerance, abs=0)
        assert outcome.terminated == episode.terminated[t]
        assert outcome.truncated == (t == 999 and not outcome.terminated)
        total += outcome.team_reward
    np.testing.assert_allclose(
        state[: 2 * n], episode.positions[-1].ravel(), rtol=0, atol=position_tolerance
    )
    assert state[4 * n] == episode.codes[-1]
    assert total == pytest.approx(episode.episode_return, rel=0, abs=reward_tolerance * 1e6)


@pytest.mark.parametrize("dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("episode", load_episodes(), ids=lambda episode: episode.id)
def test_golden_episode(episode: Episode, form: str, dtype: str) -> None:
    field = golden_field(episode.field)
    world = FORMS[form](field, n_robots=episode.n_robots, wind=episode.wind, dtype=dtype)
    tolerance = SUMS_OF_SHARES.get(form, {"float64": 0.0, "float32": 0.0})[dtype]
    replay(world, episode, POSITION_TOLERANCE[dtype], tolerance)
