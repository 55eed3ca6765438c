"""Statistics, storage, hyperparameters, networks and evaluation, against numbers worked by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch

from baselines.algorithms import ALGORITHMS, find_algorithm
from baselines.evaluation import intervals as statistics
from baselines.evaluation.evaluate import evaluate
from baselines.evaluation.policy import RandomPolicy
from baselines.runs.files import RunError
from baselines.sb3 import config as centralized_config
from baselines.sb3.policy import Normalization
from baselines.torchrl import config as decentralized_config
from baselines.torchrl.networks import (
    CRITICS,
    GaussianPolicy,
    ObservationNorm,
    Sharing,
    TeamMLP,
    TeamShape,
)
from baselines.torchrl.policy import DecentralizedPolicy, load_policy
from baselines.training.run_logger import EpisodeWindow
from mbn_marl.config import NavigationConfig
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, load_field
from mbn_marl.optimum import optimal_return

SQUARE = Field(
    vertices=[(0, 0), (200, 0), (200, 200), (0, 200)],
    rois=[(130, 100), (100, 160)],
    starts=[(100, 100), (20, 100)],
)


class ConstantPolicy:
    """Every robot takes the same action at every step."""

    observes: Literal["observations", "state"] = "state"

    def __init__(self, x: float, y: float) -> None:
        self._action = np.array([x, y], np.float32)

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        return np.broadcast_to(self._action, (len(seen), (seen.shape[1] - 1) // 4, 2))


# Statistics


def test_mean_interval_of_one_seed_has_no_interval() -> None:
    assert statistics.mean_interval([5.0]) == statistics.Interval(5.0, None, None)


def test_mean_interval_of_equal_seeds_is_a_point() -> None:
    assert statistics.mean_interval([2.0, 2.0, 2.0]) == statistics.Interval(2.0, 2.0, 2.0)


def test_mean_interval_of_two_seeds_spans_them() -> None:
    # A resample of (0, 10) has mean 0, 5 or 10 with probability 1/4, 1/2, 1/4: the 2.5 % and the
    # 97.5 % points are the ends.
    assert statistics.mean_interval([0.0, 10.0]) == statistics.Interval(5.0, 0.0, 10.0)


def test_mean_interval_lies_inside_many_seeds() -> None:
    interval = statistics.mean_interval([float(value) for value in range(101)])
    # The bootstrap's standard error is 29.15 / sqrt(101) = 2.90, so the interval is 50 -+ 5.7.
    assert interval.mean == 50.0
    assert interval.low == pytest.approx(44.3, abs=0.5)
    assert interval.high == pytest.approx(55.7, abs=0.5)


def test_mean_interval_of_nothing_is_an_error() -> None:
    with pytest.raises(ValueError, match="at least one"):
        statistics.mean_interval([])


def _history(*returns: float) -> list[dict[str, Any]]:
    return [
        {"env_steps": 100 * (index + 1), "seconds": 2.0 * (index + 1), "return_mean": value}
        for index, value in enumerate(returns)
    ]


def test_reach_takes_the_first_evaluation_at_the_threshold() -> None:
    histories = [
        _history(0.0, 100_000.0, 5.0),
        _history(0.0, 99_999.0, 0.0, 120_000.0),
        _history(0.0),
    ]
    assert statistics.reach(histories) == statistics.Reach(2, 3, env_steps=300.0, seconds=6.0)


def test_reach_of_runs_that_never_got_there() -> None:
    assert statistics.reach([_history(1.0)]) == statistics.Reach(0, 1, None, None)


# Hyperparameters


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_has_hyperparameters_and_refuses_unknown_ones(name: str) -> None:
    algorithm = find_algorithm(name)
    assert algorithm.resolve({}).reward_scale > 0
    with pytest.raises(ConfigError, match=r"momentum.*known: .*gamma|momentum.*known: .*model"):
        algorithm.resolve({"momentum": 0.9})


def test_centralized_hyperparameters_are_files_on_disk() -> None:
    names = {path.stem for path in centralized_config.FOLDER.glob("*.yaml")}
    registered = {name for name, entry in ALGORITHMS.items() if entry.form == "centralized"}
    assert names == set(centralized_config.CLASSES) == registered


def test_centralized_model_arguments_are_those_of_the_library() -> None:
    changed = centralized_config.load("ppo", "N", {"model": {"gamma": 0.5}})
    assert changed.model == {**centralized_config.load("ppo", "N", {}).model, "gamma": 0.5}
    with pytest.raises(ConfigError, match=r"model\.tau: unknown name; known: .*gamma"):
        centralized_config.load("ppo", "N", {"model": {"tau": 0.1}})


def test_centralized_schedules_fall_linearly() -> None:
    config = centralized_config.load(
        "ppo", "N", {"model": {"learning_rate": {"from": 3.0, "to": 1.0}}}
    )
    rate = centralized_config.model_arguments(config)["learning_rate"]
    assert [rate(remaining) for remaining in (1.0, 0.5, 0.0)] == [3.0, 2.0, 1.0]


def test_mappo_and_ippo_differ_by_the_critic_alone() -> None:
    mappo, ippo = (
        decentralized_config.load(name, "N", {}).model_dump() for name in ("mappo", "ippo")
    )
    assert (mappo.pop("critic"), ippo.pop("critic")) == ("centralized", "independent")
    assert mappo == ippo


def test_the_cap_of_the_standard_deviation_stays_and_then_falls() -> None:
    config = decentralized_config.load(
        "mappo",
        "N",
        {"log_std_cap": [0.5, -1.5], "log_std_cap_from": 0.5, "learning_rate": [3.0, 1.0]},
    )
    assert [config.cap_at(progress) for progress in (0.0, 0.5, 0.75, 1.0)] == [0.5, 0.5, -0.5, -1.5]
    assert [config.learning_rate_at(progress) for progress in (0.0, 0.25, 1.0)] == [3.0, 2.5, 1.0]


# Networks and policies


def test_observation_norm_passes_on_until_it_has_seen_something() -> None:
    norm = ObservationNorm(TeamShape(2, 1, (8,), "full"))
    assert norm(torch.tensor([3.0, 5.0])).tolist() == [3.0, 5.0]
    norm.update(torch.tensor([[[0.0, 1.0]], [[2.0, 5.0]]]))  # means 1 and 3, variances 1 and 4
    assert norm(torch.tensor([2.0, 5.0])).tolist() == [1.0, 1.0]
    assert norm(torch.tensor([100.0, 3.0])).tolist() == [10.0, 0.0]


def test_robots_with_networks_of_their_own_are_normalised_apart() -> None:
    norm = ObservationNorm(TeamShape(1, 2, (8,), "none"))
    norm.update(torch.tensor([[[0.0], [10.0]], [[2.0], [30.0]]]))  # means 1, 20; deviations 1, 10
    assert norm(torch.tensor([[2.0], [10.0]])).tolist() == [[1.0], [-1.0]]


@pytest.mark.parametrize("sharing", ["full", "none"])
def test_a_shared_network_treats_robots_alike(sharing: Sharing) -> None:
    torch.manual_seed(0)
    shape = TeamShape(4, 3, (8,), sharing)
    outputs = TeamMLP(shape.networks, (4, 8, 2), last_gain=1.0)(torch.ones(5, 3, 4))
    assert torch.equal(outputs[:, 0], outputs[:, 1]) == (sharing == "full")


@pytest.mark.parametrize("networks", [1, 3])
def test_team_networks_compute_what_separate_layers_do(networks: int) -> None:
    torch.manual_seed(0)
    network = TeamMLP(networks, (4, 8, 6, 2), last_gain=1.0)
    rows = torch.randn(7, 5, 3, 4)
    outputs = network(rows)
    for robot in range(3):
        flow = rows[:, :, robot]
        for layer, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
            own = robot if networks > 1 else 0
            flow = (flow.tanh() if layer else flow) @ weight[own] + bias[own]
        assert torch.allclose(outputs[:, :, robot], flow, atol=1e-6)


@pytest.mark.parametrize("sharing", ["full", "none"])
@pytest.mark.parametrize("critic", CRITICS)
def test_only_the_centralized_critic_sees_the_other_robots(critic: str, sharing: Sharing) -> None:
    torch.manual_seed(0)
    network = CRITICS[critic](TeamShape(4, 3, (8,), sharing))
    before = torch.randn(5, 3, 4)
    after = before.clone()
    after[:, 2] += 1.0
    changed = (network(after) - network(before)).abs().amax(dim=0) > 1e-6
    assert changed.tolist() == ([True] * 3 if critic == "centralized" else [False, False, True])


@pytest.mark.parametrize("networks", [1, 3])
def test_networks_start_orthogonal(networks: int) -> None:
    network = TeamMLP(networks, (8, 8, 2), last_gain=0.01)
    gain = (5.0 / 3.0) ** 2  # of tanh, squared
    assert len(network.weights[0]) == networks
    for weight in network.weights[0]:
        assert torch.allclose(weight @ weight.T, gain * torch.eye(8), atol=1e-5)
    for weight in network.weights[1]:
        assert torch.allclose(weight.T @ weight, 1e-4 * torch.eye(2), atol=1e-8)


@pytest.mark.parametrize("sharing", ["full", "full+id", "none"])
def test_a_saved_policy_acts_as_before(tmp_path: Path, sharing: Sharing) -> None:
    torch.manual_seed(0)
    network = GaussianPolicy(TeamShape(4, 3, (8, 8), sharing), log_std=-0.5)
    network.norm.update(torch.randn(100, 3, 4) * 3.0)
    policy = DecentralizedPolicy(network)
    policy.save(tmp_path)
    assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".safetensors"}
    observations = np.random.default_rng(0).normal(size=(6, 3, 4)).astype(np.float32)
    loaded = load_policy(tmp_path)
    for deterministic in (True, False):
        torch.manual_seed(1)
        expected = policy.act(observations, deterministic=deterministic)
        torch.manual_seed(1)
        assert np.array_equal(expected, loaded.act(observations, deterministic=deterministic))


def test_a_damaged_policy_is_named(tmp_path: Path) -> None:
    DecentralizedPolicy(GaussianPolicy(TeamShape(4, 3, (8,), "full"))).save(tmp_path)
    (tmp_path / "policy.safetensors").write_bytes(b"nonsense")
    with pytest.raises(RunError, match=r"policy\.safetensors cannot be read"):
        load_policy(tmp_path)


def test_normalization_is_that_of_vec_normalize() -> None:
    norm = Normalization(np.array([1.0, 0.0]), np.array([4.0, 1.0]), 5.0, epsilon=0.0, clip=10.0)
    assert norm(np.array([[5.0, -20.0]])).tolist() == [[2.0, -10.0]]
    copy = Normalization.from_json(json.loads(json.dumps(norm.to_json())))
    assert copy(np.array([[5.0, -20.0]])).tolist() == [[2.0, -10.0]]


# Evaluation


def test_evaluation_reports_true_returns() -> None:
    # Full thrust to the right: v = 0.5, 1.0, ..., so x = 100, 100.5, 101.5, 103, ...; after step t
    # robot 0 has moved t (t + 1) / 4 and robot 1 as much. ROI 0 is in reach (20 units) at t = 9.
    field = Field(vertices=SQUARE.vertices, rois=[(130, 100)], starts=[(100, 100), (20, 100)])
    result = evaluate(ConstantPolicy(1.0, 0.0), field, {}, episodes=3)
    assert result.steps == [9, 9, 9]
    assert result.successes == [True] * 3
    assert result.returns == [110_000.0 - 2 * 10 * 9] * 3
    summary = result.summary()
    assert (summary["return_mean"], summary["makespan"]) == (109_820.0, 9.0)


def test_evaluation_of_a_policy_that_never_gets_there() -> None:
    result = evaluate(ConstantPolicy(0.0, 0.0), SQUARE, {"max_steps": 4}, episodes=2)
    # Each robot stands still: 10 for the first step, 100 for each of the three that follow.
    assert result.returns == [-620.0, -620.0]
    assert result.summary()["makespan"] is None
    assert result.summary()["success_rate"] == 0.0


def test_evaluations_are_reproducible_and_leave_torch_alone() -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    network = GaussianPolicy(TeamShape(4 + 4 + 2 * 3, 2, (8,), "full"))
    torch.manual_seed(5)
    runs = [
        evaluate(DecentralizedPolicy(network), SQUARE, {"max_steps": 20}, episodes=4).returns
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


# The optimum


def test_optimal_return_is_the_proved_one() -> None:
    assert optimal_return(load_field("field_03")) == 159_490.0
    assert (
        optimal_return(load_field("field_03"), NavigationConfig(reward_sharing="team")) == 159_490
    )
    assert optimal_return(SQUARE) is None


@pytest.mark.parametrize(
    "changed", [{"wind": (0.1, 30.0)}, {"reward": "formal"}, {"n_robots": 2}, {"f_max": 1.0}]
)
def test_optimal_return_is_not_claimed_for_another_mdp(changed: dict[str, Any]) -> None:
    assert optimal_return(load_field("field_03"), NavigationConfig(**changed)) is None
