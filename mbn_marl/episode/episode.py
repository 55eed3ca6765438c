"""One episode of one world, from the reset to its last step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from dataclasses import field as attribute
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.engine import Snapshot
from mbn_marl.field import Field

Outcome = Literal["success", "collision", "truncated", "unfinished"]
"""How an episode ended; ``"unfinished"``: its last step did not end it."""

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Episode:
    """The actions of n robots in T steps, and their results. Do not write to the arrays.

    Attributes:
        field: the field, with m ROIs.
        config: the configuration with the team size.
        actions: (T, n, 2), in [-1, 1], in the engine's dtype.
        positions: (T + 1, n, 2), units, from the reset on, in the engine's dtype.
        headings: (T + 1, n), radians in [-pi, pi), in the engine's dtype; NaN for a robot that has
            none.
        failed: (n,) int32, the step in which each robot failed, from 1 on; 0 for never.
        visits: (m,) int32, the step in which each ROI was visited, from 1 on; 0 for never.
        terms: (T, n, terms) float64, each robot's own reward by term, ordered as ``REWARD_TERMS``.
        team_rewards: (T,) float64, the centralised reward of each step.
        outcome: how it ended.
        winds: (T + 1, 2), units/step, what wind and gust add to a velocity in the next step;
            ``None`` without gusts.
        drawn: the numbers that the episode has drawn, by name, in the units of the settings.
        source: the name of what acted.
        seed: of the world and of what acted; ``None`` if unknown.
        world: the number of the world: with the seed and ``number`` the key of what is random.
        number: of the episode, since the seed was set.
    """

    field: Field
    config: NavigationConfig
    actions: Array
    positions: Array
    headings: Array
    failed: NDArray[np.int32]
    visits: NDArray[np.int32]
    terms: NDArray[np.float64]
    team_rewards: NDArray[np.float64]
    outcome: Outcome
    winds: NDArray[np.float64] | None = None
    drawn: Mapping[str, float] = attribute(default_factory=dict)
    source: str = ""
    seed: int | None = None
    world: int = 0
    number: int = 0

    @property
    def steps(self) -> int:
        """T, the number of steps."""
        return len(self.actions)

    @property
    def team_return(self) -> float:
        """The sum of all centralised rewards, in reward units."""
        return self.return_after(self.steps)

    def return_after(self, step: int) -> float:
        """Return the sum of the centralised rewards of the first ``step`` steps."""
        return float(sum(self.team_rewards[:step].tolist()))

    @property
    def rois_visited(self) -> int:
        """The number of ROIs visited."""
        return int(np.count_nonzero(self.visits))

    @property
    def gone(self) -> NDArray[np.bool_]:
        """Which robots have vanished, and touch nothing, (T + 1, n) bool, from the reset on."""
        failures, steps = self.config.failures, np.arange(self.steps + 1)[:, None]
        vanish = failures is not None and failures.kind == "vanish"
        return vanish & (self.failed > 0) & (self.failed <= steps)

    def snapshot(self, step: int) -> Snapshot:
        """Return the snapshot after ``step`` steps, 0 to T.

        Its velocities are the robots' displacements in that step.
        """
        config, trail = self.config.with_drawn(self.drawn), self.positions[: step + 1]
        winds = np.array([config.wind_increment()]) if self.winds is None else self.winds
        last = step == self.steps
        return Snapshot(
            field=self.field,
            positions=trail[-1],
            velocities=(trail[-1] - trail[-2]) / config.tau if step else np.zeros_like(trail[0]),
            headings=self.headings[step],
            failed=(self.failed > 0) & (self.failed <= step),
            gone=self.gone[step],
            visited=(self.visits > 0) & (self.visits <= step),
            trail=trail,
            step=step,
            team_return=self.return_after(step),
            winds=winds[: step + 1],
            roi_radius=config.roi_radius,
            safety_distance=config.safety_distance,
            success=last and self.outcome == "success",
            collision=last and self.outcome == "collision",
        )

    def snapshots(self) -> Iterator[Snapshot]:
        """Yield the T + 1 snapshots after the reset and after every step."""
        return map(self.snapshot, range(self.steps + 1))
