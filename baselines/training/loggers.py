"""Where numbers of a run go beside its files: TensorBoard always, Weights & Biases if asked for."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from importlib import import_module
from types import ModuleType
from typing import Any

from torch.utils.tensorboard import SummaryWriter

from baselines.runs.files import read_json, write_json
from baselines.runs.folder import RunFolder
from mbn_marl.errors import ConfigError


class Loggers:
    """TensorBoard's events in the folder of a run, and a run of Weights & Biases.

    There an interrupted run continues in the same one, whose id is in the folder's ``wandb.json``;
    what is repeated since the checkpoint is not logged twice, since steps only go up.

    Events in the folder after ``env_steps``, where the run begins or resumes, are hidden.

    Raises:
        ConfigError: a project is named, and the package of Weights & Biases is not installed.
    """

    def __init__(self, folder: RunFolder, name: str, env_steps: int, project: str | None) -> None:
        self._run: Any = None
        if project is not None:
            wandb, place = find_wandb(), folder.path / "wandb.json"
            if not place.exists():
                write_json(place, {"project": project, "id": uuid.uuid4().hex})
            self._run = wandb.init(
                **read_json(place),
                name=name,
                config=folder.config,
                dir=str(folder.path),
                resume="allow",
            )
        self._board = SummaryWriter(folder.path / "tensorboard", purge_step=env_steps + 1)

    def scalars(self, env_steps: int, values: Mapping[str, float]) -> None:
        """Log numbers by name."""
        for name, value in values.items():
            self._board.add_scalar(name, value, env_steps)
        if self._run is not None:
            self._run.log(dict(values), step=env_steps)

    def flush(self) -> None:
        """Write what is buffered."""
        self._board.flush()

    def close(self) -> None:
        """Mark the run as finished, and wait until everything is written."""
        self._board.close()
        if self._run is not None:
            self._run.finish()


def find_wandb() -> ModuleType:
    """Return the library of Weights & Biases; raise a ConfigError if it is not installed."""
    try:
        return import_module("wandb")
    except ImportError:
        raise ConfigError(
            "training", ["wandb: the package is not installed; pip install wandb, or leave it out"]
        ) from None
