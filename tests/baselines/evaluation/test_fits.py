"""A policy is refused where it would not see what it was trained to see."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest

from baselines.evaluation.evaluate import evaluate, under
from baselines.evaluation.fitting import fitted
from baselines.evaluation.policy import Origin, load_trained
from baselines.evaluation.rollout import record_episode
from baselines.zoo.entries import open_run
from mbn_marl import BatchEngine, Uniform
from mbn_marl.config import CONDITIONS, make_config
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field

pytestmark = pytest.mark.slow

CORNERS = [(0, 0), (200, 0), (200, 200), (0, 200)]
HOME = Field(CORNERS, [(130, 100)], [(100, 100), (20, 100)], arena=(200, 200))


class Trained:
    """Robots without force, trained in ``HOME``."""

    def __init__(self, observes: Literal["observations", "state"] = "observations") -> None:
        self.observes = observes
        self.origin = Origin(HOME, make_config({}))

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        return np.zeros((len(seen), 2, 2), np.float32)


class Watching(Trained):
    """One that keeps what it was shown first."""

    seen: np.ndarray | None = None

    def act(self, shown: np.ndarray, *, deterministic: bool) -> np.ndarray:
        if self.seen is None:
            self.seen = shown.copy()
        return super().act(shown, deterministic=deterministic)


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


def test_another_kind_of_observation_is_named() -> None:
    trained = Trained()
    trained.origin = Origin(HOME, make_config({"observation": "lidar_local"}))
    for kind in ("state", "relative", "local", "lidar"):
        assert refused(trained, HOME, {"observation": kind}) == ["observation"]


def test_a_policy_on_the_state_has_to_fit_in_its_sizes_alone() -> None:
    larger = Field(CORNERS, HOME.rois, HOME.starts, arena=(400, 400))
    evaluate(Trained("state"), larger, {"max_steps": 2, "observation": "lidar"}, episodes=1)
    assert refused(Trained("state"), larger, {"n_robots": 1}) == ["robots"]


SHOWN: dict[str, Any] = {
    **{"dynamics": ("point_mass", "unicycle"), "failures": {"at": {1: 3}}},
    **{"wind": (0.1, 30.0), "max_steps": 6},
}
"""Every observation has entries of headings and failures."""


@pytest.mark.parametrize("observes", ["observations", "state"])
def test_what_a_policy_was_not_trained_with_is_not_shown_to_it(
    observes: Literal["observations", "state"],
) -> None:
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
    trained = Watching(observes)
    fitted(trained, engine).act(shown, deterministic=True)
    assert trained.seen is not None and trained.seen.shape[-1] == plain
    assert np.array_equal(trained.seen[0], expected)
    assert len(evaluate(Watching(observes), HOME, SHOWN, episodes=2).steps) == 2


@pytest.mark.parametrize("observes", ["observations", "state"])
def test_headings_that_a_policy_was_trained_with_have_to_be_shown(
    observes: Literal["observations", "state"],
) -> None:
    trained = Trained(observes)
    trained.origin = Origin(HOME, make_config(SHOWN))
    assert refused(trained, HOME, {}) == ["headings"]


@pytest.mark.parametrize("observes", ["observations", "state"])
def test_flags_of_failed_robots_are_zero_where_none_can_fail(
    observes: Literal["observations", "state"],
) -> None:
    turning: dict[str, Any] = {"dynamics": SHOWN["dynamics"]}
    failing = turning | {"failures": SHOWN["failures"]}
    engine, wanted = BatchEngine(HOME, 1, **turning), BatchEngine(HOME, 1, **failing)
    for one in (engine, wanted):
        one.reset()
        one.step(np.ones((1, 2, 2)))  # robot 1 fails two steps later
    shown, expected = (
        one.state() if observes == "state" else one.step(np.ones((1, 2, 2)))[0]
        for one in (engine, wanted)
    )
    trained = Watching(observes)
    trained.origin = Origin(HOME, make_config(failing))
    fitted(trained, engine).act(shown, deterministic=True)
    assert trained.seen is not None and np.array_equal(trained.seen, expected)


def test_the_scale_of_speeds_has_to_be_that_of_training() -> None:
    assert refused(Trained(), HOME, {"v_clip": (5.0, 6.0)}) == ["v_clip"]
    with pytest.raises(ConfigError, match="v_clip: "):
        evaluate(Trained(), HOME, {"v_clip": Uniform(4.0, 7.0)}, episodes=1)


def test_what_does_not_scale_may_differ() -> None:
    moved = Field(CORNERS, [(30, 30)], HOME.starts, arena=(200, 200))
    evaluate(Trained(), moved, {"max_steps": 2, "wind": (0.1, 0.0)}, episodes=1)


def test_a_loaded_policy_knows_where_it_was_trained() -> None:
    run = open_run("zoo:field_03")
    larger = Field(run.field.vertices, run.field.rois, run.field.starts, arena=(900, 900))
    assert refused(load_trained(run), larger, run.config["environment"]) == ["arena"]


def test_a_condition_replaces_weather_and_failures_but_not_the_robots() -> None:
    trained = {"wind": (0.1, 30.0), "dynamics": "unicycle", "failures": {"rate": 0.1}, "tau": 2.0}
    assert under(trained, None) == trained
    assert under(trained, "calm") == {"dynamics": "unicycle", "tau": 2.0}
    assert under(trained, "gusty") == {**CONDITIONS["gusty"], "dynamics": "unicycle", "tau": 2.0}
    assert under(trained, "mixed")["dynamics"] == "mixed"
    assert under(trained, "gusty", wind=(0.2, 0.0))["wind"] == (0.2, 0.0)
    with pytest.raises(ConfigError, match="wind: "):
        under(trained, "windy", wind=(0.2, 0.0))
