"""The infos of a step: flat and numeric, with the same keys at every step and reset.

==================  =========================================================================
key                 value (float)
==================  =========================================================================
``success``         1 if all ROIs are visited
``rois_visited``    number of ROIs the team has visited in this episode
``collision``       1 if two robots came closer than the safety distance
``wall_hits``       number of times the robot tried to leave the field in this episode
``path_length``     distance the robot has moved in this episode, in units
``impulse``         the robot's part of the paper's objective, ``|sum_t u_i tau|``
``failed``          1 if the robot has failed
``reward/<term>``   the terms of this step's reward, which sum to the robot's own reward
``optimality_gap``  at the end of the episode, by how much its return falls short of the proved
                    optimum, as a share of that; NaN before, and where no optimum is proved
==================  =========================================================================

In a team's info the robots' own values (from ``wall_hits`` on) are summed over the team.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbn_marl.engine import INFO_COLUMNS, BatchEngine
from mbn_marl.optimum import optimal_return


class Undefined(np.float64):
    """NaN that equals NaN: the checkers of PettingZoo and Gymnasium compare infos by ``==``."""

    def __eq__(self, other: object) -> bool:
        return bool(other != other) if isinstance(other, float) else NotImplemented

    __hash__ = np.float64.__hash__


UNDEFINED = Undefined("nan")
GAP = "optimality_gap"
INFO_KEYS = (*INFO_COLUMNS, GAP)
"""The keys of every info."""
NOTHING = {**dict.fromkeys(INFO_COLUMNS, 0.0), GAP: UNDEFINED}
"""The info of a reset."""
TEAM_WIDE = slice(0, INFO_KEYS.index("wall_hits"))
"""The first keys describe the team and are the same for all robots."""


class Infos:
    """Makes the infos of the worlds of ``engine``.

    Attributes:
        optima: (W,), reward units: the proved optimum of each world, NaN where there is none.
    """

    def __init__(self, engine: BatchEngine) -> None:
        self._engine = engine
        optima = [optimal_return(field, engine.config) for field in engine.fields]
        self.optima = np.resize(np.array(optima, np.float64), engine.num_worlds)

    def of_robots(self, ended: bool) -> list[dict[str, float]]:
        """One info for each robot of the first world; ``ended``: whether its episode has."""
        gap = self._gaps(np.array([ended])).tolist()
        return [_named(row + gap) for row in self._engine.infos()[0].tolist()]

    def of_team(self, ended: bool) -> dict[str, float]:
        """The info of the first world's team; ``ended``: whether its episode has."""
        return _named(self.of_teams(np.array([ended]))[0].tolist())

    def of_teams(self, ended: NDArray[np.bool_]) -> NDArray[np.float64]:
        """The info of every world's team, ordered as ``INFO_KEYS``.

        Args:
            ended: (W,) bool, the worlds whose episode has ended.

        Returns:
            (W, keys), in the units of the keys.
        """
        robots = self._engine.infos()
        team: NDArray[np.float64] = robots.sum(axis=1)
        team[:, TEAM_WIDE] = robots[:, 0, TEAM_WIDE]
        return np.column_stack([team, self._gaps(ended)])

    def _gaps(self, ended: NDArray[np.bool_]) -> NDArray[np.float64]:
        if not ended.any():
            return np.full(len(ended), np.nan)
        returns = self._engine.metrics()["episode_return"]
        return np.where(ended, 1.0 - returns / self.optima, np.nan)


def _named(row: list[float]) -> dict[str, float]:
    info = dict(zip(INFO_KEYS, row, strict=True))
    return {**info, GAP: UNDEFINED} if np.isnan(info[GAP]) else info
