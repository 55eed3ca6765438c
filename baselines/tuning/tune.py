"""A study from its beginning, or from where it was interrupted, to the file for setting B."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import yaml
from optuna import Study
from optuna.trial import TrialState

from baselines.algorithms import find_algorithm
from baselines.runs.files import RunError, alone, claim_folder, read_json, write_json, write_text
from baselines.runs.provenance import write_provenance
from baselines.sweep.processes import work_all
from baselines.sweep.ray_cluster import Engine, Needs, connected, work_on_ray
from baselines.training.train import found_anywhere
from baselines.tuning.address import Address
from baselines.tuning.study import (
    CONFIG,
    DATABASE,
    draw_study,
    ended,
    importances,
    open_study,
    put_down,
    take_up,
    trials_csv,
)
from baselines.tuning.trial import BASE, News, TrialJob, TuneConfig, run_trial
from mbn_marl.errors import ConfigError
from mbn_marl.render.figures import save


def tune(
    config: TuneConfig,
    out: Path,
    *,
    trials: int,
    processes: int,
    command: str,
    database: str | None = None,
    engine: Engine = "local",
    address: str | None = None,
    resume: bool = False,
    force: bool = False,
    listener: Callable[[News], None] = lambda news: None,
) -> Path:
    """Run a study, and write what it found.

    Args:
        config: what to tune.
        out: the folder of the study.
        trials: how many that end, finished or pruned, with those from before (> 0).
        processes: under the engine ``"local"`` trials at a time (> 0).
        command: the exact command, recorded when the study begins.
        database: the URL of one that keeps the trials, instead of a journal in ``out``.
        engine: ``"local"``, processes of this machine; or ``"ray"``, a Ray cluster, whose machines
            have to see the journal or the database.
        address: of the Ray cluster; by default that of ``RAY_ADDRESS`` or of this machine.
        resume: go on with the study in ``out``; a trial that was interrupted is run anew.
        force: move a folder that is already there aside.
        listener: is told where the trials stand.

    Returns:
        The YAML file with the best values as setting B.

    Raises:
        ConfigError: a number is out of range, or the study in ``out`` tunes something else.
        RunError: ``out`` holds something already, no study to resume, or one that is at work; or
            no trial was finished; or the database refuses the study.
        MbnError: there is no Ray cluster.
    """
    problems = [
        f"{name}: must be at least 1 (got {value})"
        for name, value in (("trials", trials), ("processes", processes))
        if value < 1
    ]
    if problems:
        raise ConfigError("tuning", problems)
    if resume:
        _check_same({**asdict(config), DATABASE: database}, out)
    else:
        claim_folder(out, force=force)
        Address.of(out, database).begin()
        write_json(out / CONFIG, {**asdict(config), DATABASE: database})
        write_provenance(out, command)
    with alone(out, "mbn tune", "; --processes runs trials side by side"):
        take_up(out)
        study = open_study(out)
        for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            study.tell(trial.number, state=TrialState.FAIL)
        place, first = Address.of(out, database), (out / "command.txt").read_text().strip()
        same = replace(config, field=found_anywhere(config.field))
        jobs = [
            TrialJob(same, place, out.resolve(), first, uuid4().hex)
            for _ in range(trials - len(ended(study)))
        ]
        if engine == "ray":
            with connected(address):
                work_on_ray(run_trial, jobs, listener, Needs())
        elif processes == 1:
            for job in jobs:
                run_trial(job, listener)
        else:
            work_all(run_trial, jobs, processes, listener)
        try:
            return _write_results(study, config, out)
        finally:
            put_down(out)


def _check_same(asked: Mapping[str, Any], folder: Path) -> None:
    """Check that the study of ``folder`` tunes what is asked for."""
    open_study(folder)
    recorded = read_json(folder / CONFIG)
    problems = [
        f"{name}: the study has {recorded.get(name)!r}, not {value!r}"
        for name, value in asked.items()
        if recorded.get(name) != value
    ]
    if problems:
        raise ConfigError(str(folder), problems)


def _write_results(study: Study, config: TuneConfig, folder: Path) -> Path:
    """Write the table, the figure and the file for setting B."""
    write_text(folder / "trials.csv", trials_csv(study))
    write_json(folder / "importances.json", dict(importances(study)))
    if not study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
        raise RunError(
            f"{folder}: no trial finished, all {len(ended(study))} were pruned or diverged; see "
            "trials.csv, and go on with --resume and more --trials"
        )
    save(draw_study(folder), folder / "study.png")
    path = folder / f"{config.algorithm}.yaml"
    text = yaml.safe_dump({"B": block(study, config)}, sort_keys=False, width=100)
    write_text(path, text)
    return path


def block(study: Study, config: TuneConfig) -> dict[str, Any]:
    """The best values as the block of setting B: those of setting A with the tuned ones."""
    best = study.best_trial
    hyperparameters = find_algorithm(config.algorithm).resolve(
        {"model": best.params}, setting=BASE, num_envs=config.num_envs
    )
    source = (
        f"mbn tune {config.algorithm}: trial {best.number}, the best of {len(ended(study))}, on "
        f"{config.field} with {config.steps:,} env-steps a trial; mean return of "
        f"{config.episodes} fresh episodes {best.value:,.0f}"
    )
    values: dict[str, Any] = hyperparameters.model_dump(mode="json", exclude={"skipped"})
    return {**values, "source": source}
