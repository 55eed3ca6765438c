"""Aids of training, which evaluations do without: large ROIs, long decisions, short episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field

from baselines.training.hyperparameters import Hyperparameters
from mbn_marl.config import make_config

Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class TrainingAids(Hyperparameters):
    """Hyperparameters with training aids; by default there are none.

    Attributes:
        reward_scale: the learner sees the reward times this.
        action_repeat: env-steps that a decision lasts, from and to, falling linearly (rounded)
            over ``action_repeat_until`` of training. Evaluations always decide at every step.
        roi_radius: how many times as large ROIs are at first in training, 1 for no curriculum.
        roi_stages: the stages from there to the true size; each begins with new episodes.
        roi_success: ``bounds`` of :class:`RoiCurriculum`.
        episode_steps: training episodes are truncated after so many env-steps, if not before;
            evaluations are not.
    """

    reward_scale: Positive = 1.0
    action_repeat: tuple[Count, Count] = (1, 1)
    action_repeat_until: Annotated[float, Field(gt=0.0, le=1.0)] = 0.4
    roi_radius: Annotated[float, Field(ge=1.0, allow_inf_nan=False)] = 1.0
    roi_stages: Count = 10
    roi_success: tuple[Share, Share] = (0.4, 0.8)
    episode_steps: Count | None = None

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

    def in_training(self, settings: Mapping[str, Any], radius: float) -> dict[str, Any]:
        """The environment's ``settings`` in training, with ROIs ``radius`` times as large."""
        true = make_config(settings)
        longest = min(true.max_steps, self.episode_steps or true.max_steps)
        return {**settings, "roi_radius": true.roi_radius * radius, "max_steps": longest}


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
        return self.radius != before
