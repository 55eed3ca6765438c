"""Networks, distributions and policies of a team."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from baselines.torchrl.networks import (
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


def _seen_by(network: GaussianPolicy | ValueNetwork, key: object) -> list[bool]:
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
