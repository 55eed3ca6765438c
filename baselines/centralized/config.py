"""The hyperparameters of the centralised algorithms: ``hyperparams/<algorithm>.yaml``."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from baselines.hyperparameters import Hyperparameters, read_blocks, validate
from mbn_marl.errors import ConfigError

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

FOLDER = Path(__file__).with_name("hyperparams")
CLASSES = {"ppo": "stable_baselines3:PPO"}
SETTING = "N"
"""The setting that is trained: normalised observation, scaled reward."""


class CentralizedConfig(Hyperparameters):
    """A setting of one algorithm.

    Attributes:
        num_envs: worlds stepped side by side.
        reward_scale: the learner sees the reward times this.
        model: arguments of the library's class; ``{from: a, to: b}`` for a number falls linearly
            over training.
    """

    num_envs: Annotated[int, Field(ge=1)]
    reward_scale: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    model: dict[str, Any]


class LinearSchedule(BaseModel):
    """A number that changes linearly over training, as Stable-Baselines3 calls it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    start: float = Field(alias="from")
    end: float = Field(alias="to")

    def __call__(self, progress_remaining: float) -> float:
        """The value with ``progress_remaining``, from 1 at the start to 0 at the end."""
        return self.end + (self.start - self.end) * progress_remaining


def algorithm_class(algorithm: str) -> type[BaseAlgorithm]:
    """The library's class of an algorithm."""
    module, name = CLASSES[algorithm].split(":")
    found: type[BaseAlgorithm] = getattr(import_module(module), name)
    return found


def load(algorithm: str, overrides: Mapping[str, Any]) -> CentralizedConfig:
    """The recorded hyperparameters of an algorithm, with ``overrides``.

    An override of ``model`` changes the arguments it names and leaves the others.

    Raises:
        ConfigError: naming every unknown or invalid hyperparameter.
    """
    block = read_blocks(FOLDER / f"{algorithm}.yaml")[SETTING]
    merged = {**block, **overrides, "model": {**block["model"], **overrides.get("model", {})}}
    config = validate(CentralizedConfig, merged, f"hyperparameters of {algorithm}")
    accepted = set(inspect.signature(algorithm_class(algorithm)).parameters) - {"policy", "env"}
    unknown = sorted(set(config.model) - accepted)
    if unknown:
        known = ", ".join(sorted(accepted))
        problems = [f"model.{name}: unknown name; known: {known}" for name in unknown]
        raise ConfigError(f"hyperparameters of {algorithm}", problems)
    return config


def model_arguments(config: CentralizedConfig) -> dict[str, Any]:
    """The arguments of the library's class, with schedules as functions."""

    def scheduled(value: Any) -> Any | Callable[[float], float]:
        is_schedule = isinstance(value, dict) and set(value) == {"from", "to"}
        return LinearSchedule(**value) if is_schedule else value

    return {name: scheduled(value) for name, value in config.model.items()}
