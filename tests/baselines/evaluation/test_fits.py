"""A policy is refused where it would not see what it was trained to see."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest

from baselines.evaluation.evaluate import evaluate
from baselines.evaluation.policy import Origin, load_policy
from baselines.evaluation.rollout import record_episode
from baselines.zoo.entries import open_run
from mbn_marl.config import make_config
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field

CORNERS = [(0, 0), (200, 0), (200, 200), (0, 200)]
HOME = Field(CORNERS, [(130, 100)], [(100, 100), (20, 100)], arena=(200, 200))


class Trained:
    """Robots without force, trained in ``HOME``."""

    def __init__(self, observes: Literal["observations", "state"] = "observations") -> None:
        self.observes = observes
        self.origin = Origin(HOME, make_config({}))

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        return np.zeros((len(seen), 2, 2), np.float32)


def refused(policy: Any, field: Field, settings: dict[str, Any]) -> list[str]:
    """What the errors of both ways to run a policy name."""
    named = []
    for run in (evaluate, record_episode):
        with pytest.raises(ConfigError) as caught:
            run(policy, field, settings)  # type: ignore[operator]
        named.append([problem.partition(":")[0] for problem in caught.value.problems])
    assert named[0] == named[1]
    return named[0]


def test_a_larger_arena_is_refused_since_observations_are_scaled_by_it() -> None:
    larger = Field(CORNERS, HOME.rois, HOME.starts, arena=(400, 400))
    assert refused(Trained(), larger, {}) == ["arena"]


def test_all_that_differs_is_named_at_once() -> None:
    other = Field(CORNERS, [(130, 100), (50, 50)], HOME.starts, arena=(300, 200))
    settings = {"n_robots": 1, "observation": "lidar"}
    assert refused(Trained(), other, settings) == ["robots", "ROIs", "arena", "observation"]


def test_a_policy_on_the_state_has_to_fit_in_its_sizes_alone() -> None:
    larger = Field(CORNERS, HOME.rois, HOME.starts, arena=(400, 400))
    evaluate(Trained("state"), larger, {"max_steps": 2, "observation": "lidar"}, episodes=1)
    assert refused(Trained("state"), larger, {"n_robots": 1}) == ["robots"]


def test_headings_have_to_be_there_or_not_as_in_training() -> None:
    turning = {"dynamics": ("point_mass", "unicycle"), "v_clip": (5.0, 4.0)}
    assert refused(Trained(), HOME, turning) == refused(Trained("state"), HOME, turning)
    assert refused(Trained(), HOME, turning) == ["headings"]
    assert refused(Trained(), HOME, {"v_clip": (5.0, 6.0)}) == ["v_clip"]


def test_what_does_not_scale_may_differ() -> None:
    moved = Field(CORNERS, [(30, 30)], HOME.starts, arena=(200, 200))
    evaluate(Trained(), moved, {"max_steps": 2, "wind": (0.1, 0.0)}, episodes=1)


def test_a_loaded_policy_knows_where_it_was_trained() -> None:
    run = open_run("zoo:field_03")
    larger = Field(run.field.vertices, run.field.rois, run.field.starts, arena=(900, 900))
    assert refused(load_policy(run), larger, run.config["environment"]) == ["arena"]
