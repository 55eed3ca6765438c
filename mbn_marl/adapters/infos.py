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
``reward/<term>``   the terms of this step's reward, which sum to it (up to float32's rounding)
``optimality_gap``  at the end of the episode, by how much its return falls short of the proved
                    optimum, as a share of that; NaN before, and where no optimum is proved
``drawn/<name>``    each number that the episode has drawn (``NavigationConfig.drawn``), in the
                    unit of the setting
==================  =========================================================================

In a team's info the robots' own values (from ``wall_hits`` to ``failed``) are summed over the team,
and the terms are those of the team's reward.
"""

from __future__ import annotations

import math
from typing import Any

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


class Infos:
    """Makes the infos of the worlds of ``engine``.

    Attributes:
        keys: the keys of every info.
        optima: (W,), reward units: the proved optimum of each world, NaN where there is none.
    """

    def __init__(self, engine: BatchEngine) -> None:
        self._engine = engine
        self.keys = (*INFO_COLUMNS, GAP, *(f"drawn/{name}" for name in engine.config.drawn))
        self.read_optima()

    def read_optima(self, known: bool = True) -> None:
        """Find the proved optima of the present fields, if any are ``known``.

        Fields that a sampler draws and starts that were given have none.
        """
        engine, known = self._engine, known and self._engine.sampler is None
        count = min(engine.num_worlds, len(engine.fields))
        own = [engine.field_of(world) for world in range(count if known else 0)]
        optima = [optimal_return(field, engine.config) for field in own] or [None]
        self.optima = np.resize(np.array(optima, np.float64), engine.num_worlds)

    def of_reset(self) -> dict[str, float]:
        return self._named(self.of_resets()[0].tolist())

    def of_resets(self) -> NDArray[np.float64]:
        """The info of a reset of every world, (W, keys)."""
        worlds = self._engine.num_worlds
        gaps, drawn = np.full(worlds, np.nan), self._engine.drawn().values()
        return np.column_stack([np.zeros((worlds, len(INFO_COLUMNS))), gaps, *drawn])

    def of_robots(self, ended: bool) -> list[dict[str, float]]:
        """One info for each robot of the first world; ``ended``: whether its episode has."""
        rows = self._engine.infos()[0].tolist()
        if ended or self.keys[-1] != GAP:
            more = [float(column[0]) for column in self._team_wide(np.array([ended]))]
            return [self._named(row + more) for row in rows]
        return [dict(zip(INFO_COLUMNS, row), optimality_gap=UNDEFINED) for row in rows]  # noqa: B905 - strict is slow

    def of_team(self, ended: bool) -> dict[str, float]:
        return self._named(self.of_teams(np.array([ended]))[0].tolist())

    def of_teams(self, ended: NDArray[np.bool_]) -> NDArray[np.float64]:
        """The info of every world's team before any automatic reset, (W, keys)."""
        return np.column_stack([self._engine.team_infos(), *self._team_wide(ended)])

    def _team_wide(self, ended: NDArray[np.bool_]) -> list[NDArray[Any]]:
        if self.keys[-1] == GAP:  # nothing is drawn
            return [self._gaps(ended)]
        drawn = self._engine.drawn()
        if self._engine.autoreset == "same_step":
            final = self._engine.final_drawn()
            drawn = {name: np.where(ended, final[name], one) for name, one in drawn.items()}
        return [self._gaps(ended), *drawn.values()]

    def _gaps(self, ended: NDArray[np.bool_]) -> NDArray[np.float64]:
        if not ended.any():
            return np.full(len(ended), np.nan)
        returns = self._engine.metrics(["episode_return"])["episode_return"]
        return np.where(ended, 1.0 - returns / self.optima, np.nan)

    def _named(self, row: list[float]) -> dict[str, float]:
        info = dict(zip(self.keys, row, strict=True))
        if math.isnan(info[GAP]):
            info[GAP] = UNDEFINED
        return info
