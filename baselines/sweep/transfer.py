"""Setting C as a sweep: a run on one field, and runs on others that begin with its policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.sweep.spec import size_problems
from baselines.training.config import TrainConfig
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field


def transfer_runs(
    config: TrainConfig,
    out: Path,
    fields: Sequence[str],
    *,
    source_steps: int | None,
    resume: bool,
) -> list[TrainConfig]:
    """Return the runs to train: the source's unless it is finished, then one on each field.

    Args:
        config: of the source under setting A, with the budget of the other runs.
        out: the folder of all runs.
        fields: catalogue names or paths.
        source_steps: env-steps of the source; ``None`` for a finished one of any budget, or else
            that of the others.
        resume: continue runs that are there, and leave finished ones.

    Raises:
        ConfigError: no field is named, or one twice, or the policy's own one, or one that the
            policy does not fit.
        RunError: a run is there and ``resume`` is not set; or the source is finished after another
            budget than ``source_steps``.
        MbnError: a field is not valid.
    """
    problems = [] if fields else ["fields: at least one is needed"]
    for field in dict.fromkeys(fields):
        if fields.count(field) > 1:
            problems.append(f"fields: {field} is given twice")
        if load_field(field) == load_field(config.field):
            problems.append(f"fields: {field} is the field that the policy comes from")
    problems += size_problems(config.field, dict.fromkeys(fields))
    if problems:
        raise ConfigError("transfer", problems)
    source = RunFolder(out / config.name)
    runs = [
        replace(config, field=field, setting="C", transferred_from=source.path) for field in fields
    ]
    if not source.finished:
        runs.insert(0, replace(config, steps=source_steps or config.steps))
    elif source_steps not in (None, steps := source.config["steps"]):
        raise RunError(
            f"{source.path} is finished with a budget of {steps:,} env-steps, not "
            f"{source_steps:,}; choose another --out, or leave --source-steps out to take it so"
        )
    there = [out / run.name for run in runs if (out / run.name).exists()]
    if there and not resume:
        names = ", ".join(map(str, there))
        raise RunError(f"{names} already exists; choose another --out, or pass --resume")
    return runs
