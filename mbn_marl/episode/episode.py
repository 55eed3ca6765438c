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

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Knowledge:
    """The ROIs that n robots know in T steps, of m, and whom they hear; each knows only its own."""

    empty: NDArray[np.bool_]  #: (m,), the empty ROIs
    done: NDArray[np.int64]  #: (n, m), from which step on robots know ROIs as done; T + 1 for never
    found: NDArray[np.int64]  #: (n, m), from which step on robots have found ROIs, likewise
    heard: NDArray[np.bool_]  #: (T + 1, n, n), whether robot i received words of robot k


@dataclass(frozen=True, eq=False)
class Episode:
    """The actions of n robots in T steps, and their results. Do not write to the arrays."""

    field: Field  #: with m ROIs
    config: NavigationConfig  #: with the team size
    actions: Array  #: (T, n, 2), in [-1, 1], in the engine's dtype
    positions: Array  #: (T + 1, n, 2), units, from the reset on, in the engine's dtype
    headings: Array  #: (T + 1, n), radians in [-pi, pi); NaN for a robot that has none
    failed: NDArray[np.int32]  #: (n,), the step in which each robot failed, from 1 on; 0 for never
    visits: NDArray[np.int32]  #: (m,), the step in which each ROI was visited, likewise
    terms: NDArray[np.float64]  #: (T, n, terms), each robot's rewards, ordered as REWARD_TERMS
    team_rewards: NDArray[np.float64]  #: (T,), the centralised reward of each step
    outcome: Outcome
    winds: NDArray[np.float64] | None = None  #: (T + 1, 2), of wind and gust in the next step
    drawn: Mapping[str, float] = attribute(default_factory=dict)  #: in the units of the settings
    source: str = ""  #: the name of the policy
    seed: int | None = None  #: of the world and of the policy; ``None`` if unknown
    world: int = 0  #: with the seed and ``number`` the key of all random numbers
    number: int = 0  #: of the episode, since the seed was set
    knowledge: Knowledge | None = None  #: in no file; :func:`check_episode` finds it again

    @property
    def steps(self) -> int:
        return len(self.actions)

    @property
    def team_return(self) -> float:
        return self.return_after(self.steps)

    def return_after(self, step: int) -> float:
        """Return the sum of the centralised rewards of the first ``step`` steps."""
        return float(sum(self.team_rewards[:step].tolist()))

    @property
    def rois_visited(self) -> int:
        return int(np.count_nonzero(self.visits))

    @property
    def gone(self) -> NDArray[np.bool_]:
        """(T + 1, n) bool: the robots that have vanished, and touch nothing."""
        failures, steps = self.config.failures, np.arange(self.steps + 1)[:, None]
        vanish = failures is not None and failures.kind == "vanish"
        return vanish & (self.failed > 0) & (self.failed <= steps)

    def snapshot(self, step: int) -> Snapshot:
        """Return the snapshot after ``step`` steps, 0 to T; velocities are displacements in it."""
        config, trail = self.config.with_drawn(self.drawn), self.positions[: step + 1]
        winds = np.array([config.wind_increment()]) if self.winds is None else self.winds
        last, known = step == self.steps, self.knowledge
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
            empty=np.False_ if known is None else known.empty,
            heard=np.False_ if known is None else known.heard[step],
        )

    def snapshots(self) -> Iterator[Snapshot]:
        return map(self.snapshot, range(self.steps + 1))
