"""The MDP's constants: named once, rounded to the engine's precision, passed as one record."""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import Failures, NavigationConfig, RewardProfile
from mbn_marl.engine.mdp.disturbances import gust_factors
from mbn_marl.engine.mdp.dynamics import count_headings
from mbn_marl.engine.mdp.failures import KINDS as FAILURE_KINDS
from mbn_marl.engine.mdp.observations import OBSERVATIONS
from mbn_marl.engine.mdp.rewards import RULES

AUTORESET_MODES = ("disabled", "same_step", "next_step")

WEIGHTS = [name for name, field in RewardProfile.model_fields.items() if field.annotation is float]
Weights = namedtuple("Weights", WEIGHTS)  # type: ignore[misc]
"""The numbers of a :class:`RewardProfile`, real, reward units."""


class Constants(NamedTuple):
    """Constants of the MDP as kernels see them: scalars; ``float`` is the engine's precision."""

    zero: float
    one: float
    tau: float
    top_speed: float  # the highest speed limit of a robot
    pi: float
    turn_max: float
    wheelbase: float
    steer_max: float
    wind_x: float  # velocity that the wind adds in a step
    wind_y: float
    gust: float
    gust_kept: float
    gust_added: float
    action_noise: float
    action_loss: float
    position_noise: float
    velocity_noise: float
    dropout: float
    arena_x: float
    arena_y: float
    half_arena_x: float
    half_arena_y: float
    safety_squared: float  # C^2
    roi_squared: float  # rho^2
    sensing_squared: float
    whole: Weights
    share: Weights  # a robot's part of what the whole team gets
    per_arena_x: float  # reciprocals, for scaled observations
    per_arena_y: float
    per_half_arena_x: float
    per_half_arena_y: float
    per_speed: float
    per_speed_range: float
    failure_rate: float
    action_delay: int
    max_steps: int
    headings: int
    some_gone: int  # whether robots can be gone
    teams_vary: int
    rules: int
    team_sharing: int
    observation: int
    keeps_plan: int  # whether an assignment stays as long as it can
    one_hot: int
    random_starts: int
    failure_kind: int
    most_failures: int  # -1: all but one
    failing_first: int  # the first and the last step of those one of which a failure draws, or 0
    failing_last: int
    first_world: int  # the number of the world with index 0
    autoreset: int


KINDS = get_type_hints(Constants)


def make_record(
    config: NavigationConfig,
    n: int,
    arena: tuple[float, float],
    autoreset: str,
    first_world: int = 0,
    teams_vary: bool = False,
) -> NDArray[Any]:
    """The constants as one structured array, (1,), laid out as Numba lays out ``Constants``.

    Those that are a setting have its name.
    """
    real = np.dtype(config.dtype)
    weights = [getattr(config.reward, name) for name in WEIGHTS]
    config = config.at_most()  # for constants, which take no part where episodes draw numbers
    wind_x, wind_y = config.wind_increment()
    gust_kept, gust_added = gust_factors(config)
    width, height = arena
    failures = config.failures or Failures()
    failing_first, failing_last = failures.between or (0, 0)
    values = {
        **{name: getattr(config, name, None) for name in Constants._fields},
        "zero": 0.0,
        "one": 1.0,
        "pi": np.pi,
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
        "whole": tuple(weights),
        "share": tuple(weight / n for weight in weights),
        "per_arena_x": _reciprocal(width, real),
        "per_arena_y": _reciprocal(height, real),
        "per_half_arena_x": _reciprocal(width / 2, real),
        "per_half_arena_y": _reciprocal(height / 2, real),
        "per_speed": _reciprocal(config.top_speed, real),
        "per_speed_range": _reciprocal(2 * config.top_speed, real),
        "headings": count_headings(config.of_each("dynamics", n)),
        "failure_rate": failures.rate,
        "failure_kind": FAILURE_KINDS[failures.kind],
        "most_failures": -1 if failures.most is None else failures.most,
        "failing_first": failing_first,
        "failing_last": failing_last,
        "some_gone": teams_vary or failures.kind == "vanish",
        "teams_vary": teams_vary,
        "rules": RULES[config.reward.rules],
        "team_sharing": config.reward_sharing == "team",
        "observation": OBSERVATIONS[config.observation],
        "keeps_plan": config.assignment is True,
        "first_world": first_world,
        "autoreset": AUTORESET_MODES.index(autoreset),
    }
    types: dict[Any, Any] = {
        float: real,
        int: np.int64,
        Weights: [(name, real) for name in WEIGHTS],
    }
    layout = [(name, types[kind]) for name, kind in KINDS.items()]
    record = tuple(values[name] for name in Constants._fields)
    return np.array([record], np.dtype(layout, align=True))


def constants_of(record: NDArray[Any]) -> Constants:
    """The record (1,) as :class:`Constants`: NumPy's reals and Python's integers."""
    values = zip(KINDS.values(), record[0], strict=True)
    make: dict[Any, Any] = {float: lambda real: real, int: int, Weights: lambda row: Weights(*row)}
    return Constants(*(make[kind](value) for kind, value in values))


def _reciprocal(span: float, real: np.dtype[Any]) -> Any:
    """1 / span, rounded so that ``span * result <= 1``: scaled entries stay in their bounds."""
    value = real.type(1.0 / span)
    while real.type(span) * value > 1:
        value = np.nextafter(value, real.type(0))
    return value
