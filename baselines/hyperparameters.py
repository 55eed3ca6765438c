"""Hyperparameters are data: YAML blocks, validated into frozen models."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from mbn_marl.config import describe
from mbn_marl.errors import ConfigError


class Hyperparameters(BaseModel):
    """What every algorithm's hyperparameters have.

    Attributes:
        environment: the algorithm's own settings of the environment.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    environment: dict[str, Any]


Model = TypeVar("Model", bound=Hyperparameters)


def read_blocks(path: Path) -> dict[str, Any]:
    """Read a YAML file of named blocks."""
    blocks: dict[str, Any] = yaml.safe_load(path.read_text())
    return blocks


def validate(model: type[Model], values: Mapping[str, Any], source: str) -> Model:
    """Validate ``values``.

    Raises:
        ConfigError: naming every unknown or invalid hyperparameter and what is allowed.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise ConfigError(source, describe(error, model)) from None
