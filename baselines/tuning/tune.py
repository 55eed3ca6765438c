"""A study from its beginning, or from where it was interrupted, to the file for setting B."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from uuid import uuid4

import yaml
from optuna import Study
from optuna.trial import TrialState

from baselines.algorithms import find_algorithm
from baselines.paper.report import draw_study
from baselines.runs.files import (
    RunError,
    alone,
    claim_folder,
    differences,
    read_json,
    write_json,
    write_text,
)
from baselines.runs.provenance import write_provenance
from baselines.sweep.processes import Failure
from baselines.sweep.run import Engine
from baselines.training.train import found_anywhere
from baselines.tuning.study import (
    CONFIG,
    DATABASE,
    begin_study,
    ended,
    importances,
    open_study,
    resume_study,
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
    engine: Engine,
    command: str,
    database: str | None = None,
    resume: bool = False,
    force: bool = False,
    listener: Callable[[News], None] = lambda news: None,
) -> Path:
    """Run a study in the folder ``out``; return the YAML file with the best values as setting B.

    It ends when ``trials`` (> 0) are finished or pruned, with those from before. A journal in
    ``out`` keeps them, or the database at a URL, which all machines of a Ray cluster have to see.
    ``out`` records the exact command; ``force`` moves a folder that is there aside, ``resume``
    continues its study and runs an interrupted trial again. ``listener`` receives where they stand.

    Raises:
        ConfigError: ``trials`` is below 1, or the study in ``out`` tunes something else; or
            ``force`` with a ``database``, where the study would keep its name.
        RunError: ``out`` holds something already, no study to resume, or one that is running; or
            no trial was finished; or the database refuses the study.
        MbnError: there is no Ray cluster.
    """
    problems = [f"trials: must be at least 1 (got {trials})"] if trials < 1 else []
    if force and database is not None:
        problems.append("force: allowed without --database; choose another --out")
    if problems:
        raise ConfigError("tuning", problems)
    asked = {**asdict(config), DATABASE: database}
    if resume:
        open_study(out)
        if changed := differences(read_json(out / CONFIG), asked):
            raise ConfigError(str(out), changed)
    else:
        claim_folder(out, force=force)
        begin_study(out, database)
        write_json(out / CONFIG, asked)
        write_provenance(out, command)
    with alone(out, "mbn tune", "; --processes runs trials side by side"):
        study = resume_study(out)
        first = (out / "command.txt").read_text().strip()
        same = replace(config, field=found_anywhere(config.field))
        jobs = [
            TrialJob(same, out.resolve(), database, first, uuid4().hex)
            for _ in range(trials - len(ended(study)))
        ]
        engine.run(run_trial, jobs, listener, _stop_at_a_failure)
        return _write_results(study, config, out)


def _stop_at_a_failure(job: TrialJob, result: Failure | None) -> None:
    if result is not None:
        raise RunError(result.error)


def _write_results(study: Study, config: TuneConfig, folder: Path) -> Path:
    """Write the table, the figure and the file for setting B: setting A's with the tuned values."""
    write_text(folder / "trials.csv", trials_csv(study))
    write_json(folder / "importances.json", dict(importances(study)))
    if not study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
        raise RunError(
            f"{folder}: no trial finished, all {len(ended(study))} were pruned or diverged; see "
            "trials.csv, and continue with --resume and more --trials"
        )
    save(draw_study(folder), folder / "study.png")
    path = folder / f"{config.algorithm}.yaml"
    best = study.best_trial
    hyperparameters = find_algorithm(config.algorithm).resolve(
        {"model": best.params}, setting=BASE, num_envs=config.num_envs
    )
    source = (
        f"mbn tune {config.algorithm}: trial {best.number}, the best of {len(ended(study))}, on "
        f"{config.field} with {config.steps:,} env-steps a trial; mean return of "
        f"{config.episodes} fresh episodes {best.value:,.0f}"
    )
    values = hyperparameters.model_dump(mode="json", exclude={"skipped"})
    block = {"B": {**values, "source": source}}
    write_text(path, yaml.safe_dump(block, sort_keys=False, width=100))
    return path
