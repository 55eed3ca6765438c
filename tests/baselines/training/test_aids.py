"""Training aids: other starts, shorter episodes, when ROIs shrink and grow."""

import dataclasses
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest

from baselines.evaluation.evaluate import EVALUATION_SEED, EVALUATIONS
from baselines.training import aids as module
from baselines.training.aids import RoiCurriculum, TrainingAids, with_other_starts
from baselines.training.config import Task, TrainConfig
from baselines.training.train import prepare
from mbn_marl import Failures
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field

FIELD = load_field("field_02")


def task_of(**settings: Any) -> Task:
    return Task(TrainConfig("mappo", "field_02", seed=3), FIELD, settings)


@pytest.mark.parametrize(
    ("failures", "steps", "expected"),
    [
        ({"at": {0: 256, 1: 257}, "kind": "coast"}, 256, {"at": {0: 256}, "kind": "coast"}),
        ({"at": {0: 256, 1: 257}, "kind": "coast"}, 257, {"at": {0: 256, 1: 257}, "kind": "coast"}),
        ({"between": (5, 60)}, 50, {"between": (5, 60)}),
        ({"between": (5, 60)}, 4, {}),
    ],
)
def test_failures_after_the_end_of_a_training_episode_are_left_out(failures, steps, expected):
    aids, curriculum = TrainingAids(episode_steps=steps), RoiCurriculum(1.0, window=4)
    settings = aids.in_training(task_of(failures=failures), curriculum, 4)
    assert settings["failures"] == Failures(**expected)


def test_robots_are_scattered_until_rois_have_their_true_size():
    aids, curriculum = TrainingAids(scattered=0.25), RoiCurriculum(4.0, window=4)
    task = task_of(safety_distance=30.0)
    fields = aids.in_training(task, curriculum, 8)["field"]
    assert fields == aids.in_training(task, curriculum, 8)["field"]
    assert fields[:6] == [FIELD] * 6 and FIELD not in fields[6:] and fields[6] != fields[7]
    for one in fields[6:]:
        gaps = np.linalg.norm(one.starts[:, None] - one.starts, axis=-1)
        assert gaps[np.triu_indices(len(gaps), 1)].min() >= 30.0
        assert one.starts.shape == FIELD.starts.shape
        assert (one.rois == FIELD.rois).all() and (one.edges == FIELD.edges).all()
    assert aids.in_training(task_of(random_starts=True), curriculum, 8)["field"] == FIELD
    curriculum.stage = 1
    assert aids.in_training(task, curriculum, 8)["field"][6:] != fields[6:]
    curriculum.stage = 10
    assert aids.in_training(task, curriculum, 8)["field"] == FIELD
    assert with_other_starts(FIELD, 500.0, np.random.default_rng(0)) is FIELD  # crowded


def test_random_fields_are_others_for_each_learner_and_size_of_rois_and_in_evaluations():
    config = TrainConfig("mappo", "random_convex", "G", seed=3)
    task, aids = prepare(config)
    curriculum = RoiCurriculum(4.0, window=4)
    assert aids.in_training(task, curriculum, 4)["field"] == task.field
    curriculum.moves = 1
    moved = aids.in_training(task, curriculum, 4)["field"]
    assert moved == task.field.model_copy(update={"seed": moved.seed}) != task.field
    assert task.field_of(7) == prepare(dataclasses.replace(config, seed=7))[0].field
    for seed, fits in ((-1, True), (0, False), (EVALUATIONS - 1, False), (EVALUATIONS, True)):
        asked = dataclasses.replace(config, seed=EVALUATION_SEED + seed)
        with nullcontext() if fits else pytest.raises(ConfigError, match="seed: "):
            prepare(asked)


def test_rois_shrink_when_the_team_succeeds_and_grow_when_it_fails(monkeypatch):
    monkeypatch.setattr(module, "STAGES", 3)
    curriculum = RoiCurriculum(8.0, window=5)
    failed, half, most = [0] * 5, [1, 1, 0, 1, 0], [1, 1, 1, 0, 1]
    # A rate of 0.4 or more does not let ROIs grow, one of 0.8 lets them shrink. A window may come
    # in parts, and ROIs are never larger than at first or smaller than the true ones.
    windows = (failed, most, [1, 1, 1], [1, 1], half, failed, *[most] * 3)
    seen = []
    for successes in windows:
        curriculum.add(successes)
        moved, seed = curriculum.move(), curriculum.seed(7)
        seen.append((moved, curriculum.radius, seed))
    moves = [False, True, False, True, False, True, True, True, False]
    assert [moved for moved, _, _ in seen] == moves
    radii = [radius for _, radius, _ in seen]
    assert radii == pytest.approx([8.0, 4.0, 4.0, 2.0, 2.0, 4.0, 2.0, 1.0, 1.0])
    # The worlds have another seed after every change.
    seeds = [seed for moved, _, seed in seen if moved]
    assert seen[0][2] == 7 and len({7, *seeds}) == 6 and all(0 <= seed < 2**63 for seed in seeds)
