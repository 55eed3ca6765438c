"""Policies that try their episode in the engine first."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import pytest

from baselines import load_policy
from baselines.evaluation.evaluate import evaluate, roll_out
from baselines.evaluation.fitting import fitted
from baselines.evaluation.lookahead import Lookahead, missing
from mbn_marl import BatchEngine, Field, load_field
from mbn_marl.errors import ConfigError
from tests.baselines.conftest import Refusal

WALLS = [(100, 100), (400, 100), (400, 400), (100, 400)]
ROOM = Field(WALLS, [(130, 240), (100, 260)], [(100, 200)])


class Resting:
    """Do nothing."""

    observes: Literal["observations", "state"] = "state"

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Return zeros for the one robot of each world."""
        return np.zeros((len(seen), 1, 2), np.float32)


def test_the_best_episode_that_was_found_is_acted_in_every_world_and_again_after_its_end() -> None:
    field = load_field("field_03")
    bare = load_policy("greedy", field)
    ahead = evaluate(Lookahead(bare, 6), field, bare.settings, episodes=3, deterministic=False)
    before = evaluate(bare.policy, field, bare.settings, episodes=1)
    assert all(ahead.successes) and len(set(ahead.steps)) == 1 and not any(ahead.wall_hits)
    assert 17 <= ahead.steps[0] < before.steps[0]  # 17 is the proved optimum
    engine = BatchEngine(field, 2, **bare.settings)
    steps = roll_out(engine, Lookahead(bare, 6), deterministic=True, seed=0)
    ends = [next(steps) for _ in range(2 * ahead.steps[0])]
    assert np.flatnonzero(np.all(ends, axis=1)).tolist() == [
        ahead.steps[0] - 1,
        2 * ahead.steps[0] - 1,
    ]


def test_without_a_success_the_policy_acts_as_it_is() -> None:
    engine = BatchEngine(ROOM, 2, max_steps=5)
    acting = fitted(Lookahead(Resting(), 2), engine)
    engine.reset(seed=0)
    assert not acting.act(engine.state(), deterministic=False).any()


def test_an_episode_of_one_step_cannot_be_shorter() -> None:
    there = Field(WALLS, [(205, 200)], [(200, 200)])
    assert evaluate(Lookahead(Resting(), 2), there, {}, episodes=1).steps == [1]


def test_a_search_climbs_to_its_first_success_within_short_episodes() -> None:
    found = evaluate(Lookahead(Resting(), 20), ROOM, {"max_steps": 60}, episodes=1)
    assert found.successes == [True]


def test_a_loaded_policy_looks_ahead_for_any_number_of_worlds() -> None:
    policy = load_policy("lookahead:greedy", ROOM)
    engine = BatchEngine(ROOM, 3, **policy.settings)
    engine.reset(seed=0)
    ends = []
    for _ in range(100):
        _, _, terminated, _ = engine.step(policy.act(engine.state()))
        policy.reset(terminated)
        ends.append(terminated.tolist())
    first = ends.index([True] * 3) + 1
    assert ends == [[step % first == 0] * 3 for step in range(1, 101)]


def test_missing_is_the_way_left_and_a_diagonal_for_every_wall_hit() -> None:
    engine = BatchEngine(ROOM, 2)
    engine.reset(seed=0)
    np.testing.assert_allclose(missing(engine), 50 + 60)
    engine.step([[[-1, 0]], [[0, 0]]])
    diagonal = math.hypot(1000, 1000)
    np.testing.assert_allclose(missing(engine), [50 + 60 + diagonal, 50 + 60], rtol=1e-6)


def test_where_episodes_differ_it_does_not_look_ahead(refusal: Refusal) -> None:
    several = BatchEngine(["field_03", "field_04"], 2, gust=0.1)
    with pytest.raises(ConfigError) as caught:
        fitted(Lookahead(Resting()), several)
    assert [problem.partition(":")[0] for problem in caught.value.problems] == [
        "condition",
        "fields",
    ]
    words = ["evaluate", "lookahead:greedy", "--field", "field_03", "--condition", "gusty"]
    assert "lookahead: 1 problem\n  - condition: " in refusal(words)
    assert "field: needed" in refusal(["evaluate", "lookahead:greedy"])
    with pytest.raises(ConfigError, match="field: greedy"):
        load_policy("lookahead:greedy")
    assert "allowed after lookahead:" in refusal(["evaluate", "lookahead:", "--field", "field_03"])
    assert "shield: 1 problem" in refusal([*words[:4], "--shield"])
    assert "deployment: 1 problem" in refusal(["deploy", "lookahead:greedy", "--field", "field_03"])
    with pytest.raises(ConfigError, match="fitted"):
        Lookahead(Resting()).act(np.zeros((1, 5)), deterministic=True)
