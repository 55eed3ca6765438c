"""Setting C: a policy trained on one field goes on learning on others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.sweep.processes import Job
from baselines.training.config import TrainConfig
from baselines.training.progress_bar import Listener
from baselines.training.train import sizes, train
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field


def find_source(
    config: TrainConfig,
    out: Path,
    *,
    any_steps: bool,
    resume: bool,
    listener: Listener,
    trust: bool = False,
) -> RunFolder:
    """The finished run that the others begin with; it is trained if it is not there yet.

    Args:
        config: of that run.
        out: the folder of all runs; one of the run's name that is finished there is taken.
        any_steps: take a finished one whatever its budget was.
        resume: if it is there but not finished, go on with it.
        listener: is told where it stands.
        trust: load pickled files of its folder whoever made them.

    Raises:
        RunError: it is there, not finished, and ``resume`` is not set; or it is finished after
            another budget, and ``any_steps`` is not set.
    """
    path = out / config.name
    there = path.is_dir() and any(path.iterdir())
    if not there:
        return train(config, path, listener=listener)
    run = RunFolder.open(path)
    if run.finished:
        steps = run.config["steps"]
        if not any_steps and steps != config.steps:
            raise RunError(
                f"{path} is finished with a budget of {steps:,} env-steps, not {config.steps:,}; "
                "choose another --out, or leave --source-steps out to take it as it is"
            )
        return run
    if not resume:
        raise RunError(f"{path} is not finished; pass --resume to go on with it")
    return train(config, path, resume=True, trust=trust, listener=listener)


def transfer_runs(config: TrainConfig, source: Path, fields: Sequence[str]) -> list[TrainConfig]:
    """The runs of setting C: as ``config``, from the policy of the run ``source``.

    Raises:
        ConfigError: no field is named, or one twice, or the policy's own one.
        MbnError: a field is not valid.
    """
    problems = [] if fields else ["fields: at least one is needed"]
    for field in dict.fromkeys(fields):
        if fields.count(field) > 1:
            problems.append(f"fields: {field} is given twice")
        if load_field(field) == load_field(config.field):
            problems.append(f"fields: {field} is the field that the policy comes from")
    if problems:
        raise ConfigError("transfer", problems)
    return [replace(config, field=field, setting="C", transferred_from=source) for field in fields]


def check_sizes(source: str, fields: Sequence[str]) -> None:
    """Whether a policy of the field ``source`` fits the others, before it is trained.

    Raises:
        ConfigError: naming every field that it does not fit.
    """
    theirs = load_field(source)
    problems = [
        f"{field}: {name} {ours}; allowed: {theirs_}, as {source} has"
        for field in fields
        for name, (theirs_, ours) in sizes(theirs, load_field(field)).items()
        if theirs_ != ours
    ]
    if problems:
        raise ConfigError("transfer", problems)


def transfer_jobs(
    runs: Sequence[TrainConfig], out: Path, *, resume: bool, trust: bool = False
) -> list[Job]:
    """The runs of setting C, each in a folder of its own under ``out``.

    Args:
        runs: of :func:`transfer_runs`.
        out: the folder of all runs.
        resume: go on with those that are there, and leave finished ones.
        trust: load pickled files whoever made them.

    Raises:
        RunError: a run's folder is there and ``resume`` is not set.
    """
    paths = [out / run.name for run in runs]
    there = [path.exists() for path in paths]
    if any(there) and not resume:
        first = paths[there.index(True)]
        raise RunError(f"{first} already exists; choose another --out, or pass --resume")
    return [
        Job(run, path, seen, trust=trust)
        for run, path, seen in zip(runs, paths, there, strict=True)
    ]
