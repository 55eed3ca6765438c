"""A study of hyperparameters: Optuna draws, prunes and records the trials."""

import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import optuna
import yaml
from optuna import Study, Trial, TrialPruned
from optuna.storages import JournalStorage, journal
from optuna.trial import FrozenTrial, TrialState
from optuna.visualization import matplotlib as plots

from baselines.algorithms import find_algorithm
from baselines.paper import published
from baselines.runs import files
from baselines.runs.files import RunError, write_provenance, write_text
from baselines.runs.folder import RunFolder
from baselines.sb3.config import accepted_arguments
from baselines.sweep.processes import Failure
from baselines.sweep.run import Engine
from baselines.training.config import MOST_SEED, DivergenceError, TrainConfig
from baselines.training.run_logger import FINAL_TIMES, Report
from baselines.training.train import found_anywhere, train
from mbn_marl.errors import ConfigError, MbnError

JOURNAL = "study.log"
# The entries that a study records of its trainings.
CONFIG = ("algorithm", "field", "seed", "steps", "evaluate_every", "episodes", "num_envs")
# The attribute of a trial whose learner diverged, with its error, and its constraint.
DIVERGED = "diverged"


def tune(
    config: TrainConfig,
    out: Path,
    *,
    trials: int,
    engine: Engine,
    command: str,
    resume: bool = False,
    force: bool = False,
    listener: Callable[[FrozenTrial], None] = lambda trial: None,
) -> Path:
    """Run a study in the folder ``out``; return the YAML file with the best values as setting B."""
    # The trainings are ``config`` under setting A with values that Optuna draws. It ends when so
    # many trials are finished or pruned, with those from before.
    if trials < 1:
        raise ConfigError("tuning", [f"trials: must be at least 1 (got {trials})"])
    search_space(config.algorithm)
    asked = {name: getattr(config, name) for name in CONFIG}
    if resume:
        load_study(out)
        if changed := files.differences(files.read_json(out / "config.json", dict), asked):
            raise ConfigError(str(out), changed)
    else:
        files.claim_folder(out, force=force)
        begin_study(out)
        files.write_json(out / "config.json", asked)
        write_provenance(out, command)

    def end(job: TrialJob, result: FrozenTrial | Failure) -> None:
        if isinstance(result, Failure):
            raise RunError(result.error)
        listener(result)

    with files.alone(out, "mbn tune", "; --processes runs trials side by side"):
        # A killed process may not have written its last line to the end.
        os.truncate(out / JOURNAL, (out / JOURNAL).read_bytes().rfind(b"\n") + 1)
        study = _without_lost_trials(out)
        same = replace(config, field=found_anywhere(config.field))
        job = TrialJob(same, out.resolve(), RunFolder(out).command)
        engine.run(run_trial, [job] * (trials - len(ended(study))), lambda message: None, end)
        return _write_results(_without_lost_trials(out), config, out)


def search_space(algorithm: str) -> dict[str, tuple[float, float]]:
    find_algorithm(algorithm)
    if algorithm not in published.ALGORITHMS:
        known = ", ".join(published.ALGORITHMS)
        raise MbnError(f"{algorithm} has no ranges to tune it in; those that have: {known}")
    ranges, accepted = published.tuning_ranges(algorithm), accepted_arguments(algorithm)
    return {name: ends for name, ends in ranges.items() if name in accepted}


def suggest(trial: Trial, algorithm: str) -> dict[str, Any]:
    """Draw each hyperparameter; one whose ends are whole numbers above 1 is whole."""
    values: dict[str, float] = {}
    for name, (low, high) in search_space(algorithm).items():
        if low > 1 and low % 1 == high % 1 == 0:
            values[name] = trial.suggest_int(name, int(low), int(high))
        else:
            # Each decade of the learning rate is as likely; the paper does not say how it drew.
            values[name] = trial.suggest_float(name, low, high, log=name == "learning_rate")
    return values


def begin_study(folder: Path) -> None:
    optuna.create_study(study_name="study", storage=_storage(folder), direction="maximize")


def load_study(folder: Path) -> Study:
    place = folder / JOURNAL
    if not place.is_file():
        raise RunError(f"{folder} is not the folder of a study: it has no {JOURNAL}")
    try:
        study = optuna.load_study(study_name="study", storage=_storage(folder))
    except Exception as error:  # Optuna's reader raises many kinds
        raise RunError(f"{place} cannot be read: {error!r}") from None
    folders, known = len([*folder.glob("trials/trial-*")]), len(study.get_trials(deepcopy=False))
    if folders > known:
        raise RunError(f"{place} is damaged: it has {known} of {folders} trials")
    return study


def _storage(folder: Path) -> JournalStorage:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return JournalStorage(journal.JournalFileBackend(str(folder / JOURNAL)))


def ended(study: Study) -> list[FrozenTrial]:
    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))


def _without_lost_trials(folder: Path) -> Study:
    """Load a study that nobody runs; trials of processes that were lost have failed."""
    study = load_study(folder)
    for lost in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        study.tell(lost.number, state=TrialState.FAIL)
    return study


@dataclass(frozen=True)
class TrialJob:
    config: TrainConfig
    folder: Path
    command: str


def run_trial(job: TrialJob, report: Callable[[Any], None]) -> FrozenTrial:
    trials: list[FrozenTrial] = []
    load_study(job.folder).optimize(
        lambda trial: _train(job, trial), 1, callbacks=[lambda study, trial: trials.append(trial)]
    )
    return trials[0]


def _train(job: TrialJob, trial: Trial) -> float:
    # The trial's number decides the draws: no process, and no later one, repeats those of another.
    seed = (job.config.seed + trial.number) % (MOST_SEED + 1)
    trial.study.sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True)
    values = suggest(trial, job.config.algorithm)
    out = job.folder / "trials" / f"trial-{trial.number:04d}"
    seen = 0

    def prune(report: Report) -> None:
        nonlocal seen
        new = RunFolder(out).evaluations[seen:]
        for entry in new:
            # Evaluations are counted: their env-steps may differ from trial to trial.
            seen += 1
            trial.report(entry["return_mean"], seen)
        if new and report.env_steps < job.config.steps and trial.should_prune():
            raise TrialPruned

    config = replace(job.config, hyperparameters={"model": values})
    try:
        run = train(config, out, command=job.command, listener=prune)
    except DivergenceError as error:
        trial.set_user_attr(DIVERGED, str(error))
        trial.set_constraint(DIVERGED, 1.0)  # the sampler takes it for the worst that can be
        raise TrialPruned from error
    return float(run.evaluation["stochastic"]["return_mean"])


def _write_results(study: Study, config: TrainConfig, folder: Path) -> Path:
    """Write the table, the figures and the file for setting B: A's with the tuned values."""
    table = study.trials_dataframe(("number", "state", "value", "params", "user_attrs"))
    write_text(folder / "trials.csv", table.to_csv(index=False))
    if not study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
        raise RunError(
            f"{folder}: no trial finished, all {len(ended(study))} were pruned or diverged; see "
            "trials.csv, and continue with --resume and more --trials"
        )
    _draw(study, folder)
    best = study.best_trial
    hyperparameters = find_algorithm(config.algorithm).resolve(
        {"model": best.params}, setting="A", num_envs=config.num_envs
    )
    source = (
        f"mbn tune {config.algorithm}: trial {best.number}, the best of {len(ended(study))}, on "
        f"{config.field} with {config.steps:,} env-steps a trial; mean return of "
        f"{FINAL_TIMES * config.episodes:,} fresh episodes {best.value:,.0f}"
    )
    values = hyperparameters.model_dump(mode="json", exclude={"skipped"})
    block = {"B": {**values, "source": source}}
    path = folder / f"{config.algorithm}.yaml"
    write_text(path, yaml.safe_dump(block, sort_keys=False, width=100))
    return path


def _draw(study: Study, folder: Path) -> None:
    with plt.rc_context(), warnings.catch_warnings(action="ignore"):  # they are experimental
        plots.plot_optimization_history(study, target_name="mean return")
        plt.savefig(folder / "history.png")
        plt.close()
        # PED-ANOVA says how much a hyperparameter decides whether a trial is in the better half, in
        # which Optuna asks for five trials.
        if len(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))) >= 10:
            evaluator = optuna.importance.PedAnovaImportanceEvaluator(target_quantile=0.5)
            plots.plot_param_importances(study, evaluator=evaluator)
            plt.savefig(folder / "importances.png", bbox_inches="tight")
            plt.close()
