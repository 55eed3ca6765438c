"""Networks with a memory, over teams, and shared in part."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from baselines.policies.export import export_policy
from baselines.policies.loaded import LoadedPolicy
from baselines.policies.policy import Alone
from baselines.torchrl.entities import Tokens
from baselines.torchrl.memory import Past
from baselines.torchrl.networks import GaussianPolicy, JointNormal, Key, TeamShape, ValueNetwork
from baselines.torchrl.policy import TeamPolicy, load_policy
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field

ENGINE = BatchEngine("field_03", 1, threads=1, observation="entities")
SETS = {"obs_size": ENGINE.obs_size, "tokens": Tokens.of(ENGINE.observation_table)}
IDS = tuple(map(tuple, torch.eye(3).tolist()))
SHAPES = {
    "none": {"sharing": "none"},
    "groups": {"sharing": "groups", "groups": (0, 1, 0)},
    "full": {"sharing": "full"},
    "full+id": {"sharing": "full+id", "extras": IDS},
    "full+traits": {"sharing": "full+traits", "extras": ((1.0, 0.5), (1.0, 2.0), (1.0, 0.5))},
    "joint": {"sharing": "full", "actor": "centralized"},
}


def made(name: str, *, sets: bool, memory: int = 0) -> TeamShape:
    size = SETS if sets else {"obs_size": 5}
    return TeamShape(**size, n_robots=3, hidden=(8, 8), memory=memory, **SHAPES[name])


def rows(*sizes: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(sizes, generator=torch.manual_seed(seed)) - 0.5


def loud(shape: TeamShape) -> GaussianPolicy:
    torch.manual_seed(0)
    network = GaussianPolicy(shape)
    network.amplify(50.0)
    for module in network.modules():
        if isinstance(recall := getattr(module, "recall", None), torch.nn.Linear):
            torch.nn.init.orthogonal_(recall.weight)  # 0 at first
    return network


def test_a_memory_learns_what_rows_no_longer_show_and_forgets_at_a_new_episode():
    torch.manual_seed(0)
    network = GaussianPolicy(TeamShape(1, 2, (8,), "none", memory=8), 0.0)
    shown = torch.zeros(64, 4, 2, 1)
    shown[:, 0] = torch.randn(64, 2, 1).sign()
    past = Past(network.nothing(shown), torch.zeros(64, 4))
    optimizer = torch.optim.Adam(network.parameters(), lr=0.03)
    for _ in range(120):
        loss = (network.means(shown, past)[:, -1] - shown[:, 0]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 0.05  # all last rows are equal: without a memory it is 1 at best
    past.begins[:, 2] = 1.0
    assert (network.means(shown, past)[:, -1].std(0) < 1e-6).all()


CASES = [(name, sets) for name in SHAPES for sets in (False, True)]


@pytest.mark.parametrize(("name", "sets"), CASES)
def test_a_saved_policy_goes_through_an_episode_as_an_update_through_its_chunk(
    name, sets, tmp_path
):
    shape = made(name, sets=sets, memory=9)
    network, seen = loud(shape), rows(4, 6, 3, shape.obs_size)
    begins = torch.zeros(4, 6, dtype=torch.bool)
    begins[1:3, 3] = True
    with torch.no_grad():
        means = network.means(seen, Past(network.nothing(seen), begins)).numpy()
    TeamPolicy(network).save(tmp_path)
    team = load_policy(tmp_path)
    for policy in [team] if name == "joint" else [team, Alone(load_policy(tmp_path), 3)]:
        for step in range(6):
            policy.reset(begins[:, step].numpy())
            acts = policy.act(seen[:, step].numpy(), deterministic=True)
            np.testing.assert_allclose(acts, means[:, step], atol=1e-5)
    again = team.act(seen[:, 5].numpy(), deterministic=True)
    assert np.abs(again - means[:, 5]).max() > 1e-4  # the same rows, but another past


@pytest.mark.slow
def test_a_memory_goes_along_into_a_file(tmp_path):
    team = TeamPolicy(loud(made("groups", sets=True, memory=9)))
    policy = LoadedPolicy("it", team, {"observation": "entities"}, load_field("field_03"))
    metadata, _ = export_policy(policy, tmp_path / "it.onnx")  # it compares two steps
    assert metadata["memory"] == ["W", 3, 9]


@pytest.mark.parametrize(("name", "sets"), [case for case in CASES if case[0] != "joint"])
def test_sharing_decides_who_acts_alike_on_equal_rows(name, sets):
    shape = made(name, sets=sets)
    seen = rows(5, 1, shape.obs_size).expand(5, 3, -1)
    values = ValueNetwork(shape, "independent")(TensorDict({Key.NORMALIZED: seen}, (5,)))[Key.VALUE]
    for found in (loud(shape).means(seen), values):
        alike = [bool((found[:, 0] - found[:, i]).abs().max() < 1e-6) for i in (1, 2)]
        assert alike == {"full": [True, True], "groups": [False, True]}.get(name, [False, False])
    pair = BatchEngine("field_03", 1, threads=1, observation="entities", n_robots=2)
    if sets and name != "full":
        with pytest.raises(ConfigError, match="robots: "):
            TeamPolicy(loud(shape)).fit(pair)


def test_a_joint_actor_over_sets_is_of_all_robots_in_any_order_and_one_draw():
    actor, seen = loud(made("joint", sets=True)), rows(5, 3, ENGINE.obs_size)
    torch.nn.init.normal_(actor.mean.mix[-1].weight)  # it is 0 in a new one
    actions = actor.means(seen)
    torch.testing.assert_close(actor.means(seen[:, [2, 0, 1]]), actions[:, [2, 0, 1]])
    other = torch.cat([seen[:, :2], rows(5, 1, ENGINE.obs_size, seed=1)], 1)
    assert ((actor.means(other) - actions).abs().amax((0, 2)) > 1e-5).all()
    works = torch.tensor([True, False, True])
    scale, value = torch.full((5, 3, 2), 0.5), rows(5, 3, 2, seed=2)
    drawn = JointNormal(actions, scale, works.expand(5, 3))
    working = JointNormal(actions[:, works], scale[:, works])
    torch.testing.assert_close(drawn.log_prob(value), working.log_prob(value[:, works]))
    critic = ValueNetwork(made("joint", sets=True), "centralized")
    assert critic(TensorDict({Key.NORMALIZED: seen}, (5,)))[Key.VALUE].shape == (5, 1, 1)


def test_a_critic_of_the_state_reads_what_is_visited_flag_by_flag():
    critic = ValueNetwork(made("full", sets=False), "state", (13, 3))
    state = rows(2, 13)
    state[:, -1] = torch.tensor([5.0, 2.0])
    assert critic.unpacked(state)[:, 12:].tolist() == [[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]
    seen = TensorDict({Key.NORMALIZED: rows(2, 3, 5), Key.STATE: state}, (2,))
    before = critic(seen)[Key.VALUE].clone()
    seen[Key.NORMALIZED] = rows(2, 3, 5, seed=1)
    assert torch.equal(critic(seen)[Key.VALUE], before) and before.shape == (2, 3, 1)
