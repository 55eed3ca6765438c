"""One training run, from a configuration to a finished run folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from baselines.algorithms import find_algorithm
from baselines.hyperparameters import Hyperparameters
from baselines.progress import Listener
from baselines.recorder import Recorder
from baselines.runs import RunFolder, Task, TrainConfig
from mbn_marl.config import make_config
from mbn_marl.field import catalogue_names, load_field


def train(
    config: TrainConfig,
    out: Path,
    *,
    command: str | None = None,
    force: bool = False,
    listener: Listener = lambda report: None,
) -> RunFolder:
    """Train one policy and evaluate it.

    Everything is checked before the folder is made. Torch runs on one thread: the networks are
    small, and comparisons run one process per core.

    Args:
        config: what to train.
        out: the run folder to make.
        command: the exact command, recorded in the folder; by default the equivalent one.
        force: move a folder that is already there aside.
        listener: is told where the run stands.

    Raises:
        MbnError: the algorithm, the field, a setting or a hyperparameter is not valid, or ``out``
            already holds something.
    """
    import torch

    torch.set_num_threads(1)
    algorithm = find_algorithm(config.algorithm)
    hyperparameters = resolve_hyperparameters(config)
    settings = {**hyperparameters.environment, **config.environment}
    task = Task(config, load_field(config.field), settings)
    folder = RunFolder.create(
        out,
        resolve(task, hyperparameters),
        task.field,
        command or config.command,
        force=force,
    )
    algorithm.train(task, hyperparameters, Recorder(folder, task, listener))
    return folder


def resolve_hyperparameters(config: TrainConfig) -> Hyperparameters:
    """The hyperparameters of a run: the recorded ones, with what the request says instead.

    Raises:
        ConfigError: naming every unknown or invalid hyperparameter.
    """
    hyperparameters: Hyperparameters = find_algorithm(config.algorithm).resolve(
        config.hyperparameters,
        setting=config.setting,
        num_envs=config.num_envs,
        file=config.hyperparams,
    )
    return hyperparameters


def resolve(task: Task, hyperparameters: Hyperparameters) -> Mapping[str, Any]:
    """The resolved configuration of a run, with every default written out, as JSON values."""
    field = task.config.field
    file = task.config.hyperparams
    return {
        **asdict(task.config),
        "hyperparams": None if file is None else str(file.resolve()),
        "field": field if field in catalogue_names() else str(Path(field).resolve()),
        "environment": make_config(task.settings).model_dump(mode="json"),
        "hyperparameters": hyperparameters.model_dump(mode="json"),
    }
