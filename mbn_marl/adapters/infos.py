"""The infos of a step: flat, numeric, the same keys at every step and reset.

==================  =========================================================================
key                 value (float)
==================  =========================================================================
``success``         1 if all ROIs are visited
``rois_visited``    how many ROIs the team has visited in this episode
``collision``       1 if two robots came closer than the safety distance
``wall_hits``       how often the robot tried to leave the field in this episode
``path_length``     how far the robot has moved in this episode, in units
``impulse``         the robot's part of the paper's objective, ``|sum_t u_i tau|``
``reward/<term>``   the terms of this step's reward, which sum to the robot's own reward
==================  =========================================================================

In a team's info the robots' own values (from ``wall_hits`` on) are summed over the team.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mbn_marl.engine import INFO_COLUMNS, BatchEngine

INFO_KEYS = INFO_COLUMNS
TEAM_WIDE = slice(0, INFO_KEYS.index("wall_hits"))
"""The first keys describe the team, and are the same for all of its robots."""


def robot_infos(engine: BatchEngine) -> list[dict[str, float]]:
    """One info for each robot of the first world of ``engine``, as of the last step."""
    return [dict(zip(INFO_KEYS, row, strict=True)) for row in engine.infos()[0].tolist()]


def team_rows(engine: BatchEngine) -> NDArray[np.float64]:
    """The infos of the teams of ``engine`` as of the last step, ``(W, 12)``, ordered as the keys.

    Units are those of the keys.
    """
    robots = engine.infos()
    team: NDArray[np.float64] = robots.sum(axis=1)
    team[:, TEAM_WIDE] = robots[:, 0, TEAM_WIDE]
    return team
