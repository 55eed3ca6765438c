"""The MDP's constants: named once, rounded to the engine's precision, passed as one record."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.engine.compiling import compiled
from mbn_marl.engine.observation import OBSERVATIONS
from mbn_marl.engine.rewards import RULES

AUTORESET_MODES = ("disabled", "same_step", "next_step")


class Constants(NamedTuple):
    """Constants of the MDP as kernels see them: scalars. All before ``max_steps`` are real."""

    zero: Any
    one: Any
    tau: Any
    f_max: Any
    v_clip: Any
    wind_x: Any  # velocity that the wind adds in a step
    wind_y: Any
    arena_x: Any
    arena_y: Any
    half_arena_x: Any
    half_arena_y: Any
    safety_squared: Any  # C^2
    roi_squared: Any  # rho^2
    sensing_squared: Any
    small: Any  # r_s; a share is a robot's part of a reward that the whole team gets
    small_share: Any
    medium: Any  # r_m
    medium_share: Any
    large: Any  # r_l
    infinite: Any  # r_inf
    infinite_share: Any
    per_arena_x: Any  # reciprocals, for scaled observations
    per_arena_y: Any
    per_half_arena_x: Any
    per_half_arena_y: Any
    per_speed: Any
    per_speed_range: Any
    max_steps: Any
    rules: Any
    team_sharing: Any
    observation: Any
    one_hot: Any
    random_starts: Any
    autoreset: Any
    seed: Any


REALS = Constants._fields.index("max_steps")


def make_record(
    config: NavigationConfig, n: int, arena: tuple[float, float], autoreset: str, seed: int
) -> NDArray[Any]:
    """The constants as one structured array, (1,), that kernels take as a single argument."""
    real = np.dtype(config.dtype)
    profile = config.reward
    wind_x, wind_y = config.wind_increment()
    width, height = arena
    constants = Constants(
        zero=0.0,
        one=1.0,
        tau=config.tau,
        f_max=config.f_max,
        v_clip=config.v_clip,
        wind_x=wind_x,
        wind_y=wind_y,
        arena_x=width,
        arena_y=height,
        half_arena_x=width / 2,
        half_arena_y=height / 2,
        safety_squared=config.safety_distance**2,
        roi_squared=config.roi_radius**2,
        sensing_squared=config.sensing_radius**2,
        small=profile.small,
        small_share=profile.small / n,
        medium=profile.medium,
        medium_share=profile.medium / n,
        large=profile.large,
        infinite=profile.infinite,
        infinite_share=profile.infinite / n,
        per_arena_x=_reciprocal(width, real),
        per_arena_y=_reciprocal(height, real),
        per_half_arena_x=_reciprocal(width / 2, real),
        per_half_arena_y=_reciprocal(height / 2, real),
        per_speed=_reciprocal(config.v_clip, real),
        per_speed_range=_reciprocal(2 * config.v_clip, real),
        max_steps=config.max_steps,
        rules=RULES[profile.rules],
        team_sharing=config.reward_sharing == "team",
        observation=OBSERVATIONS[config.observation],
        one_hot=config.one_hot,
        random_starts=config.random_starts,
        autoreset=AUTORESET_MODES.index(autoreset),
        seed=seed,
    )
    types = [real] * REALS + [np.dtype(np.int64)] * (len(constants) - REALS)
    layout = np.dtype(list(zip(Constants._fields, types, strict=True)), align=True)
    return np.array([tuple(constants)], layout)


def _reciprocal(span: float, real: np.dtype[Any]) -> Any:
    """1 / span, rounded so that ``span * result <= 1``: scaled entries stay in their bounds."""
    value = real.type(1.0 / span)
    while real.type(span) * value > 1:
        value = np.nextafter(value, real.type(0))
    return value


@compiled
def unpack(record):
    """The record (1,) as :class:`Constants`.

    Scalars that live in registers cannot alias the arrays that a pass writes, so they leave its
    loop.
    """
    r = record[0]
    return Constants(
        r.zero,
        r.one,
        r.tau,
        r.f_max,
        r.v_clip,
        r.wind_x,
        r.wind_y,
        r.arena_x,
        r.arena_y,
        r.half_arena_x,
        r.half_arena_y,
        r.safety_squared,
        r.roi_squared,
        r.sensing_squared,
        r.small,
        r.small_share,
        r.medium,
        r.medium_share,
        r.large,
        r.infinite,
        r.infinite_share,
        r.per_arena_x,
        r.per_arena_y,
        r.per_half_arena_x,
        r.per_half_arena_y,
        r.per_speed,
        r.per_speed_range,
        r.max_steps,
        r.rules,
        r.team_sharing,
        r.observation,
        r.one_hot,
        r.random_starts,
        r.autoreset,
        r.seed,
    )
