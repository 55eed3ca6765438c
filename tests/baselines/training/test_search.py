"""The search for a faster episode after training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from baselines.evaluation.evaluate import Evaluation, evaluate
from baselines.evaluation.policy import load_trained
from baselines.torchrl.networks import Actor, GaussianPolicy, Sharing, TeamShape
from baselines.training.search import PATIENCE, WORLDS, LastLayerSearch, Trial
from baselines.training.train import train
from baselines.zoo.entries import open_run
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field
from tests.support.runs import same_policies, small_config

FIELD = load_field("field_03")
SETTINGS: dict[str, Any] = {"observation": "lidar"}


def slow_team() -> Any:
    """The zoo's policy of the field with weak forces: 45 steps instead of 17."""
    policy: Any = load_trained(open_run("zoo:field_03"))
    for part in policy.network.last_layer:
        part.data *= 0.1
    return policy


def played(policy: Any, *, deterministic: bool) -> Evaluation:
    """Evaluate with a seed that the search does not have."""
    how: dict[str, Any] = {"episodes": 1 if deterministic else 100, "seed": 5}
    return evaluate(policy, FIELD, SETTINGS, deterministic=deterministic, **how)


@pytest.mark.parametrize(
    ("sharing", "actor"),
    [("none", "decentralized"), ("full", "decentralized"), ("none", "centralized")],
)
def test_each_world_acts_by_its_own_last_layer(sharing: Sharing, actor: Actor) -> None:
    torch.manual_seed(0)
    network = GaussianPolicy(TeamShape(55, 3, (8, 8), sharing, actor))
    network.norm.statistics.update(torch.randn(50, 3, 55))
    search = LastLayerSearch(network, FIELD, SETTINGS, seed=0)
    seen = np.random.default_rng(0).normal(size=(WORLDS, 3, 55)).astype(np.float32)
    weights, biases = search._changes()
    with torch.no_grad():
        actions = search._actions(seen, (weights, biases))
        for w in (0, WORLDS - 1):
            network.last_layer[0].copy_(weights[:, w])
            network.last_layer[1].copy_(biases[:, w])
            own = network.means(network.norm.normalize(torch.from_numpy(seen[w : w + 1])))
            torch.testing.assert_close(actions[w : w + 1], own)


def test_a_slow_team_becomes_faster_and_stays_as_safe() -> None:
    policies = slow_team(), slow_team()
    mean, sampled = (played(policies[0], deterministic=one).summary() for one in (True, False))
    for policy in policies:
        LastLayerSearch(policy.network, FIELD, SETTINGS, seed=0).run(5)
    assert played(policies[0], deterministic=True).summary()["return_mean"] > mean["return_mean"]
    now = played(policies[0], deterministic=False).summary()
    assert now["return_mean"] >= sampled["return_mean"]
    weights, again = (policy.network.state_dict() for policy in policies)
    assert all(torch.equal(weights[name], again[name]) for name in weights)
    before = slow_team().network.state_dict()
    changed = {name for name in weights if not torch.equal(weights[name], before[name])}
    assert changed == {"mean.weights.2", "mean.biases.2"}


class Doubtful(LastLayerSearch):
    """Every change makes sampled actions earn less."""

    def _play(self, layer: Sequence[torch.Tensor], horizon: int, *, sampled: bool = False) -> Trial:
        trial = super()._play(layer, horizon, sampled=sampled)
        changed = not torch.equal(layer[0][:, 0], self._layer[0])
        return trial._replace(returns=trial.returns - 1e6) if sampled and changed else trial


def test_a_change_that_makes_sampled_actions_worse_is_dropped() -> None:
    policy = slow_team()
    search = Doubtful(policy.network, FIELD, SETTINGS, seed=0)
    search.run(2)
    before = slow_team().network.state_dict()
    assert all(torch.equal(one, before[name]) for name, one in policy.network.state_dict().items())


def test_the_search_ends_at_the_proved_optimum() -> None:
    policy: Any = load_trained(open_run("zoo:field_03"))  # which is there
    search = LastLayerSearch(policy.network, FIELD, SETTINGS, seed=0)
    search.run(5)
    assert search.env_steps <= WORLDS * 17 * (1 + PATIENCE)


def test_a_team_that_fails_is_left_as_it_is() -> None:
    policy, settings = slow_team(), SETTINGS | {"max_steps": 10}
    search = LastLayerSearch(policy.network, FIELD, settings, seed=0)
    search.run(5)
    before = slow_team().network.state_dict()
    assert all(torch.equal(one, before[name]) for name, one in policy.network.state_dict().items())
    assert search.env_steps == WORLDS * 10


def test_a_training_ends_with_the_search_and_counts_its_steps(tmp_path: Path) -> None:
    config = small_config("mappo")
    plain = train(config, tmp_path / "plain")
    searched = {**config.hyperparameters, "search_generations": 1}
    run = train(replace(config, hyperparameters=searched), tmp_path / "searched")
    assert run.evaluation["env_steps"] > plain.evaluation["env_steps"]
    assert same_policies(run, plain)  # so small a training fails
    moving = {**config.environment, "random_starts": True}
    with pytest.raises(ConfigError, match="search_generations: 1; allowed where starts"):
        train(replace(config, hyperparameters=searched, environment=moving), tmp_path / "random")
    assert not (tmp_path / "random").exists()
