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
``reward/<term>``   the terms of this step's reward, which sum to the robot's own reward
``optimality_gap``  once the episode has ended, by how much its return falls short of the proved
                    optimum, as a share of that; 0 before. Only where there is a proved optimum
==================  =========================================================================

In a team's info the robots' own values (from ``wall_hits`` on) are summed over the team.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbn_marl.engine import INFO_COLUMNS, BatchEngine
from mbn_marl.optimum import optimal_return

INFO_KEYS = INFO_COLUMNS
GAP = "optimality_gap"
TEAM_WIDE = slice(0, INFO_KEYS.index("wall_hits"))
"""The first keys describe the team and are the same for all robots."""


class Infos:
    """Makes the infos of the worlds of ``engine``.

    Attributes:
        keys: the keys of every info.
        optima: (W,), reward units: the proved optimum of each world, or ``None`` unless all have
            one.
    """

    def __init__(self, engine: BatchEngine) -> None:
        self._engine = engine
        known = [optimal_return(field, engine.config) for field in engine.fields]
        optima = [optimum for optimum in known if optimum is not None]
        proved = len(optima) == len(known)
        self.optima = np.resize(np.array(optima), engine.num_worlds) if proved else None
        self.keys = INFO_KEYS if self.optima is None else (*INFO_KEYS, GAP)

    def nothing(self) -> dict[str, float]:
        """Return the info of a reset."""
        return dict.fromkeys(self.keys, 0.0)

    def of_robots(self, ended: bool) -> list[dict[str, float]]:
        """Return an info for each robot of the first world; ``ended``: its episode has ended."""
        rows = self._engine.infos()[0].tolist()
        infos = [dict(zip(INFO_KEYS, row, strict=True)) for row in rows]
        if self.optima is not None:
            gap = float(self._gaps(np.array([ended]))[0]) if ended else 0.0
            for info in infos:
                info[GAP] = gap
        return infos

    def of_teams(self, ended: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the info of every world's team, ordered as the keys.

        Args:
            ended: (W,) bool, the worlds whose episode has ended.

        Returns:
            (W, keys), in the units of the keys.
        """
        robots = self._engine.infos()
        team: NDArray[np.float64] = robots.sum(axis=1)
        team[:, TEAM_WIDE] = robots[:, 0, TEAM_WIDE]
        return team if self.optima is None else np.column_stack([team, self._gaps(ended)])

    def _gaps(self, ended: NDArray[np.bool_]) -> NDArray[np.float64]:
        if self.optima is None or not ended.any():
            return np.zeros(len(ended))
        returns = self._engine.metrics()["episode_return"]
        return np.where(ended, 1.0 - returns / self.optima, 0.0)
