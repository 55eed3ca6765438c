"""The multi-agent trainer: hyperparameters, aids, TorchRL's parts, targets, early stop."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss
from torchrl.objectives.value import MultiAgentGAE

from baselines.torchrl import trainer
from baselines.torchrl.config import load
from baselines.torchrl.networks import Key
from baselines.training import aids
from baselines.training.config import TrainConfig
from baselines.training.train import train
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.errors import ConfigError


def test_algorithms_differ_by_what_actor_and_critic_see_alone() -> None:
    of = {"mappo": ("decentralized", "centralized"), "ippo": ("decentralized", "independent")}
    for setting, seen in {
        "N": {**of, "ppo-joint": ("centralized", "centralized")},
        "G": of,
    }.items():
        blocks = [load(name, setting, {}).model_dump() for name in seen]
        assert [(one.pop("actor"), one.pop("critic")) for one in blocks] == [*seen.values()]
        assert all(one == blocks[0] for one in blocks)
    assert blocks[0]["network"] == "entities" == blocks[0]["environment"]["observation"]


def test_the_cap_of_the_standard_deviation_stays_and_then_falls() -> None:
    changes = {"log_std_cap": [0.5, -1.5], "log_std_cap_from": 0.5}
    config = load("mappo", "N", changes)
    assert [config.cap_at(progress) for progress in (0.0, 0.5, 0.75, 1.0)] == [0.5, 0.5, -0.5, -1.5]


def test_full_id_tells_the_network_which_robot_it_is() -> None:
    for sharing in ("full", "full+id", "none"):
        environment = load("mappo", "N", {"sharing": sharing}).environment
        assert environment["one_hot"] is (sharing == "full+id")
    with pytest.raises(ConfigError, match="sharing"):
        load("ippo", "N", {"sharing": "some"})


SMALL = {"num_worlds": 4, "rollout_steps": 32, "hidden": [8], "action_repeat": [1, 1]}


@pytest.mark.slow
def test_training_has_its_own_rois_and_time_limit_and_evaluations_the_true_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    class Watched(NavigationEnv):
        def __init__(self, *args: Any, **settings: Any) -> None:
            super().__init__(*args, **settings)
            config, fields = self.engine.config, self.engine.fields
            made.append((config.roi_radius, config.max_steps, len(fields)))

    monkeypatch.setattr(trainer, "NavigationEnv", Watched)
    monkeypatch.setattr(aids, "STAGES", 2)
    monkeypatch.setattr(aids, "SUCCESS", (0.0, 0.0))  # whatever the team does is enough
    changes = {**SMALL, "roi_radius": 16.0, "scattered": 0.25, "episode_steps": 32}
    config = TrainConfig("mappo", "field_03", steps=384, episodes=2, hyperparameters=changes)
    run = train(config, tmp_path / "run")
    assert made == [(160.0, 32, 4), (40.0, 32, 4), (10.0, 32, 1)]
    assert max(run.evaluation["deterministic"]["per_episode"]["steps"]) > 32


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "loss"), [("mappo", "MAPPOLoss"), ("ippo", "IPPOLoss")])
def test_collector_estimator_and_loss_are_those_of_torchrl(
    algorithm: str, loss: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: Counter[str] = Counter()

    def count(owner: type, method: str) -> None:
        original = getattr(owner, method)

        def counted(self: Any, *args: Any, **kwargs: Any) -> Any:
            calls[owner.__name__] += 1
            return original(self, *args, **kwargs)

        monkeypatch.setattr(owner, method, counted)

    count(Collector, "rollout")
    count(MultiAgentGAE, "forward")
    count(IPPOLoss if loss == "IPPOLoss" else MAPPOLoss, "forward")
    still = {**SMALL, "roi_radius": 1.0, "epochs": 3, "minibatches": 2}
    config = TrainConfig(algorithm, "field_03", steps=384, episodes=2, hyperparameters=still)
    train(config, tmp_path / "run")
    # Three rollouts, and for each of them three epochs of two minibatches.
    assert calls == {"Collector": 3, "MultiAgentGAE": 3, loss: 18}


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["mappo", "ppo-joint"])
def test_a_time_limit_is_bootstrapped_and_a_termination_is_not(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = []
    samples = trainer.Trainer._samples

    @torch.no_grad()
    def keep(self: Any, rollout: Any, repeat: int) -> Any:
        made = samples(self, rollout, repeat)
        seen = TensorDict({Key.NORMALIZED: rollout["next", *Key.NORMALIZED]}, rollout.batch_size)
        kept.append((self.reward, rollout.clone(), repeat, self.critic(seen)[Key.VALUE]))
        return made

    monkeypatch.setattr(trainer.Trainer, "_samples", keep)
    short = {**SMALL, "roi_radius": 1.0, "episode_steps": 8, "gae_lambda": 0.0}
    config = TrainConfig(
        algorithm,
        "field_03",
        steps=128,
        episodes=2,
        environment={"safety_distance": 45.0, "random_starts": True},
        hyperparameters={**short, "action_repeat": [2, 2]},
    )
    train(config, tmp_path / "run")
    reward_key, rollout, repeat, last = kept[0]
    ended = rollout["next", "terminated"]
    assert ended.any() and (rollout["next", "truncated"] & ~ended).any() and repeat == 2
    # With lambda 0 the target is one step's: reward, and what follows unless a success or collision
    # ended it; a decision of two steps is discounted twice.
    reward = rollout[reward_key]
    reward = reward.unsqueeze(-2) if algorithm == "ppo-joint" else reward
    expected = reward + 0.99**2 * last * ~ended.unsqueeze(-2)
    assert torch.allclose(rollout["value_target"], expected, atol=1e-4)
    assert expected.shape[-2] == (1 if algorithm == "ppo-joint" else 3)
