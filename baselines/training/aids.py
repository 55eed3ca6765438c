"""Aids of training, which evaluations do without: large ROIs, long decisions, short episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, get_args

import numpy as np
import pydantic
from numpy.typing import NDArray
from shapely import Point

from baselines.training.config import Task
from baselines.training.hyperparameters import Hyperparameters
from mbn_marl.checked import Uniform
from mbn_marl.config import make_config
from mbn_marl.field import Field, FieldSampler
from mbn_marl.field.schema import SAFETY_DISTANCE

Count = Annotated[int, pydantic.Field(ge=1)]
Share = Annotated[float, pydantic.Field(ge=0.0, le=1.0)]
Positive = Annotated[float, pydantic.Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, pydantic.Field(ge=0.0, allow_inf_nan=False)]


class TrainingAids(Hyperparameters):
    """Hyperparameters with training aids; by default there are none.

    Attributes:
        reward_scale: the learner sees the reward times this.
        action_repeat: env-steps that a decision lasts, from and to, falling linearly (rounded)
            over ``action_repeat_until`` of training. Evaluations always decide at every step.
        roi_radius: how many times as large ROIs are at first in training, 1 for no curriculum.
        roi_stages: the stages from there to the true size; each begins with new episodes.
        roi_success: ``bounds`` of :class:`RoiCurriculum`.
        scattered: the share of the worlds whose robots start anywhere in the field, elsewhere at
            every stage, until ROIs have their true size. A start beside an ROI visits it while it
            is large: a team that always starts there would not learn to go to it.
        episode_steps: training episodes are truncated after so many env-steps, if not before;
            evaluations are not.
    """

    reward_scale: Positive = 1.0
    action_repeat: tuple[Count, Count] = (1, 1)
    action_repeat_until: Annotated[float, pydantic.Field(gt=0.0, le=1.0)] = 0.4
    roi_radius: Annotated[float, pydantic.Field(ge=1.0, allow_inf_nan=False)] = 1.0
    roi_stages: Count = 10
    roi_success: tuple[Share, Share] = (0.4, 0.8)
    scattered: Share = 0.0
    episode_steps: Count | None = None

    @pydantic.field_validator("*", mode="before")
    @classmethod
    def _one_number_is_both_ends(cls, value: Any, info: pydantic.ValidationInfo) -> Any:
        kinds = get_args(cls.model_fields[info.field_name or ""].annotation)
        is_pair = len(kinds) == 2 and kinds[0] == kinds[1]
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return (value, value) if is_pair and is_number else value

    def repeat_at(self, progress: float) -> int:
        """The env-steps of a decision at ``progress``, the share of training done, in [0, 1]."""
        return round(between(self.action_repeat, progress / self.action_repeat_until))

    def rounded_up(self, steps: int, decisions: int) -> int:
        """The env-steps of as many rollouts of ``decisions`` as a budget of ``steps`` takes."""
        env_steps, last = 0, self.action_repeat[1]
        while env_steps < steps and (repeat := self.repeat_at(env_steps / steps)) != last:
            env_steps += decisions * repeat
        rollout = decisions * last
        return env_steps + max(0, -(-(steps - env_steps) // rollout)) * rollout

    def curriculum(self, window: int) -> RoiCurriculum:
        """A curriculum at its beginning, which judges by ``window`` episodes."""
        return RoiCurriculum(self.roi_radius, self.roi_stages, self.roi_success, window)

    def in_training(self, task: Task, curriculum: RoiCurriculum, worlds: int) -> dict[str, Any]:
        """The environment's arguments in training: ``field``, one for all worlds or one each."""
        true, radius = make_config(task.settings), curriculum.radius
        longest = min(true.max_steps, self.episode_steps or true.max_steps)
        settings: dict[str, Any] = {"roi_radius": _times(true.roi_radius, radius)}
        settings["max_steps"] = longest
        if true.failures is not None:  # later ones are of no training episode
            at = {i: step for i, step in true.failures.at.items() if step <= longest}
            first, last = true.failures.between or (longest + 1, 0)
            between = (first, last) if first <= longest else None
            changes = {"at": at, "between": between}
            settings["failures"] = true.failures.model_copy(update=changes)
        fields: Field | FieldSampler | list[Field] = task.field
        count = round(self.scattered * worlds) if radius > 1.0 and not true.random_starts else 0
        if count and isinstance(task.field, Field):
            apart = max(true.at_most().safety_distance, SAFETY_DISTANCE)
            rng = np.random.default_rng((task.config.seed, curriculum.stage))
            others = [with_other_starts(task.field, apart, rng) for _ in range(count)]
            fields = [task.field] * (worlds - count) + others
        return {"field": fields, **task.settings, **settings}


DRAWS = 1000
"""Points that are tried for the starts of a field; if they are too few it keeps its own."""


def with_other_starts(field: Field, apart: float, rng: np.random.Generator) -> Field:
    """Return the field with as many starts anywhere in it, at least ``apart`` units apart."""
    starts: list[NDArray[np.float64]] = []
    for point in rng.uniform(field.vertices.min(0), field.vertices.max(0), (DRAWS, 2)):
        clear = all(np.hypot(*(point - start)) >= apart for start in starts)
        if clear and field.polygon.covers(Point(point)):
            starts.append(point)
        if len(starts) == len(field.starts):
            others = np.array(starts)
            return Field(field.vertices, field.rois, others, field.holes, arena=field.arena)
    return field


def between(ends: tuple[float, float], share: float) -> float:
    """Interpolate: the number a ``share``, cut to [0, 1], of the way from one end to the other."""
    start, end = ends
    return start + (end - start) * min(1.0, max(0.0, share))


@dataclass
class RoiCurriculum:
    """The size of ROIs while a team learns, as a multiple of the true radius.

    It falls from ``first`` to 1 in ``stages``, by the same factor each. Below the first of the
    ``bounds`` of the success rate of ``window`` episodes ROIs grow by a stage, from the second on
    they shrink by one.
    """

    first: float
    stages: int
    bounds: tuple[float, float]
    window: int
    stage: int = 0
    moves: int = 0
    ended: int = 0
    succeeded: int = 0

    @property
    def radius(self) -> float:
        """The present multiple."""
        return float(self.first ** (1.0 - self.stage / self.stages))

    def add(self, successes: Sequence[float]) -> None:
        """Count episodes that ended: 1 for a success, 0 for a failure."""
        self.ended += len(successes)
        self.succeeded += round(sum(successes))

    def move(self) -> bool:
        """Change the stage if the window is full; return whether the size has changed."""
        if self.ended < self.window:
            return False
        low, high = self.bounds
        rate, before = self.succeeded / self.ended, self.radius
        self.ended = self.succeeded = 0
        if rate >= high:
            self.stage = min(self.stage + 1, self.stages)
        elif rate < low:
            self.stage = max(self.stage - 1, 0)
        moved = self.radius != before
        self.moves += moved
        return moved

    def seed(self, first: int) -> int:
        """The seed of the worlds: ``first``, and another after every change of the size."""
        if self.moves == 0:
            return first
        return int(np.random.SeedSequence((first, self.moves)).generate_state(1, np.uint64)[0] >> 1)


def _times(number: float | Uniform, factor: float) -> float | Uniform:
    """Return a number, or the range that it is drawn from, ``factor`` times as large."""
    if isinstance(number, Uniform):
        return Uniform(number.low * factor, number.high * factor)
    return number * factor
