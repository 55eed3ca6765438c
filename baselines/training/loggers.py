"""Where numbers of a run go beside its files: TensorBoard always, Weights & Biases if asked for."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from importlib import import_module
from types import ModuleType
from typing import Protocol

from torch.utils.tensorboard import SummaryWriter

from baselines.runs.files import read_json, write_json
from baselines.runs.folder import RunFolder
from mbn_marl.errors import ConfigError


class Logger(Protocol):
    """Takes numbers by name."""

    def scalars(self, env_steps: int, values: Mapping[str, float]) -> None:
        """Log finite or infinite numbers at ``env_steps``."""
        ...

    def flush(self) -> None:
        """Whatever was logged survives the end of the process from here on."""
        ...

    def close(self) -> None:
        """The run is finished."""
        ...


class TensorBoard:
    """Events in the run's folder.

    Args:
        folder: the run's folder.
        env_steps: where the run begins or goes on; what lies behind in the folder is hidden.
    """

    def __init__(self, folder: RunFolder, env_steps: int) -> None:
        self._board = SummaryWriter(folder.path / "tensorboard", purge_step=env_steps + 1)

    def scalars(self, env_steps: int, values: Mapping[str, float]) -> None:
        """Log numbers."""
        for name, value in values.items():
            self._board.add_scalar(name, value, env_steps)

    def flush(self) -> None:
        """Write what is buffered."""
        self._board.flush()

    def close(self) -> None:
        """Close the events' file."""
        self._board.close()


class WeightsAndBiases:
    """A run of a project of Weights & Biases.

    A run that was interrupted goes on in the same one: its id is in the folder's ``wandb.json``.
    What is repeated since the checkpoint is not logged twice, since steps only go up there.

    Args:
        folder: the run's folder.
        name: of the run.
        project: of the user.

    Raises:
        ConfigError: the package is not installed.
    """

    def __init__(self, folder: RunFolder, name: str, project: str) -> None:
        wandb = find_wandb()
        place = folder.path / "wandb.json"
        if not place.exists():
            write_json(place, {"project": project, "id": uuid.uuid4().hex})
        self._run = wandb.init(
            **read_json(place),
            name=name,
            config=folder.config,
            dir=str(folder.path),
            resume="allow",
        )

    def scalars(self, env_steps: int, values: Mapping[str, float]) -> None:
        """Log numbers."""
        self._run.log(dict(values), step=env_steps)

    def flush(self) -> None:
        """The library writes by itself."""

    def close(self) -> None:
        """Mark the run as finished and wait until everything is written."""
        self._run.finish()


def find_wandb() -> ModuleType:
    """The library of Weights & Biases.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return import_module("wandb")
    except ImportError:
        raise ConfigError(
            "training", ["wandb: the package is not installed; pip install wandb, or leave it out"]
        ) from None
