"""One training run, from a configuration to a finished run folder."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from baselines.algorithms import find_algorithm
from baselines.runs.files import RunError, alone, claim_folder
from baselines.runs.folder import RunFolder
from baselines.training.config import DivergenceError, Task, TrainConfig
from baselines.training.hyperparameters import Hyperparameters
from baselines.training.loggers import find_wandb
from baselines.training.progress_bar import Listener
from baselines.training.run_logger import Recorder
from mbn_marl.config import make_config
from mbn_marl.errors import ActionError, ConfigError, MbnError, collecting
from mbn_marl.field import Field, load_field


def train(
    config: TrainConfig,
    out: Path,
    *,
    command: str | None = None,
    force: bool = False,
    resume: bool = False,
    wandb: str | None = None,
    listener: Listener = lambda report: None,
) -> RunFolder:
    """Train one policy and evaluate it.

    Everything is checked before the folder is made. The folder is locked during the run. Torch has
    one thread until the end: the networks are small, and comparisons run one process per core.

    Args:
        config: what to train.
        out: the run folder to make.
        command: the exact command, recorded in the folder; by default the equivalent one.
        force: move a folder that is already there aside.
        resume: continue the interrupted run in ``out``, which must be of the same configuration,
            from its newest checkpoint. A finished one is left as it is.
        wandb: a project of Weights & Biases to log to as well.
        listener: receives where the run stands.

    Raises:
        MbnError: the algorithm, the field, a setting or a hyperparameter is not valid; or ``out``
            already holds something, or with ``resume`` no such run, or one that is running.
        RunError: a file could not be written; what was saved before is as it was.
        DivergenceError: the learner's numbers are no longer finite.
        KeyboardInterrupt: naming the folder, its checkpoint and ``--resume``.
    """
    import torch

    if config.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("training", ["device: torch finds no GPU here; allowed: cpu"])
    if wandb is not None:
        find_wandb()
    algorithm = find_algorithm(config.algorithm)
    task, hyperparameters = prepare(config)
    resolved, command = resolve(task, hyperparameters), command or config.command
    if resume:
        RunFolder.open(out)
    else:
        algorithm.check(task, hyperparameters)
        claim_folder(out, force=force)
    run = RunFolder(out)
    with _one_thread(), _interruption_named(run), _writing_named(run), alone(out, "mbn train"):
        if resume:
            folder = RunFolder.resume(out, resolved, task.field, command)
        else:
            folder = RunFolder.create(out, resolved, task.field, command)
        if not folder.finished:
            with _divergence_named(folder):
                algorithm.train(task, hyperparameters, Recorder(folder, task, listener, wandb))
    return folder


def notes(config: TrainConfig) -> list[str]:
    """What a user should know before a run: skipped hyperparameters, and a budget rounded up.

    Raises:
        MbnError: as :func:`prepare`.
    """
    task, hyperparameters = prepare(config)
    name, steps = config.algorithm, config.steps
    lines = [
        f"skipped: {argument} = {value}, since {name} has no such argument"
        for argument, value in hyperparameters.skipped.items()
    ]
    budget = find_algorithm(name).budget(task, hyperparameters)
    if budget.env_steps > steps:
        bound = "" if budget.exact else "up to "
        lines.append(
            f"steps: {name} learns from whole {budget.unit}, so this run takes "
            f"{bound}{budget.env_steps:,} env-steps, not {steps:,}"
        )
    return lines


def prepare(config: TrainConfig) -> tuple[Task, Hyperparameters]:
    """Load and resolve what a trainer gets; nothing is made yet.

    Raises:
        MbnError: the field, a setting, a hyperparameter or the run to begin with is not valid.
    """
    problems: list[str] = []
    with collecting(problems):
        make_config(config.environment)
    with collecting(problems):
        hyperparameters = resolve_hyperparameters(config)
    if problems:
        raise ConfigError("training", problems)
    settings = {**hyperparameters.environment, **config.environment}
    make_config(settings)
    task = Task(config, load_field(config.field), settings)
    check_source(task, hyperparameters)
    return task, hyperparameters


@contextmanager
def _one_thread() -> Iterator[None]:
    """Give torch one thread, and afterwards as many as before."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def _interruption_named(folder: RunFolder) -> Iterator[None]:
    """Say where a run that the user interrupts can be resumed."""
    try:
        yield
    except KeyboardInterrupt:
        unfinished = folder.unfinished if (folder.path / "config.json").is_file() else None
        if unfinished is None:
            raise
        raise KeyboardInterrupt(f"{folder.path} is {unfinished}; continue with --resume") from None


@contextmanager
def _divergence_named(folder: RunFolder) -> Iterator[None]:
    """Turn what numbers that are not finite cause in a learner or the engine into one error.

    Raises:
        DivergenceError: naming the run.
    """
    try:
        yield
    except ValueError as error:
        if isinstance(error, MbnError) and not isinstance(error, ActionError):
            raise
        what = str(error).splitlines()[0]
        raise DivergenceError(
            f"{folder.path}: the learner diverged: its numbers are most likely no longer finite; a "
            f"smaller learning rate may help ({what})"
        ) from error


@contextmanager
def _writing_named(folder: RunFolder) -> Iterator[None]:
    """Turn what a full disk or a folder without permission causes into one error.

    Raises:
        RunError: naming the run, and where it can be resumed.
    """
    hook = threading.excepthook

    def quiet(arguments: threading.ExceptHookArgs) -> None:
        """Say nothing of what TensorBoard's thread passes to its next call, which raises it."""
        if not isinstance(arguments.exc_value, OSError):
            hook(arguments)

    threading.excepthook = quiet
    try:
        yield
    except (ConnectionError, InterruptedError):  # not about files
        raise
    except OSError as error:
        raise RunError(
            f"{folder.path} could not be written to ({error}); what was saved before is as it was: "
            f"--resume continues from {folder.saved_steps:,} env-steps"
        ) from error
    finally:
        threading.excepthook = hook


def resolve_hyperparameters(config: TrainConfig) -> Hyperparameters:
    """The hyperparameters of a run: the recorded ones, with those of the request instead.

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


def sizes(theirs: Field, ours: Field) -> dict[str, tuple[Any, Any]]:
    """By name, what must be equal in two fields for a policy of one to act in the other."""
    return {
        "robots": (len(theirs.starts), len(ours.starts)),
        "ROIs": (len(theirs.rois), len(ours.rois)),
        "arena": (theirs.arena, ours.arena),
    }


def check_source(task: Task, hyperparameters: Hyperparameters) -> None:
    """Check that the run that a task begins with, if there is one, fits it.

    Raises:
        RunError: there is no such run, or it is not finished.
        ConfigError: naming everything in which it differs.
    """
    if task.config.transferred_from is None:
        return
    source = RunFolder.open(task.config.transferred_from)
    if not source.finished:
        raise RunError(f"{source.path} is not finished; resume it first (--resume)")
    config, field = source.config, source.field
    asked = hyperparameters.model_dump(mode="json")
    recorded = {**config["hyperparameters"], "num_envs": asked["num_envs"]}
    environment = make_config(task.settings).model_dump(mode="json")
    compared = {
        "algorithm": (config["algorithm"], task.config.algorithm),
        **sizes(field, task.field),
        "environment": (config["environment"], environment),
        **{
            f"hyperparameters.{name}": (recorded.get(name), value)
            for name, value in asked.items()
            if name != "source"
        },
    }
    problems = [
        f"{name}: the policy's run has {theirs}, this run {ours}"
        for name, (theirs, ours) in compared.items()
        if theirs != ours
    ]
    if problems:
        raise ConfigError(f"from: {source.path}", problems)


def found_anywhere(field: str) -> str:
    """A field's name, or its path from the root: as another working directory needs it."""
    return str(Path(field).resolve()) if Path(field).is_file() else field


def resolve(task: Task, hyperparameters: Hyperparameters) -> Mapping[str, Any]:
    """The resolved configuration of a run, with every default written out, as JSON values."""
    paths = {
        name: None if (path := getattr(task.config, name)) is None else str(path.resolve())
        for name in ("hyperparams", "transferred_from")
    }
    return {
        **asdict(task.config),
        **paths,
        "field": found_anywhere(task.config.field),
        "environment": make_config(task.settings).model_dump(mode="json"),
        "hyperparameters": hyperparameters.model_dump(mode="json"),
    }
