"""A teacher that sees more: it acts where the learner is, is imitated, and goes on."""

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
from baselines.torchrl.networks import Key
from baselines.torchrl.teacher import Teacher, find_teacher
from baselines.training.config import TrainConfig
from baselines.training.train import prepare, train
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.errors import ConfigError
from mbn_marl.field import FieldSampler
from tests.support.runs import interrupted, recorded, same_policies

pytestmark = pytest.mark.slow

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
    """Worlds of teams of 2 to 4 robots, whose episodes soon end."""
    fields = FieldSampler(robots=(2, 4), rois=(3, 5), seed=7)
    settings = {**LEARNER, "max_steps": 11, **changed}
    return NavigationEnv(fields, 6, seed=3, threads=1, metrics=(), **settings)


def rollout_of(env: NavigationEnv, steps: int) -> TensorDict:
    """A rollout (W, steps) by chance from where the worlds are, with what they show."""
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


def test_a_teacher_sees_the_assignment_that_its_learner_sees() -> None:
    for assignment in (True, "fresh"):
        found = find_teacher(SOURCE, {**LEARNER, "assignment": assignment})
        assert found[1]["assignment"] == assignment


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
