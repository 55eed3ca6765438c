"""Evaluations whose episodes are all the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from baselines.evaluation.evaluate import is_one_episode
from baselines.policies.classical import make_classical
from baselines.policies.policy import Policy, RandomPolicy
from mbn_marl.field import load_field


class Still(Policy):
    observes = "state"

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        return np.zeros((len(seen), 3, 2), np.float32)


@pytest.mark.parametrize(
    ("policy", "settings", "deterministic", "one"),
    [
        (Still(), {}, True, True),
        (Still(), {}, False, False),
        (Still(), {"random_starts": True}, True, False),
        (Still(), {"failures": {"at": {0: 3}}}, True, True),
        (Still(), {"failures": {"at": {0: 3}, "rate": 0.1}}, True, False),
        (RandomPolicy(), {}, True, False),
        (make_classical("greedy", load_field("field_03"), {}), {}, False, True),
    ],
)
def test_one_episode_is_enough_if_nothing_is_drawn(
    policy: Policy, settings: dict[str, Any], deterministic: bool, one: bool
) -> None:
    assert is_one_episode(policy, settings, deterministic=deterministic) is one
