"""Statistics, storage, hyperparameters, networks and evaluation, against numbers worked by hand."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from baselines.algorithms import ALGORITHMS
from baselines.evaluation import intervals as statistics
from baselines.evaluation.evaluate import evaluate, is_one_episode
from baselines.policies.classical import make_classical
from baselines.policies.policy import Policy, RandomPolicy
from baselines.sb3 import config as centralized_config
from baselines.torchrl import config as multi_agent_config
from baselines.torchrl.networks import (
    GaussianPolicy,
    JointNormal,
    Key,
    Normalize,
    TeamNormal,
    TeamShape,
    ValueNetwork,
)
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


def test_mean_intervals_by_hand():
    assert statistics.mean_interval([5.0]) == statistics.Interval(5.0, None, None)
    assert statistics.mean_interval([2.0, 2.0, 2.0]) == statistics.Interval(2.0, 2.0, 2.0)
    # A resample of (0, 10) has mean 0, 5 or 10 with probability 1/4, 1/2, 1/4: the 2.5 % and the
    # 97.5 % points are the ends.
    assert statistics.mean_interval([0.0, 10.0]) == statistics.Interval(5.0, 0.0, 10.0)
    with pytest.raises(ValueError):
        statistics.mean_interval([])


def test_every_algorithm_has_hyperparameters_and_refuses_unknown_ones():
    for algorithm in ALGORITHMS.values():
        assert algorithm.resolve({}).reward_scale > 0
        with pytest.raises(ConfigError, match="momentum: "):
            algorithm.resolve({"momentum": 0.9})


def test_centralized_model_arguments_are_those_of_the_library():
    schedule = {"model": {"gamma": 0.5, "learning_rate": {"from": 3.0, "to": 1.0}}}
    changed = centralized_config.load("ppo", "N", schedule)
    assert changed.model == {
        **centralized_config.load("ppo", "N", {}).model,
        **{"gamma": 0.5, "learning_rate": changed.model["learning_rate"]},
    }
    net = {"model": {"policy_kwargs": {"net_arch": [8]}}}
    kept = centralized_config.load("ppo-shared", "N", net).model["policy_kwargs"]
    assert kept == {"net_arch": [8], "log_std_init": 0.5}
    rate = centralized_config.model_arguments(changed)["learning_rate"]
    past_the_budget = -0.5
    assert [rate(rest) for rest in (1.0, 0.5, 0.0, past_the_budget)] == [3.0, 2.0, 1.0, 1.0]


def test_a_block_of_a_file_is_read_as_the_recorded_one_is():
    load, file = multi_agent_config.load, multi_agent_config.SOURCE
    assert load("ippo", "G", {}, file=file) == load("ippo", "G", {})


def test_evaluation_reports_true_returns():
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


@pytest.mark.parametrize(
    ("policy", "settings", "deterministic", "one"),
    [
        (ConstantPolicy(0.0, 0.0), {}, True, True),
        (ConstantPolicy(0.0, 0.0), {}, False, False),
        (ConstantPolicy(0.0, 0.0), {"random_starts": True}, True, False),
        (ConstantPolicy(0.0, 0.0), {"failures": {"at": {0: 3}}}, True, True),
        (ConstantPolicy(0.0, 0.0), {"failures": {"at": {0: 3}, "rate": 0.1}}, True, False),
        (RandomPolicy(), {}, True, False),
        (make_classical("greedy", SQUARE, {}), {}, False, True),
    ],
)
def test_one_episode_is_enough_if_nothing_is_drawn(policy, settings, deterministic, one):
    assert is_one_episode(policy, settings, deterministic=deterministic) is one


def test_evaluations_are_reproducible_and_leave_torch_alone():
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


def test_normalisation_begins_with_the_first_update_and_is_by_network():
    norm = Normalize(TeamShape(2, 1, (8,), "full"))
    assert norm.normalize(torch.tensor([3.0, 5.0])).tolist() == [3.0, 5.0]
    norm.statistics.update(torch.tensor([[[0.0, 1.0]], [[2.0, 5.0]]]))  # means 1, 3; variances 1, 4
    assert norm.normalize(torch.tensor([2.0, 5.0])).tolist() == [1.0, 1.0]
    row = TensorDict({Key.OBSERVATION: torch.tensor([[[100.0, 3.0]]])}, (1,))
    assert norm(row)[Key.NORMALIZED].tolist() == [[[10.0, 0.0]]]
    norm = Normalize(TeamShape(1, 2, (8,), "none"))
    norm.statistics.update(torch.tensor([[[0.0], [10.0]], [[2.0], [30.0]]]))
    # Means 1 and 20, deviations 1 and 10.
    assert norm.normalize(torch.tensor([[2.0], [10.0]])).tolist() == [[1.0], [-1.0]]


def _seen_by(network: GaussianPolicy | ValueNetwork, key: object) -> list[bool]:
    before = torch.randn(5, 3, 4)
    after = before.clone()
    after[:, 2] += 1.0
    outputs = [network(TensorDict({Key.NORMALIZED: seen}, (5,)))[key] for seen in (before, after)]
    return ((outputs[0] - outputs[1]).abs().amax((0, -1)) > 1e-6).tolist()


def test_only_central_critics_and_actors_see_the_other_robots():
    torch.manual_seed(0)
    alone, together = [False, False, True], [True] * 3
    for sharing in ("full", "none"):
        shape = TeamShape(4, 3, (8,), sharing)
        assert _seen_by(ValueNetwork(shape, "centralized"), Key.VALUE) == together
        assert _seen_by(ValueNetwork(shape, "independent"), Key.VALUE) == alone
    assert _seen_by(GaussianPolicy(TeamShape(4, 3, (8,), "none")), Key.LOC) == alone
    joint = TeamShape(4, 3, (8,), "none", "centralized")
    assert _seen_by(GaussianPolicy(joint), Key.LOC) == together
    row = TensorDict({Key.NORMALIZED: torch.ones(5, 3, 4)}, (5,))
    assert ValueNetwork(joint, "centralized")(row)[Key.VALUE].shape == (5, 1, 1)


@pytest.mark.parametrize(("kind", "shape"), [(TeamNormal, (7, 3)), (JointNormal, (7, 1))])
def test_distributions_are_those_of_torch(kind, shape):
    torch.manual_seed(0)
    loc, value = torch.randn(2, 7, 3, 2)
    scale = torch.tensor([[0.5, 1.0], [2.0, 0.1], [1.0, 3.0]]).expand(7, 3, 2)
    ours, theirs = kind(loc, scale), torch.distributions.Normal(loc, scale)
    for found, terms in (
        (ours.log_prob(value), theirs.log_prob(value)),
        (ours.entropy(), theirs.entropy()),
    ):
        assert found.shape == shape
        assert torch.allclose(found, terms.reshape(*shape, -1).sum(-1), atol=1e-4)
    assert torch.equal(ours.deterministic_sample, loc)
    torch.manual_seed(1)
    noise = torch.randn(7, 3, 2)
    torch.manual_seed(1)
    assert torch.allclose(ours.rsample(), loc + scale * noise)
