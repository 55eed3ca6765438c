"""The proved optimum of a field, as a return."""

from __future__ import annotations

from mbn_marl.config import NavigationConfig
from mbn_marl.field import Field

DEFAULT = NavigationConfig()
# Settings that change observations, but not the best return; or nothing without a gust.
VIEW = (
    *("reward_sharing", "observation", "assignment", "one_hot", "sensing_radius", "dtype"),
    *("position_noise", "velocity_noise", "dropout", "gust_time"),
)


def optimality_gap(return_: float, optimum: float | None) -> float | None:
    """Return the gap of ``return_`` to ``optimum``, as a share of it; ``None`` without one."""
    return None if optimum is None else 1.0 - return_ / optimum


def optimal_return(field: Field, config: NavigationConfig | None = None) -> float | None:
    """Return the best possible team return, ``m r_l + r_inf - n r_s T*``, ``None`` if not proved.

    It is proved for the default dynamics, the released rewards and the field's own starts and
    team, as long as ``r_l``, the cost of the abrupt stop at a wall, exceeds that of all the steps.

    ``config`` is that of the environment; ``None`` is the default one. The formula is that of
    ``docs/mdp.md`` for a clean success, T* the planner's.
    """
    config = config or DEFAULT
    comparable = config.model_copy(
        update={name: NavigationConfig.model_fields[name].default for name in VIEW}
    )
    if field.optimal_makespan is None or comparable not in (
        DEFAULT,
        DEFAULT.model_copy(update={"n_robots": len(field.starts)}),
    ):
        return None
    reward = config.reward
    team_charge = len(field.starts) * reward.small * field.optimal_makespan
    if team_charge > reward.large:
        return None
    return len(field.rois) * reward.large + reward.infinite - team_charge
