"""The multi-agent trainer: hyperparameters, aids, targets, and a teacher that sees more."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from baselines import load_policy
from baselines.algorithms import find_algorithm
from baselines.torchrl import trainer
from baselines.torchrl.config import load
from baselines.torchrl.networks import Key
from baselines.torchrl.trainer import Teacher
from baselines.training import aids
from baselines.training.config import TrainConfig
from baselines.training.train import prepare, train
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.errors import ConfigError
from mbn_marl.field import FieldSampler
from tests.support.runs import interrupted, recorded, same_policies

pytestmark = pytest.mark.slow


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


def test_cap_of_the_standard_deviation_stays_and_then_falls() -> None:
    config = load("mappo", "N", {"log_std_cap": [0.5, -1.5], "log_std_cap_from": 0.5})
    assert [config.cap_at(progress) for progress in (0.0, 0.5, 0.75, 1.0)] == [0.5, 0.5, -0.5, -1.5]


SMALL = {"num_worlds": 4, "rollout_steps": 32, "hidden": [8], "action_repeat": [1, 1]}


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


SOURCE = "zoo:generalist-hint"
LEARNER: dict[str, Any] = {"observation": "entities", "assignment": False}
TINY = {"num_worlds": 4, "rollout_steps": 16, "hidden": [16, 16], "minibatches": 4}
CONFIG = TrainConfig(
    "mappo",
    "random_convex",
    "G",
    steps=320,
    evaluate_every=128,
    episodes=2,
    hyperparameters={**TINY, "teacher": SOURCE},
    environment={**LEARNER, "max_steps": 100},
)


def make_env(**changed: Any) -> NavigationEnv:
    fields = FieldSampler(robots=(2, 4), rois=(3, 5), seed=7)
    settings = {**LEARNER, "max_steps": 11, **changed}
    return NavigationEnv(fields, 6, seed=3, threads=1, metrics=(), **settings)


def rollout_of(env: NavigationEnv, steps: int) -> TensorDict:
    rows = []
    for _ in range(steps):
        seen = env.rand_action(env.now)  # type: ignore[attr-defined]
        rows.append(seen.select(Key.OBSERVATION, Key.ACTION).clone())
        env.now = env.step_and_maybe_reset(seen)[1]  # type: ignore[attr-defined]
    return torch.stack(rows, 1)


def test_a_teacher_acts_where_the_learner_is_and_sees_the_assignment() -> None:
    repeat = 3
    learner, teacher = make_env(), Teacher(SOURCE, LEARNER, make_env)
    hinted = make_env(assignment="fresh")
    policy = load_policy(SOURCE)
    names = [entry.name for entry in learner.engine.observation_table]
    places = [entry.offset for entry in hinted.engine.observation_table if entry.name in names]
    common = [k for k, name in enumerate(names) if not name.startswith("roi_")]
    for env in (learner, hinted):
        env.action_repeat, env.now = repeat, env.reset()  # type: ignore[attr-defined]
    ended = False
    for _ in range(3):
        rollout = rollout_of(learner, 8)
        found = teacher.actions(rollout, repeat)
        assert found.shape == (6, 8, 4, 2)
        for t, step in enumerate(rollout.unbind(1)):
            seen = hinted.now[Key.OBSERVATION].numpy()  # type: ignore[attr-defined]
            np.testing.assert_array_equal(
                seen[..., np.array(places)[common]], step[Key.OBSERVATION][..., common].numpy()
            )
            np.testing.assert_array_equal(found[:, t].numpy(), policy.act(seen))
            taken = hinted.now.set(Key.ACTION, step[Key.ACTION])  # type: ignore[attr-defined]
            after, hinted.now = hinted.step_and_maybe_reset(taken)  # type: ignore[attr-defined]
            ended |= bool(after["next", "done"].any())
    assert ended


def test_a_learner_comes_to_act_as_its_teacher(tmp_path: Path) -> None:
    apart = []
    for until, weight in ((0.0, 0.0), (0.0, 10.0), (1.0, 0.0)):
        learned = {"learning_rate": (3e-3, 3e-3), "teacher_weight": (weight, weight)}
        hyperparameters = {**CONFIG.hyperparameters, **learned, "imitation_until": until}
        config = replace(CONFIG, steps=2048, evaluate_every=2048, hyperparameters=hyperparameters)
        run = train(config, tmp_path / f"{until}-{weight}")
        apart.append(float(recorded(run)["rows"][-1]["imitation"]))
    assert max(apart[1:]) < 0.7 * apart[0]
    assert load_policy(run.path).settings["assignment"] is False


def test_a_learner_imitates_at_first_and_an_interrupted_one_goes_on(tmp_path: Path) -> None:
    hyperparameters = {**CONFIG.hyperparameters, "imitation_until": 0.5}
    config = replace(CONFIG, hyperparameters=hyperparameters)
    whole = train(config, tmp_path / "whole")
    rows = recorded(whole)["rows"]
    learned = [float(row["critic"]) > 0.0 for row in rows]
    assert learned == [int(row["env_steps"]) > 192 for row in rows]
    assert not all(learned) and any(learned)
    assert not interrupted(config, tmp_path / "run").finished
    again = train(config, tmp_path / "run", resume=True)
    assert recorded(again) == recorded(whole)
    assert same_policies(again, whole)


@pytest.mark.parametrize(
    ("source", "named"),
    [("zoo:nobody", "zoo:nobody"), ("zoo:field_03", "fields: "), ("nowhere", "nowhere")],
)
def test_teacher_that_does_not_fit_is_refused_with_all_else(source: str, named: str) -> None:
    wrong = {"teacher": source, "scattered": 0.5}
    task, hyperparameters = prepare(replace(CONFIG, hyperparameters=wrong))
    with pytest.raises(ConfigError) as caught:
        find_algorithm("mappo").check(task, hyperparameters)
    first, second = caught.value.problems
    assert first.startswith("scattered: ") and named in second
