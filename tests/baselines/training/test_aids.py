"""Training aids: how long a decision lasts, what a budget becomes, when ROIs shrink and grow."""

from __future__ import annotations

import pytest

from baselines.training.aids import RoiCurriculum, TrainingAids, between


def test_numbers_are_interpolated_and_do_not_leave_their_ends() -> None:
    assert [between((3.0, 1.0), share) for share in (-1, 0, 0.25, 1, 2)] == [3, 3, 2.5, 1, 1]


def test_action_repeat_falls_to_its_second_value() -> None:
    aids = TrainingAids(action_repeat=(4, 1), action_repeat_until=0.5)
    assert [aids.repeat_at(share) for share in (0.0, 0.25, 0.4, 0.5, 1.0)] == [4, 2, 2, 1, 1]


def test_a_budget_is_rounded_up_to_rollouts_that_become_shorter() -> None:
    aids = TrainingAids(action_repeat=(4, 1), action_repeat_until=0.4)
    # 4 x 10 until 40 % of the budget, where repeats end; then rollouts of 10.
    assert [aids.rounded_up(steps, 10) for steps in (1, 40, 95, 101)] == [40, 40, 100, 110]
    # 40, 80, then 3 x 10 and 2 x 10 and 10 from 400 on.
    assert aids.rounded_up(1000, 10) == 1000
    assert [TrainingAids().rounded_up(steps, 64) for steps in (1, 64, 65)] == [64, 64, 128]
    assert TrainingAids(action_repeat=(3, 3)).rounded_up(100, 10) == 120


def test_a_training_without_aids_has_the_environments_own_settings() -> None:
    settings = {"max_steps": 300, "roi_radius": 8.0, "one_hot": True}
    assert TrainingAids().in_training(settings, 1.0) == settings
    shorter = TrainingAids(episode_steps=256).in_training(settings, 2.5)
    assert shorter == {"max_steps": 256, "roi_radius": 20.0, "one_hot": True}
    assert TrainingAids(episode_steps=500).in_training(settings, 1.0) == settings


def test_rois_shrink_when_the_team_succeeds_and_grow_when_it_fails() -> None:
    curriculum = RoiCurriculum(8.0, stages=3, bounds=(0.25, 0.75), window=4)
    sizes, moves = [], []
    none, all_of_them, half = [0, 0, 0, 0, 0], [1, 1, 1, 1], [1, 1, 0, 0]
    windows = ([1, 1, 1, 0], [1, 0], [1, 1], half, none, *[all_of_them] * 3)
    for successes in windows:
        curriculum.add(successes)
        moves.append(curriculum.move())
        sizes.append(curriculum.radius)
    assert sizes == pytest.approx([4.0, 4.0, 2.0, 2.0, 4.0, 2.0, 1.0, 1.0])
    assert moves == [True, False, True, False, True, True, True, False]


def test_rois_never_grow_beyond_their_first_size() -> None:
    curriculum = RoiCurriculum(8.0, stages=3, bounds=(0.25, 0.75), window=4)
    curriculum.add([0, 0, 0, 0])
    assert not curriculum.move() and curriculum.radius == 8.0
