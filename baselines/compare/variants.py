"""The subjects of a comparison: algorithms, and variants of them under labels of their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from baselines.training.config import TrainConfig, default_label
from baselines.training.hyperparameters import read_blocks, validate


class Variant(BaseModel):
    """A way to train.

    Attributes:
        algorithm: a name of :data:`baselines.algorithms.ALGORITHMS`.
        setting: one of those it has; C begins with another run, and cannot be compared.
        label: what the comparison calls it; ``None`` for the algorithm's own name.
        hyperparameters: those that differ from the recorded ones.
        environment: settings of the environment that differ from the algorithm's own.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    algorithm: str
    setting: Literal["A", "B", "N"] = "N"
    label: str | None = None
    hyperparameters: dict[str, Any] = Field(default_factory=dict)
    environment: dict[str, Any] = Field(default_factory=dict)

    @property
    def name(self) -> str:
        """The name in tables and figures."""
        return self.label or default_label(self.algorithm, self.setting)

    def training(self, field: str, seed: int, **budget: Any) -> TrainConfig:
        """Its training on a field with a seed; ``budget`` has ``steps`` and the like.

        Raises:
            MbnError: the algorithm is unknown or does not have the setting, or a number is not
                allowed.
        """
        return TrainConfig(field=field, seed=seed, **self.model_dump(), **budget)


def parse_variant(word: str) -> Variant:
    """Read a variant from ``ALGO``, or ``ALGO:SETTING`` for another setting than N.

    Raises:
        ConfigError: naming an unknown setting and what is allowed.
    """
    name, colon, setting = word.partition(":")
    values = {"algorithm": name, "setting": setting if colon else "N"}
    return validate(Variant, values, "comparison")


def read_variants(path: Path) -> tuple[Variant, ...]:
    """Read variants from a YAML file: a block for each, under its label.

    Raises:
        ConfigError: the file cannot be read, or naming every value of a block that is not valid.
    """
    return tuple(
        validate(Variant, {**block, "label": str(label)}, f"{path}: {label}")
        for label, block in read_blocks(path).items()
    )
