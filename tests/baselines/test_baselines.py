"""Statistics, storage, hyperparameters, networks and evaluation, against numbers worked by hand."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import torch

from baselines.algorithms import ALGORITHMS
from baselines.evaluation import intervals as statistics
from baselines.evaluation.evaluate import evaluate
from baselines.policies.policy import Policy, RandomPolicy
from baselines.sb3 import config as centralized_config
from baselines.sb3.policy import Normalization
from baselines.torchrl.networks import GaussianPolicy, TeamShape
from baselines.torchrl.policy import TeamPolicy
from baselines.training.run_logger import EpisodeWindow
from mbn_marl.config import NavigationConfig
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, load_field
from mbn_marl.optimum import optimal_return

SQUARE = Field(
    vertices=[(0, 0), (200, 0), (200, 200), (0, 200)],
    rois=[(130, 100), (100, 160)],
    starts=[(100, 100), (20, 100)],
)


class ConstantPolicy(Policy):
    """Every robot takes the same action at every step."""

    observes = "state"

    def __init__(self, x: float, y: float) -> None:
        self._action = np.array([x, y], np.float32)

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        return np.broadcast_to(self._action, (len(seen), (seen.shape[1] - 1) // 4, 2))


def test_mean_intervals_by_hand() -> None:
    assert statistics.mean_interval([5.0]) == statistics.Interval(5.0, None, None)
    assert statistics.mean_interval([2.0, 2.0, 2.0]) == statistics.Interval(2.0, 2.0, 2.0)
    # A resample of (0, 10) has mean 0, 5 or 10 with probability 1/4, 1/2, 1/4: the 2.5 % and the
    # 97.5 % points are the ends.
    assert statistics.mean_interval([0.0, 10.0]) == statistics.Interval(5.0, 0.0, 10.0)
    interval = statistics.mean_interval([float(value) for value in range(101)])
    # The bootstrap's standard error is 29.15 / sqrt(101) = 2.90, so the interval is 50 -+ 5.7.
    assert interval.mean == 50.0
    assert interval.low == pytest.approx(44.3, abs=0.5)
    assert interval.high == pytest.approx(55.7, abs=0.5)
    with pytest.raises(ValueError):
        statistics.mean_interval([])


def test_every_algorithm_has_hyperparameters_and_refuses_unknown_ones() -> None:
    for algorithm in ALGORITHMS.values():
        assert algorithm.resolve({}).reward_scale > 0
        with pytest.raises(ConfigError, match="momentum: "):
            algorithm.resolve({"momentum": 0.9})


def test_centralized_model_arguments_are_those_of_the_library() -> None:
    schedule = {"model": {"gamma": 0.5, "learning_rate": {"from": 3.0, "to": 1.0}}}
    changed = centralized_config.load("ppo", "N", schedule)
    assert changed.model == {
        **centralized_config.load("ppo", "N", {}).model,
        **{"gamma": 0.5, "learning_rate": changed.model["learning_rate"]},
    }
    rate = centralized_config.model_arguments(changed)["learning_rate"]
    past_the_budget = -0.5
    assert [rate(rest) for rest in (1.0, 0.5, 0.0, past_the_budget)] == [3.0, 2.0, 1.0, 1.0]
    with pytest.raises(ConfigError, match=r"model\.tau: "):
        centralized_config.load("ppo", "N", {"model": {"tau": 0.1}})


def test_normalization_is_that_of_vec_normalize() -> None:
    norm = Normalization(np.array([1.0, 0.0]), np.array([4.0, 1.0]), 5.0, epsilon=0.0, clip=10.0)
    copy = Normalization.from_json(json.loads(json.dumps(norm.to_json())))
    for one in (norm, copy):
        assert one(np.array([[5.0, -20.0]])).tolist() == [[2.0, -10.0]]


def test_evaluation_reports_true_returns() -> None:
    # Full thrust to the right: v = 0.5, 1.0, ..., so x = 100, 100.5, 101.5, 103, ...; after step t
    # robot 0 has moved t (t + 1) / 4 and robot 1 as much. ROI 0 is in reach (20 units) at t = 9.
    field = Field(vertices=SQUARE.vertices, rois=[(130, 100)], starts=SQUARE.starts)
    result = evaluate(ConstantPolicy(1.0, 0.0), field, {}, episodes=3)
    assert (result.steps, result.successes) == ([9] * 3, [True] * 3)
    assert result.returns == [110_000.0 - 2 * 10 * 9] * 3
    summary = result.summary()
    assert (summary["return_mean"], summary["makespan"]) == (109_820.0, 9.0)
    # Each robot that rests gets 10 for the first step, 100 for each of the three that follow.
    result = evaluate(ConstantPolicy(0.0, 0.0), SQUARE, {"max_steps": 4}, episodes=2)
    assert result.returns == [-620.0, -620.0]
    assert (result.summary()["makespan"], result.summary()["success_rate"]) == (None, 0.0)


def test_the_seed_of_an_evaluation_decides_its_worlds() -> None:
    settings: dict[str, Any] = {"random_starts": True, "max_steps": 4}
    first = []
    for seed in (1, 2):
        how: dict[str, Any] = {"episodes": 2, "seed": seed, "record": (0,)}
        found = evaluate(ConstantPolicy(0.0, 0.0), SQUARE, settings, **how)
        first.append(found.recorded[0].snapshot(0).positions)
        engine = BatchEngine(SQUARE, 2, seed=seed, **settings)
        engine.reset()
        np.testing.assert_array_equal(first[-1], engine.snapshot().positions)
    assert not np.array_equal(*first)


def test_evaluations_are_reproducible_and_leave_torch_alone() -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    network = GaussianPolicy(TeamShape(4 + 4 + 2 * 3, 2, (8,), "full"))
    torch.manual_seed(5)
    runs = [
        evaluate(TeamPolicy(network), SQUARE, {"max_steps": 20}, episodes=4).returns
        for _ in range(2)
    ]
    assert runs[0] == runs[1]
    assert torch.equal(torch.rand(3), expected)


def test_random_policies_have_a_seed() -> None:
    seen = np.zeros((4, 3, 30), np.float32)
    first, again = (RandomPolicy(3).act(seen, deterministic=True) for _ in range(2))
    assert first.shape == (4, 3, 2)
    assert np.array_equal(first, again)
    assert np.abs(first).max() <= 1.0


def test_episode_window_forgets_what_it_has_told() -> None:
    window = EpisodeWindow()
    window.add([100.0, 300.0], [1.0, 0.0])
    row = window.pop()
    assert (row["episodes"], row["return_mean"], row["return_std"]) == (2, 200.0, 100.0)
    assert (row["return_min"], row["return_max"], row["success_rate"]) == (100.0, 300.0, 0.5)
    assert window.pop()["episodes"] == 0


def test_optimal_return_is_the_proved_one_of_this_mdp_alone() -> None:
    field = load_field("field_03")
    assert optimal_return(field) == 159_490.0
    assert optimal_return(field, NavigationConfig(reward_sharing="team")) == 159_490
    assert optimal_return(SQUARE) is None
    others: tuple[dict[str, Any], ...] = ({"wind": (0.1, 30.0)}, {"reward": "formal"})
    for changed in (*others, {"n_robots": 2}, {"f_max": 1.0}):
        assert optimal_return(field, NavigationConfig(**changed)) is None
