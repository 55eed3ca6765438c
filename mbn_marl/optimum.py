"""The proved optimum of a field, in steps and as a return."""

from __future__ import annotations

import numpy as np

from mbn_marl.config import KNOWLEDGE, NavigationConfig
from mbn_marl.field import Field
from mbn_marl.field.schema import ROI_RADIUS

DEFAULT = NavigationConfig()
# Settings that change observations, but not the best return; or nothing without a gust.
VIEW = (
    *("reward_sharing", "observation", "assignment", "one_hot", "sensing_radius", "dtype"),
    *("position_noise", "velocity_noise", "dropout", "gust_time", *KNOWLEDGE),
)
DELAY, LIMIT = "action_delay", "max_steps"
# Units, for positions in float32.
ROUNDING = 1e-3


def optimal_makespan(field: Field, config: NavigationConfig | None = None) -> int | None:
    """Return the least number of steps of a clean success, ``None`` if it is not proved.

    In a clean one no robot pushes outside the field, which can save steps. It is proved for the
    default dynamics, the released rewards and the field's own starts and team. ``config`` is that
    of the environment; ``None`` is the default one. An ``action_delay`` adds its steps, in which
    the robots rest, if no ROI is in reach of a start. There is none within a ``max_steps`` below
    it.
    """
    config = config or DEFAULT
    comparable = config.model_copy(
        update={name: NavigationConfig.model_fields[name].default for name in (*VIEW, DELAY, LIMIT)}
    )
    team = DEFAULT.model_copy(update={"n_robots": len(field.starts)})
    if field.optimal_makespan is None or comparable not in (DEFAULT, team):
        return None
    if config.action_delay:
        ways = np.linalg.norm(field.rois[:, None] - field.starts, axis=-1)
        if ways.min() <= ROI_RADIUS + ROUNDING:
            return None
    makespan = field.optimal_makespan + config.action_delay
    return makespan if makespan <= config.max_steps else None


def optimal_return(field: Field, config: NavigationConfig | None = None) -> float | None:
    """Return the best possible team return, ``m r_l + r_inf - n r_s T*``, ``None`` if not proved.

    T* is :func:`optimal_makespan`. ``r_l``, the cost of the abrupt stop at a wall, has to exceed
    that of all the steps. The formula is that of ``docs/mdp.md`` for a clean success.
    """
    config = config or DEFAULT
    if config.action_delay or (makespan := optimal_makespan(field, config)) is None:
        return None
    reward = config.reward
    team_charge = len(field.starts) * reward.small * makespan
    if team_charge > reward.large:
        return None
    return len(field.rois) * reward.large + reward.infinite - team_charge
