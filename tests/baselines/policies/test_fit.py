"""A policy is refused where it would not see what it was trained to see."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from baselines.evaluation.evaluate import evaluate
from baselines.evaluation.rollout import record_episode
from baselines.policies.load import load_trained, merge_settings, open_run
from baselines.policies.policy import Observes, Origin, Policy
from mbn_marl import BatchEngine, Uniform
from mbn_marl.config import CONDITIONS, make_config
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field

pytestmark = pytest.mark.slow

CORNERS = [(0, 0), (200, 0), (200, 200), (0, 200)]
HOME = Field(CORNERS, [(130, 100)], [(100, 100), (20, 100)], arena=(200, 200))
LARGER = Field(CORNERS, HOME.rois, HOME.starts, arena=(400, 400))
OTHER = Field(CORNERS, [(130, 100), (50, 50)], HOME.starts, arena=(300, 200))
SHOWN: dict[str, Any] = {
    **{"dynamics": ("point_mass", "unicycle"), "failures": {"at": {1: 3}}},
    **{"wind": (0.1, 30.0), "max_steps": 6},
}
"""Every observation has entries of headings and failures."""


class Trained(Policy):
    def __init__(self, observes: Observes = "observations", **settings: Any) -> None:
        self.observes, self.origin = observes, Origin(HOME, make_config(settings))
        self.seen: np.ndarray | None = None

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        if self.seen is None:
            self.seen = seen.copy()
        return np.zeros((len(seen), 2, 2), np.float32)


def refused(policy: Policy, field: Field, settings: dict[str, Any]) -> list[str]:
    named = []
    for run in (evaluate, record_episode):
        with pytest.raises(ConfigError) as caught:
            run(policy, field, settings)  # type: ignore[operator]
        named.append([problem.partition(":")[0] for problem in caught.value.problems])
    assert named[0] == named[1]
    return named[0]


def test_all_that_differs_is_named_at_once() -> None:
    one_robot = {"n_robots": 1, "observation": "lidar"}
    seen = ["robots", "ROIs", "arena", "observation"]
    for policy, field, settings, named in (
        (Trained(), LARGER, {}, ["arena"]),
        (Trained(), OTHER, one_robot, seen),
        (Trained(), HOME, {"v_clip": (5.0, 6.0)}, ["v_clip"]),
        (Trained("state"), LARGER, {"n_robots": 1}, ["robots"]),
        (Trained(**SHOWN), HOME, {}, ["headings"]),
        (Trained("state", **SHOWN), HOME, {}, ["headings"]),
        *(
            (Trained(observation="lidar_local"), HOME, {"observation": kind}, ["observation"])
            for kind in ("state", "relative", "local", "lidar")
        ),
    ):
        assert refused(policy, field, settings) == named, (field, settings)
    with pytest.raises(ConfigError, match="v_clip: "):
        evaluate(Trained(), HOME, {"v_clip": Uniform(4.0, 7.0)}, episodes=1)
    run = open_run("zoo:field_03")
    larger = Field(run.field.vertices, run.field.rois, run.field.starts, arena=(900, 900))
    assert refused(load_trained(run), larger, run.config["environment"]) == ["arena"]


def test_numbers_that_a_policy_does_not_see_may_differ() -> None:
    moved = Field(CORNERS, [(30, 30)], HOME.starts, arena=(200, 200))
    evaluate(Trained(), moved, {"max_steps": 2, "wind": (0.1, 0.0)}, episodes=1)
    evaluate(Trained("state"), LARGER, {"max_steps": 2, "observation": "lidar"}, episodes=1)


@pytest.mark.parametrize("observes", ["observations", "state"])
def test_entries_that_a_policy_was_not_trained_with_are_not_shown_to_it(observes: Observes) -> None:
    engine = BatchEngine(HOME, 1, **SHOWN)
    engine.reset()
    if observes == "state":
        shown, plain = engine.state(), BatchEngine(HOME, 1).state_low.size
        expected = np.delete(shown[0], [8, 9, 10, 11])  # headings, failures
    else:
        shown, plain = engine.step(np.ones((1, 2, 2)))[0], BatchEngine(HOME, 1).obs_size
        names = [entry.name for entry in engine.observation_table]
        more = [k for k, name in enumerate(names) if name.endswith(("_cos", "_sin", "_failed"))]
        expected = np.delete(shown, more, axis=2)[0]
    trained = Trained(observes)
    trained.fit(engine).act_in(engine, shown)
    assert trained.seen is not None and trained.seen.shape[-1] == plain
    assert np.array_equal(trained.seen[0], expected)
    assert len(evaluate(Trained(observes), HOME, SHOWN, episodes=2).steps) == 2


def test_a_condition_replaces_weather_and_failures_but_not_the_robots() -> None:
    trained = {"wind": (0.1, 30.0), "dynamics": "unicycle", "failures": {"rate": 0.1}, "tau": 2.0}
    assert merge_settings(trained, None) == trained
    assert merge_settings(trained, "calm") == {"dynamics": "unicycle", "tau": 2.0}
    gusty = merge_settings(trained, "gusty")
    assert gusty == {**CONDITIONS["gusty"], "dynamics": "unicycle", "tau": 2.0}
    assert merge_settings(trained, "mixed")["dynamics"] == "mixed"
    assert merge_settings(trained, "gusty", wind=(0.2, 0.0))["wind"] == (0.2, 0.0)
    with pytest.raises(ConfigError, match="wind: "):
        merge_settings(trained, "windy", wind=(0.2, 0.0))
