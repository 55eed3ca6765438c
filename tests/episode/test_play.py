"""Actions that cannot be played are named."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mbn_marl import load_field
from mbn_marl.config import make_config
from mbn_marl.episode import play
from mbn_marl.errors import EpisodeError

STILL = [(0.0, 0.0)] * 3


@pytest.mark.parametrize(
    ("actions", "problem"),
    [
        ([STILL, [(0.0, 0.0), (np.inf, 0.0), (0.0, 0.0)]], r"step 2: actions\[0, 1\] .*finite"),
        ([[(np.nan, 0.0), *STILL[1:]]], r"step 1: actions\[0, 0\] .*finite"),
        ([STILL, STILL[1:]], r"actions: .*; allowed: numbers \(steps, 3, 2\)"),
        ([STILL[1:]], r"actions: shape \(1, 2, 2\).*; allowed: numbers \(steps, 3, 2\)"),
    ],
)
@pytest.mark.parametrize("kind", [None, np.float32, np.float64])
def test_actions_that_cannot_be_played_are_named(actions: Any, problem: str, kind: Any) -> None:
    if kind and len({len(row) for row in actions}) == 1:
        actions = np.array(actions, kind)
    with pytest.raises(EpisodeError, match=problem):
        play(load_field("field_03"), make_config({}), actions)


def test_large_finite_actions_are_clipped() -> None:
    played = play(load_field("field_03"), make_config({}), np.full((2, 3, 2), -1e300))
    assert (played.actions == -1.0).all()
    np.testing.assert_array_equal(played.positions[1], played.positions[0] - 0.5)
