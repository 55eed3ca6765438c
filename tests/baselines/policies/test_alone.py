"""Robots that know only their own: each acts on its row, with its memory, and nothing else."""

from typing import Any

import numpy as np
import pytest
import torch

from baselines.evaluation.evaluate import evaluate
from baselines.policies.load import load_trained, open_run
from baselines.policies.own import OwnPolicy
from baselines.policies.policy import Alone, Policy, RandomPolicy
from baselines.policies.shielded import Shielded
from baselines.torchrl.networks import GaussianPolicy, TeamShape
from baselines.torchrl.policy import TeamPolicy
from mbn_marl import Field
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError

OWN = {"observation": "local", "knowledge": "own"}
SEEN = np.random.default_rng(0).normal(size=(4, 2, 3, 7)).astype(np.float32)


class Honest:
    """It adds up what each robot has seen."""

    def __init__(self, field: Any) -> None:
        self.sums: Any = 0.0

    def act(self, seen: np.ndarray, deterministic: bool = True) -> np.ndarray:
        self.sums = self.sums + seen[..., :2]
        return np.tanh(self.sums)

    def reset(self, worlds: Any = None) -> None:
        self.sums = 0.0


class Peeking(Honest):
    """Its robots act on the row of the next one, also that behind a view of theirs."""

    def act(self, seen: np.ndarray, deterministic: bool = True) -> np.ndarray:
        rows = seen if seen.base is None else seen.base
        return super().act(np.roll(rows, 1, axis=1)[:, : seen.shape[1]])


class Sharing(Honest):
    """Its robots act on one memory of the team."""

    def act(self, seen: np.ndarray, deterministic: bool = True) -> np.ndarray:
        self.sums = self.sums + seen[..., :2].sum(axis=1, keepdims=True)
        return np.broadcast_to(np.tanh(self.sums), (*seen.shape[:2], 2))


@pytest.mark.parametrize(("made", "same"), [(Honest, True), (Peeking, False), (Sharing, False)])
def test_who_uses_more_than_a_robot_has_is_found_out(made, same):
    policies = [OwnPolicy("tests:made", made, None) for _ in range(2)]
    team, robots = policies[0], Alone(policies[1], 3)
    for episode in (SEEN, SEEN + 1.0):
        for policy in (team, robots):
            policy.reset()
        shown = [seen.copy() for seen in episode]
        acts = [[one.act(seen, deterministic=True) for seen in shown] for one in (team, robots)]
        assert np.array_equal(*acts) == same


def test_each_robot_has_its_network():
    torch.manual_seed(0)
    shape = TeamShape(obs_size=7, n_robots=3, hidden=(8,), sharing="none")
    network = GaussianPolicy(shape)
    network.amplify(50.0)
    network.norm.update(torch.from_numpy(SEEN.reshape(-1, 3, 7)) * torch.arange(1, 4)[:, None])
    team = TeamPolicy(network)
    actions = Alone(team, 3).act(SEEN[0], deterministic=True)
    np.testing.assert_allclose(actions, team.act(SEEN[0], deterministic=True), rtol=1e-5)
    same = [team.of_robot(i, 3).act(SEEN[0, :, :1], deterministic=True) for i in (0, 1)]
    assert not np.allclose(*same)
    joint = TeamShape(obs_size=7, n_robots=3, hidden=(8,), sharing="full", actor="centralized")
    with pytest.raises(ConfigError, match="actor: "):
        Alone(TeamPolicy(GaussianPolicy(joint)), 3)


def test_a_network_over_sets_knows_the_size_of_its_team():
    team = load_trained(open_run("zoo:generalist"))
    engine = BatchEngine("field_03", 2, threads=1, **{**OWN, "observation": "entities"})
    robots, seen = team.fit(engine), engine.reset()
    assert isinstance(robots, Alone)
    actions = robots.act(seen, deterministic=True)
    np.testing.assert_allclose(actions, team.act(seen, deterministic=True), atol=1e-5)


@pytest.mark.parametrize("observation", ["local", "lidar_local", "entities"])
def test_behind_the_shield_each_robot_keeps_away_by_its_row_alone(observation):
    own = {**OWN, "observation": observation, "max_steps": 200}
    assert any(evaluate(RandomPolicy(), "field_03", own, episodes=20).collisions)
    found = evaluate(Shielded(RandomPolicy()), "field_03", own, episodes=20)
    assert not any(found.collisions) and sum(found.steps) > 2_000
    assert observation == "entities" or not any(found.wall_hits), "entities shows no place"
    engine = BatchEngine("field_03", 2, threads=1, **own)
    shield, rows = Shielded(RandomPolicy()).fit(engine)._own, engine.reset(seed=1)
    actions = np.full((2, 3, 2), 0.7, np.float32)
    alone = [shield.act(actions[:, i : i + 1], rows[:, i : i + 1]) for i in range(3)]
    np.testing.assert_array_equal(np.concatenate(alone, 1), shield.act(actions, rows))


LINE = ((400, 500), (430, 540), (460, 500))
HALL = ((300, 400), (600, 400), (600, 600), (300, 600))


@pytest.mark.parametrize("other", [{"f_max": (0.5, 0.5, 2.0)}, {}])
def test_the_shield_knows_the_limits_of_robots_and_the_largest_team(other):
    teams = [LINE] if other else [LINE[:2], LINE]
    fields = [Field(HALL, [(590, 590)], team) for team in teams]
    own = {**OWN, "observation": "local", "max_steps": 60, **other}
    engine = BatchEngine(fields, len(fields), threads=1, **own)
    shield, seen, hits = Shielded(RandomPolicy()).fit(engine)._own, engine.reset(), 0
    meet = np.array([[[1.0, 0.0], [0.0, 0.0], [-1.0, 0.0]]] * len(fields), np.float32)
    for _ in range(40):
        seen, _, ended, _ = engine.step(shield.act(meet, seen))
        hits += ended.sum()
    assert not hits


def test_an_engine_of_own_knowledge_wants_robots_alone():
    engine = BatchEngine("field_03", 1, threads=1, **OWN)
    assert isinstance(Policy().fit(engine), Alone)
    assert isinstance(Shielded(Policy()).fit(engine).policy, Alone)
    assert not isinstance(RandomPolicy().fit(engine), Alone)
    assert not isinstance(Policy().fit(BatchEngine("field_03", 1, threads=1)), Alone)


def test_a_policy_that_needs_a_field_and_gets_none_names_the_option() -> None:
    with pytest.raises(AttributeError) as caught:
        OwnPolicy("tests:made", lambda field: field.starts, None)
    assert "--field" in caught.value.__notes__[0]
