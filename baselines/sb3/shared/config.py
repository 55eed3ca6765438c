"""The hyperparameters of shared-policy PPO: ``hyperparameters.yaml``, the same for both bridges."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from baselines.sb3.config import CentralizedConfig, read

SOURCE = Path(__file__).with_name("hyperparameters.yaml")
LEARNER = "ppo"
"""The library's class, as :data:`baselines.sb3.config.CLASSES` names it."""


def load(
    algorithm: str,
    setting: str,
    overrides: Mapping[str, Any],
    *,
    num_envs: int | None = None,
    file: Path | None = None,
) -> CentralizedConfig:
    """The hyperparameters of ``"ppo-shared"`` or ``"ppo-supersuit"``, with ``overrides``.

    Args:
        algorithm: its name; both have the same.
        setting: ``"N"``, their only one.
        overrides: values by name, instead of the recorded ones.
        num_envs: worlds side by side, instead of the recorded number.
        file: a YAML file whose block of the setting takes the place of the recorded one.

    Raises:
        ConfigError: naming every unknown or invalid hyperparameter.
    """
    place = f"hyperparameters of {algorithm}" if file is None else str(file)
    return read(file or SOURCE, setting, LEARNER, overrides, num_envs, place)
