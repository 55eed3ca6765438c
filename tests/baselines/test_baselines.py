"""Statistics, storage, hyperparameters, networks and evaluation, against numbers worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from baselines.evaluation import intervals as statistics
from baselines.evaluation.evaluate import evaluate
from baselines.policies.policy import Policy
from baselines.sb3 import config as centralized_config
from baselines.torchrl.networks import GaussianPolicy, TeamShape
from baselines.torchrl.policy import TeamPolicy
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field

SQUARE = Field(
    vertices=[(0, 0), (200, 0), (200, 200), (0, 200)],
    rois=[(130, 100), (100, 160)],
    starts=[(100, 100), (20, 100)],
)


class ConstantPolicy(Policy):
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
    with pytest.raises(ValueError):
        statistics.mean_interval([])


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
