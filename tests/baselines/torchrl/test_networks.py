"""Networks, distributions and policies of a team."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from baselines.runs.files import RunError
from baselines.torchrl.networks import (
    Actor,
    GaussianPolicy,
    JointNormal,
    Key,
    Normalize,
    Sharing,
    TeamMLP,
    TeamNormal,
    TeamShape,
    ValueNetwork,
)
from baselines.torchrl.policy import TeamPolicy, load_policy


def test_normalisation_begins_with_the_first_update_and_is_by_network() -> None:
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


@pytest.mark.parametrize("networks", [1, 3])
def test_team_networks_compute_what_separate_layers_do(networks: int) -> None:
    torch.manual_seed(0)
    network = TeamMLP(networks, (4, 8, 6, 2), last_gain=1.0)
    for bias in network.biases:
        torch.nn.init.normal_(bias)
    rows = torch.randn(7, 5, 3, 4)
    outputs = network(rows)
    for robot in range(3):
        flow, own = rows[:, :, robot], robot if networks > 1 else 0
        for layer, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
            flow = (flow.tanh() if layer else flow) @ weight[own] + bias[own]
        torch.testing.assert_close(outputs[:, :, robot], flow)


@pytest.mark.parametrize("networks", [1, 3])
def test_networks_start_orthogonal(networks: int) -> None:
    network = TeamMLP(networks, (8, 8, 2), last_gain=0.01)
    gain = (5.0 / 3.0) ** 2  # of tanh, squared
    assert len(network.weights[0]) == networks
    for weight in network.weights[0]:
        assert torch.allclose(weight @ weight.T, gain * torch.eye(8), atol=1e-5)
    for weight in network.weights[1]:
        assert torch.allclose(weight.T @ weight, 1e-4 * torch.eye(2), atol=1e-8)


def _seen_by(network: GaussianPolicy | ValueNetwork, key: object) -> list[bool]:
    """Return which robots' outputs change when robot 2 sees something else."""
    before = torch.randn(5, 3, 4)
    after = before.clone()
    after[:, 2] += 1.0
    outputs = [network(TensorDict({Key.NORMALIZED: seen}, (5,)))[key] for seen in (before, after)]
    changed: list[bool] = ((outputs[0] - outputs[1]).abs().amax((0, -1)) > 1e-6).tolist()
    return changed


def test_only_central_critics_and_actors_see_the_other_robots() -> None:
    torch.manual_seed(0)
    alone, together = [False, False, True], [True] * 3
    sharing: Sharing
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
def test_distributions_are_those_of_torch(kind: type[TeamNormal], shape: tuple[int, int]) -> None:
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


@pytest.mark.parametrize(
    ("sharing", "actor"), [("full+id", "decentralized"), ("none", "centralized")]
)
def test_saved_policy_acts_as_before(tmp_path: Path, sharing: Sharing, actor: Actor) -> None:
    torch.manual_seed(0)
    network = GaussianPolicy(TeamShape(4, 3, (8, 8), sharing, actor), log_std=-0.5)
    network.norm.statistics.update(torch.randn(100, 3, 4) * 3.0)
    policy = TeamPolicy(network)
    policy.save(tmp_path)
    assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".safetensors"}
    seen = np.random.default_rng(0).normal(size=(6, 3, 4)).astype(np.float32)
    for deterministic in (True, False):
        acts = []
        for each in (policy, load_policy(tmp_path)):
            torch.manual_seed(1)
            acts.append(each.act(seen, deterministic=deterministic))
        np.testing.assert_array_equal(*acts)
    found = network(network.norm(TensorDict({Key.OBSERVATION: torch.from_numpy(seen)}, (6,))))
    means = policy.act(seen, deterministic=True)
    np.testing.assert_array_equal(found[Key.LOC].numpy(force=True), means)
    assert found[Key.SCALE].shape == (6, 3, 2) and (found[Key.SCALE] == network.log_std.exp()).all()
    (tmp_path / "policy.safetensors").write_bytes(b"nonsense")
    with pytest.raises(RunError, match=r"policy\.safetensors"):
        load_policy(tmp_path)


def test_a_gain_multiplies_the_mean_actions() -> None:
    network = GaussianPolicy(TeamShape(4, 3, (8, 8), "none"))
    for bias in network.mean.biases:
        torch.nn.init.normal_(bias)
    before = network.means(torch.ones(6, 3, 4))
    network.amplify(4.0)
    assert before.any() and torch.equal(network.means(torch.ones(6, 3, 4)), 4.0 * before)


def test_actions_of_a_learner_that_diverged_are_no_numbers() -> None:
    network = GaussianPolicy(TeamShape(4, 3, (8,), "full"), math.nan)
    actions = TeamPolicy(network).act(np.zeros((2, 3, 4), np.float32), deterministic=False)
    assert np.isnan(actions).all()  # which the engine refuses: the run says that it diverged
