"""The MDP's constants: named once, rounded to the engine's precision, passed as one record."""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import NUMBERS, Failures, NavigationConfig, RewardProfile
from mbn_marl.engine.mdp.disturbances import gust_factors
from mbn_marl.engine.mdp.dynamics import count_headings
from mbn_marl.engine.mdp.failures import KINDS as FAILURE_KINDS
from mbn_marl.engine.mdp.observations import OBSERVATIONS
from mbn_marl.engine.mdp.rewards import RULES

AUTORESET_MODES = ("disabled", "same_step", "next_step")
WEIGHTS = [name for name, field in RewardProfile.model_fields.items() if field.annotation is float]
# The numbers of a :class:`RewardProfile`, real, reward units.
Weights = namedtuple("Weights", WEIGHTS)  # type: ignore[misc]


def _values(
    config: NavigationConfig,
    n: int,
    arena: tuple[float, float],
    autoreset: str,
    first_world: int = 0,
    teams_vary: bool = False,
) -> dict[str, Any]:
    """The constants by name: ``float`` and ``Weights`` become reals, others whole numbers."""
    real = np.dtype(config.dtype)
    weights = [getattr(config.reward, name) for name in WEIGHTS]
    config = config.at_most()  # for constants, which take no part where episodes draw numbers
    wind_x, wind_y = config.wind_increment()
    gust_kept, gust_added = gust_factors(config)
    width, height = map(float, arena)
    failures = config.failures or Failures()
    failing_first, failing_last = failures.between or (0, 0)
    radii = config.sensing_radius, config.comm_radius
    least_decoys, most_decoys = config.decoy_range
    return {
        **{name: getattr(config, name) for name in NUMBERS},
        "zero": 0.0,
        "one": 1.0,
        "pi": np.pi,
        "top_speed": config.top_speed,
        "wind_x": wind_x,
        "wind_y": wind_y,
        "gust_kept": gust_kept,
        "gust_added": gust_added,
        "arena_x": width,
        "arena_y": height,
        "half_arena_x": width / 2,
        "half_arena_y": height / 2,
        "safety_squared": config.safety_distance**2,
        "roi_squared": config.roi_radius**2,
        "sensing_squared": config.sensing_radius**2,
        "notice_squared": (max(radii) if config.knowledge == "own" else radii[0]) ** 2,
        "comm_squared": config.comm_radius**2,
        "look_squared": -1.0 if config.look_radius is None else config.look_radius**2,  # -1: rho's
        "comm_loss": config.comm_loss,
        "whole": Weights(*weights),
        "share": Weights(*(weight / n for weight in weights)),  # of what the whole team gets
        "per_arena_x": _reciprocal(width, real),
        "per_arena_y": _reciprocal(height, real),
        "per_half_arena_x": _reciprocal(width / 2, real),
        "per_half_arena_y": _reciprocal(height / 2, real),
        "per_speed": _reciprocal(config.top_speed, real),
        "per_speed_range": _reciprocal(2 * config.top_speed, real),
        "failure_rate": failures.rate,
        "failure_kind": FAILURE_KINDS[failures.kind],
        "most_failures": -1 if failures.most is None else failures.most,  # -1: all but one
        "failing_first": failing_first,
        "failing_last": failing_last,
        "some_gone": teams_vary or failures.kind == "vanish",
        "teams_vary": teams_vary,
        "headings": count_headings(config.of_each("dynamics", n)),
        "rules": RULES[config.reward.rules],
        "team_sharing": config.reward_sharing == "team",
        "observation": OBSERVATIONS[config.observation],
        "keeps_plan": config.assignment is True,
        "one_hot": config.one_hot,
        "hidden_rois": config.hidden_rois,
        "least_decoys": least_decoys,
        "most_decoys": most_decoys,
        "empty_rois": sum(1 << j for j in config.empty_rois),
        "random_starts": config.random_starts,
        "action_delay": config.action_delay,
        "max_steps": config.max_steps,
        "first_world": first_world,
        "autoreset": AUTORESET_MODES.index(autoreset),
    }


def _reciprocal(span: float, real: np.dtype[Any]) -> float:
    """1 / span, rounded so that ``span * result <= 1``: scaled entries stay in their bounds."""
    value = real.type(1.0 / span)
    while real.type(span) * value > 1:
        value = np.nextafter(value, real.type(0))
    return float(value)


# The constants of any configuration name those of all.
# Constants of the MDP as kernels see them: reals of the engine's precision, whole numbers.
Constants = namedtuple("Constants", _values(NavigationConfig(), 1, (1.0, 1.0), "disabled"))  # type: ignore[misc]


def make_record(*arguments: Any, **named: Any) -> NDArray[Any]:
    """The ``_values`` as one structured array, (1,), laid out as Numba lays out ``Constants``."""
    values = _values(*arguments, **named)
    real = np.dtype(arguments[0].dtype)
    kinds = {float: real, Weights: np.dtype([(name, real) for name in WEIGHTS])}
    layout = [(name, kinds.get(type(value), np.dtype(np.int64))) for name, value in values.items()]
    return np.array([tuple(values.values())], np.dtype(layout, align=True))


def constants_of(record: NDArray[Any]) -> Constants:
    """The record (1,) as :class:`Constants`: NumPy's reals and Python's integers."""
    makers: dict[str, Any] = {"f": lambda real: real, "i": int, "V": lambda row: Weights(*row)}
    kinds = (record.dtype[k].kind for k in range(len(Constants._fields)))
    return Constants(*(makers[kind](one) for kind, one in zip(kinds, record[0], strict=True)))
