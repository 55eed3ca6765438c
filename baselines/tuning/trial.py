"""The trials of a study: their search space, and how they are claimed, trained, pruned."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from optuna import Trial, TrialPruned
from optuna.pruners import MedianPruner
from optuna.samplers import TPESampler
from optuna.trial import TrialState

from baselines.algorithms import find_algorithm
from baselines.paper import published
from baselines.runs.folder import RunFolder
from baselines.sb3.config import accepted_arguments
from baselines.training.config import MOST_SEED, DivergenceError, TrainConfig
from baselines.training.run_logger import Report
from baselines.training.train import train
from baselines.tuning.study import DIVERGED, load_study
from mbn_marl.errors import MbnError

LOGARITHMIC = {"learning_rate"}
"""Drawn so that each decade is as likely; the paper does not say how it drew."""
BASE: Literal["A"] = "A"
"""The setting whose other hyperparameters the trials have."""
TOKEN = "job"
"""The attribute of a trial that says which job runs it."""


class Space(NamedTuple):
    """The hyperparameters that are tuned for an algorithm.

    Attributes:
        ranges: the lowest and the highest value of each, in the paper's order.
        skipped: what the paper tuned but the library's class does not take.
    """

    ranges: dict[str, tuple[float, float]]
    skipped: tuple[str, ...]

    @classmethod
    def of(cls, algorithm: str) -> Space:
        """The paper's space for ``algorithm``.

        Raises:
            MbnError: the paper did not tune it; the message lists what it tuned.
        """
        find_algorithm(algorithm)
        if algorithm not in published.ALGORITHMS:
            known = ", ".join(published.ALGORITHMS)
            raise MbnError(f"{algorithm} has no ranges to tune it in; those that have: {known}")
        ranges, accepted = published.tuning_ranges(algorithm), accepted_arguments(algorithm)
        return cls(
            {name: ends for name, ends in ranges.items() if name in accepted},
            tuple(name for name in ranges if name not in accepted),
        )

    def suggest(self, trial: Trial) -> dict[str, Any]:
        """A value for each hyperparameter; one whose ends are whole numbers above 1 is whole."""
        values: dict[str, float] = {}
        for name, (low, high) in self.ranges.items():
            if low > 1 and low % 1 == high % 1 == 0:
                values[name] = trial.suggest_int(name, int(low), int(high))
            else:
                values[name] = trial.suggest_float(name, low, high, log=name in LOGARITHMIC)
        return values


@dataclass(frozen=True)
class TuneConfig:
    """The subject of a study, the same for all its trials; see :class:`TrainConfig`.

    A trial may be pruned after each fresh evaluation. The seed is the sampler's too.

    Raises:
        ConfigError: naming every number out of range.
        MbnError: the algorithm or the field is not valid.
    """

    algorithm: str
    field: str
    seed: int
    steps: int
    evaluate_every: int
    episodes: int
    num_envs: int

    def __post_init__(self) -> None:
        """Check everything before the first trial."""
        Space.of(self.algorithm)
        self.training({})

    def training(self, values: dict[str, Any]) -> TrainConfig:
        """Return the training of a trial with these hyperparameters."""
        return TrainConfig(**asdict(self), setting=BASE, hyperparameters={"model": values})


@dataclass(frozen=True)
class News:
    """The progress of a trial: its number, its hyperparameters, and how far it came."""

    number: int
    values: dict[str, Any]
    state: Literal["running", "finished", "pruned", "diverged"] = "running"
    env_steps: int = 0
    return_mean: float | None = None


@dataclass(frozen=True)
class TrialJob:
    """One trial of the study in ``folder`` to run; a job begun again knows its lost trial by name.

    ``database`` is the URL of one that keeps the trials, or ``None`` for the journal in ``folder``.
    """

    config: TuneConfig
    folder: Path
    database: str | None
    command: str
    name: str
    after: None = None  # no job has to wait for another


def run_trial(job: TrialJob, listener: Callable[[News], None]) -> None:
    """Claim the study's next trial, train it, and report its end to the study.

    The sampler's generator depends on the trial's number: no process, and no later one that resumes
    the study, draws what another has drawn. ``listener`` receives where the trial stands.
    """
    study = load_study(job.folder, job.database)
    for lost in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        if lost.user_attrs.get(TOKEN) == job.name:
            study.tell(lost.number, state=TrialState.FAIL)
    study.pruner = MedianPruner()
    trial = study.ask()
    trial.set_user_attr(TOKEN, job.name)
    seed = (job.config.seed + trial.number) % (MOST_SEED + 1)
    study.sampler = TPESampler(seed=seed, constant_liar=True)
    values = Space.of(job.config.algorithm).suggest(trial)
    out = job.folder / "trials" / f"trial-{trial.number:04d}"
    watch = _Watch(trial, RunFolder(out), job.config.steps, listener, News(trial.number, values))
    try:
        run = train(job.config.training(values), out, command=job.command, listener=watch)
    except TrialPruned:
        study.tell(trial, state=TrialState.PRUNED)
        watch.tell(state="pruned")
    except DivergenceError as error:
        trial.set_user_attr(DIVERGED, str(error))
        trial.set_constraint(DIVERGED, 1.0)  # the sampler takes it for the worst that can be
        study.tell(trial, state=TrialState.PRUNED)
        watch.tell(state="diverged")
    else:
        study.tell(trial, run.evaluation["stochastic"]["return_mean"])
        watch.tell(state="finished")


@dataclass
class _Watch:
    """Listen to a training, report its fresh evaluations to the study, and prune it.

    The evaluations are counted, since the env-steps at which they are made differ from trial to
    trial where an update has no fixed length.
    """

    trial: Trial
    run: RunFolder
    steps: int
    listener: Callable[[News], None]
    news: News
    seen: int = 0

    def __call__(self, report: Report) -> None:
        """Pass on what is new, and prune the trial if it is not worth its time.

        Raises:
            TrialPruned: its best return so far is below the median of the finished trials'.
        """
        new = self.run.evaluations[self.seen :]
        for entry in new:
            self.seen += 1
            self.trial.report(entry["return_mean"], self.seen)
        latest = {"return_mean": new[-1]["return_mean"]} if new else {}
        self.tell(env_steps=report.env_steps, **latest)
        if new and report.env_steps < self.steps and self.trial.should_prune():
            raise TrialPruned

    def tell(self, **changes: Any) -> None:
        """Report what has changed."""
        self.news = replace(self.news, **changes)
        self.listener(self.news)
