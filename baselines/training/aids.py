"""Aids of training, which evaluations do without: large ROIs, other starts, short episodes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import pydantic
from numpy.typing import NDArray
from shapely import Point

from baselines.training.config import Hyperparameters, Task
from mbn_marl.config import Uniform, make_config
from mbn_marl.field import Field
from mbn_marl.field.schema import KINDS, SAFETY_DISTANCE

Count = Annotated[int, pydantic.Field(ge=1)]
Share = Annotated[float, pydantic.Field(ge=0.0, le=1.0)]
Positive = Annotated[float, pydantic.Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, pydantic.Field(ge=0.0, allow_inf_nan=False)]

# The stages in which ROIs shrink to their true size.
STAGES = 10
# ROIs grow by a stage below the first success rate, and shrink by one from the second on.
SUCCESS = (0.4, 0.8)
# Points that are tried for the starts of a field; if they are too few it keeps its own.
DRAWS = 1000


@dataclass
class RoiCurriculum:
    """The size of ROIs while a team learns, as a multiple of the true radius."""

    # It falls from ``first`` to 1 in STAGES, by the same factor each, as the success rate of each
    # ``window`` episodes allows.

    first: float
    window: int
    stage: int = 0
    moves: int = 0
    ended: int = 0
    succeeded: int = 0

    @property
    def radius(self) -> float:
        return float(self.first ** (1.0 - self.stage / STAGES))

    @property
    def begun(self) -> bool:
        """ROIs have shrunk, or never were large."""
        return self.stage > 0 or self.first == 1.0

    def add(self, successes: Sequence[float]) -> None:
        self.ended += len(successes)
        self.succeeded += round(sum(successes))

    def move(self) -> bool:
        """Change the stage if the window is full; return whether the size has changed."""
        if self.ended < self.window:
            return False
        (low, high), rate, before = SUCCESS, self.succeeded / self.ended, self.radius
        self.ended = self.succeeded = 0
        if rate >= high:
            self.stage = min(self.stage + 1, STAGES)
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


class TrainingAids(Hyperparameters):
    # The learner sees the reward times this.
    reward_scale: Positive = 1.0
    # ROIs are so many times as large at first in training, 1 for no curriculum.
    roi_radius: Annotated[float, pydantic.Field(ge=1.0, allow_inf_nan=False)] = 1.0
    # The share of the worlds whose robots start anywhere in the field, elsewhere at every stage,
    # until ROIs have their true size. A start beside an ROI visits it while it is large: a team
    # that always starts there would not learn to go to it.
    scattered: Share = 0.0
    # Training episodes are truncated after so many env-steps, if not before.
    episode_steps: Count | None = None

    def in_training(self, task: Task, curriculum: RoiCurriculum, worlds: int) -> dict[str, Any]:
        """The environment's arguments in training: ``field``, one for all worlds or one each."""
        field = task.field_of(curriculum.seed(task.config.seed))
        true, radius = make_config(task.settings), curriculum.radius
        longest = min(true.max_steps, self.episode_steps or true.max_steps)
        changed: dict[str, Any] = {"field": field, "max_steps": longest}
        changed["roi_radius"] = (
            Uniform(true.roi_radius.low * radius, true.roi_radius.high * radius)
            if isinstance(true.roi_radius, Uniform)
            else true.roi_radius * radius
        )
        if true.failures is not None:
            # A failure after the last step of an episode is not valid: no episode would have it.
            at = {i: step for i, step in true.failures.at.items() if step <= longest}
            span = true.failures.between
            span = span if span and span[0] <= longest else None
            changed["failures"] = true.failures.model_copy(update={"at": at, "between": span})
        count = round(self.scattered * worlds) if radius > 1.0 and not true.random_starts else 0
        if count and isinstance(field, Field):
            apart = max(true.at_most().safety_distance, SAFETY_DISTANCE)
            rng = np.random.default_rng((task.config.seed, curriculum.stage))
            others = [with_other_starts(field, apart, rng) for _ in range(count)]
            changed["field"] = [field] * (worlds - count) + others
        return {**task.settings, **changed}


def with_other_starts(field: Field, apart: float, rng: np.random.Generator) -> Field:
    starts: list[NDArray[np.float64]] = []
    for point in rng.uniform(field.vertices.min(0), field.vertices.max(0), (DRAWS, 2)):
        clear = all(np.hypot(*(point - start)) >= apart for start in starts)
        if clear and field.polygon.covers(Point(point)):
            starts.append(point)
        if len(starts) == len(field.starts):
            others, kept = np.array(starts), {n: getattr(field, n) for n in ("arena", *KINDS)}
            return Field(field.vertices, field.rois, others, field.holes, **kept)
    return field


def between(ends: tuple[float, float], share: float) -> float:
    """Interpolate: the number a ``share``, cut to [0, 1], of the way from one end to the other."""
    start, end = ends
    return start + (end - start) * min(1.0, max(0.0, share))
