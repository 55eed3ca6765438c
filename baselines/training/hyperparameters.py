"""Hyperparameters: YAML blocks, validated into frozen models."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mbn_marl.checked import describe
from mbn_marl.errors import ConfigError, FieldError, unknown
from mbn_marl.field.files import parse_yaml


class Hyperparameters(BaseModel):
    """The entries that all hyperparameters have.

    Attributes:
        source: where the numbers come from.
        environment: the algorithm's own settings of the environment.
        skipped: values of the source that the algorithm has no argument for; without effect.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    source: str = Field("", repr=False)
    environment: dict[str, Any] = Field(default_factory=dict)
    skipped: dict[str, Any] = Field(default_factory=dict, repr=False)


Model = TypeVar("Model", bound=BaseModel)


def read_blocks(path: Path) -> dict[str, Any]:
    """Read a YAML file of named blocks; raise a ConfigError if it is none."""
    try:
        data = path.read_bytes()
        blocks = parse_yaml(data, str(path))
    except FieldError as error:
        raise ConfigError(str(path), error.problems) from None
    except OSError as error:
        raise ConfigError(str(path), [f"cannot be read: {error}"]) from None
    if not isinstance(blocks, dict) or not all(isinstance(one, dict) for one in blocks.values()):
        raise ConfigError(str(path), ["must be a mapping from names of blocks to mappings"])
    return blocks


def read_block(path: Path, name: str) -> dict[str, Any]:
    """Read one block of a YAML file; raise a ConfigError if there is none."""
    blocks = read_blocks(path)
    if name not in blocks:
        raise ConfigError(str(path), [f"{name}: {unknown('block', name, map(str, blocks))}"])
    block: dict[str, Any] = blocks[name]
    return block


def validate(model: type[Model], values: Mapping[str, Any], source: str) -> Model:
    """Validate ``values``; raise a ConfigError that names every wrong one and what is allowed."""
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise ConfigError(source, describe(error, model)) from None
