"""All golden episodes, through every form of the environment, in both precisions."""

from collections.abc import Callable, Iterator
from functools import cache
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from mbn_marl import BatchEngine, Field
from mbn_marl.field import catalogue_names, load_field
from tests.golden import FIELDS, Episode, load_episodes
from tests.support.configurations import PRECISIONS
from tests.support.forms import CentralizedForm, ParallelForm, TeamSharingForm

WORLDS = 131  # no multiple of any vector width, or of the number of episodes
POSITION_TOLERANCE = {"float64": 1e-9, "float32": 0.005}
ROUNDING = {"float64": 1e-12, "float32": 1e-6}
"""Relative tolerance of the team's reward where it is a sum over robots: a third is no float."""


class Played(NamedTuple):
    states: NDArray[Any]
    rewards: NDArray[Any]
    terminated: NDArray[Any]
    truncated: NDArray[Any]


@cache
def golden_field(name: str) -> Field:
    return load_field(name) if name in catalogue_names() else Field(**FIELDS[name])


def settings_of(episode: Episode) -> dict[str, Any]:
    return {"n_robots": episode.n_robots, "wind": episode.wind}


def alone(make: Callable[..., Any]) -> Callable[[str], Iterator[tuple[Episode, Played]]]:
    """Play each episode in another environment."""

    def play(dtype: str) -> Iterator[tuple[Episode, Played]]:
        for episode in load_episodes():
            form = make(golden_field(episode.field), dtype=dtype, **settings_of(episode))
            states, results = [form.reset().copy()], []
            for action in episode.actions:
                outcome = form.step(action)
                states.append(outcome.state.copy())
                results.append((outcome.team_reward, outcome.terminated, outcome.truncated))
            yield episode, Played(np.array(states), *map(np.array, zip(*results, strict=True)))

    return play


def in_batches(dtype: str) -> Iterator[tuple[Episode, Played]]:
    """Play those of the same team and wind as the worlds of one batch, some of them repeatedly."""

    def team_and_wind(episode: Episode) -> Any:
        return episode.n_robots, episode.wind

    for _, rows in groupby(sorted(load_episodes(), key=team_and_wind), team_and_wind):
        group = list(rows)
        fields, settings = [golden_field(one.field) for one in group], settings_of(group[0])
        engine = BatchEngine(fields, WORLDS, dtype=dtype, threads=2, **settings)
        engine.reset()
        states, results = [engine.state().copy()], []
        for t in range(max(len(one.actions) for one in group)):
            actions = [one.actions[t] if t < len(one.actions) else one.actions[0] for one in group]
            _, _, *flags = engine.step(np.resize(actions, (WORLDS, *actions[0].shape)))
            ended = flags[0] | flags[1]
            states.append(np.where(ended[:, None], engine.final_state(), engine.state()))
            results.append([engine.team_rewards, *flags])
            results[-1] = [array.copy() for array in results[-1]]
        played = [np.array(states), *map(np.array, zip(*results, strict=True))]
        for world in range(WORLDS):
            episode = group[world % len(group)]
            steps = len(episode.actions)
            cuts = (steps + 1, steps, steps, steps)
            rows_of = (array[:cut, world] for array, cut in zip(played, cuts, strict=True))
            yield episode, Played(*rows_of)


FORMS = {
    "parallel": alone(ParallelForm),
    "parallel, team": alone(TeamSharingForm),
    "centralized": alone(CentralizedForm),
    "batch": in_batches,
}


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("form", FORMS)
def test_golden_episodes(form, dtype):
    close = {"rtol": ROUNDING[dtype] if form == "parallel" else 0.0, "atol": 0.0}
    there = set()
    for episode, played in FORMS[form](dtype):
        there.add(episode.id)
        steps, n = episode.actions.shape[:2]
        motion = np.concatenate([episode.positions, episode.velocities], axis=1)
        assert_allclose(
            *(played.states[:, : 4 * n], motion.reshape(steps + 1, 4 * n)),
            **{"rtol": 0.0, "atol": POSITION_TOLERANCE[dtype], "err_msg": episode.id},
        )
        assert_array_equal(played.states[:, 4 * n], episode.codes, episode.id)
        assert_allclose(played.rewards, episode.rewards, **close, err_msg=episode.id)
        assert_array_equal(played.terminated, episode.terminated, episode.id)
        late = (np.arange(steps) == 999) & ~episode.terminated
        assert_array_equal(played.truncated, late, episode.id)
    assert len(there) == 107
