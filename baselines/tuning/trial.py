"""The trials of a study: claimed, trained, pruned."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from optuna import Study, Trial, TrialPruned
from optuna.pruners import MedianPruner
from optuna.samplers import TPESampler
from optuna.trial import TrialState

from baselines.progress import Report
from baselines.runs import MOST_SEED, DivergenceError, RunFolder, TrainConfig
from baselines.train import train
from baselines.tuning.space import Space
from baselines.tuning.study import DIVERGED, ended, open_study

State = Literal["running", "finished", "pruned", "diverged"]

BASE: Literal["A"] = "A"
"""The setting whose other hyperparameters the trials have."""


@dataclass(frozen=True)
class TuneConfig:
    """What a study tunes, the same for all its trials.

    Attributes:
        algorithm: one that the paper tuned.
        field: a catalogue name or the path of a field file.
        seed: of every training and of the sampler (0 to 2^32 - 1).
        steps: env-steps of a trial (> 0).
        evaluate_every: env-steps between two fresh evaluations, after which a trial may be pruned.
        episodes: stochastic episodes of an evaluation (> 0).
        num_envs: worlds side by side (> 0).

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
        """The training of a trial with these hyperparameters."""
        return TrainConfig(**asdict(self), setting=BASE, hyperparameters={"model": values})


@dataclass(frozen=True)
class News:
    """Where a trial stands.

    Attributes:
        number: the trial's number.
        state: what it does, or how it ended.
        env_steps: env-steps it has taken.
        return_mean: its last or final return, if there was one.
        values: its hyperparameters.
    """

    number: int
    state: State
    env_steps: int
    return_mean: float | None
    values: dict[str, Any]


def run_trials(
    config: TuneConfig,
    folder: Path,
    total: int,
    lock: AbstractContextManager[Any],
    listener: Callable[[News], None],
) -> None:
    """Run trials until the study of ``folder`` has ``total`` that ended or run.

    Args:
        config: what is tuned.
        folder: the study's.
        total: how many trials, with those from before.
        lock: is held while a trial is claimed, so that processes together run no more.
        listener: is told of every trial.
    """
    study = open_study(folder)
    study.pruner = MedianPruner()
    while (trial := _claim(study, config, total, lock)) is not None:
        _run(study, trial, config, folder / "trials" / f"trial-{trial.number:04d}", listener)


def _claim(
    study: Study, config: TuneConfig, total: int, lock: AbstractContextManager[Any]
) -> Trial | None:
    """The next trial; ``None`` if there are enough.

    The sampler's generator depends on the trial's number: no process, and no later one that goes on
    with the study, draws what another has drawn.
    """
    with lock:
        running = study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
        if len(ended(study)) + len(running) >= total:
            return None
        number = len(study.get_trials(deepcopy=False))
        seed = (config.seed + number) % (MOST_SEED + 1)
        study.sampler = TPESampler(seed=seed, constant_liar=True)
        return study.ask()


def _run(
    study: Study, trial: Trial, config: TuneConfig, out: Path, listener: Callable[[News], None]
) -> None:
    """Train a trial in the run folder ``out``, and tell the study how it ended."""
    values = Space.of(config.algorithm).suggest(trial)
    watch = _Watch(trial, config, out, values, listener)
    try:
        command = (out.parents[1] / "command.txt").read_text().strip()
        run = train(config.training(values), out, command=command, listener=watch)
    except TrialPruned:
        study.tell(trial, state=TrialState.PRUNED)
        listener(watch.news("pruned"))
    except DivergenceError as error:
        trial.set_user_attr(DIVERGED, str(error))
        trial.set_constraint(DIVERGED, 1.0)  # the sampler takes it for the worst that can be
        study.tell(trial, state=TrialState.PRUNED)
        listener(watch.news("diverged"))
    else:
        study.tell(trial, run.evaluation["stochastic"]["return_mean"])
        listener(watch.news("finished"))


class _Watch:
    """Listens to a training, reports its fresh evaluations to the study, and prunes it.

    The evaluations are counted, since the env-steps at which they are made differ from trial to
    trial where an update has no fixed length.
    """

    def __init__(
        self,
        trial: Trial,
        config: TuneConfig,
        out: Path,
        values: dict[str, Any],
        listener: Callable[[News], None],
    ) -> None:
        self._trial = trial
        self._steps = config.steps
        self._run = RunFolder(out)
        self._values = values
        self._listener = listener
        self._seen = 0
        self._env_steps = 0
        self._return: float | None = None

    def __call__(self, report: Report) -> None:
        """Pass on what is new.

        Raises:
            TrialPruned: its best return so far is below the median of the finished trials'.
        """
        self._env_steps = report.env_steps
        new = self._run.evaluations[self._seen :]
        for entry in new:
            self._seen += 1
            self._return = entry["return_mean"]
            self._trial.report(entry["return_mean"], self._seen)
        self._listener(self.news("running"))
        if new and report.env_steps < self._steps and self._trial.should_prune():
            raise TrialPruned

    def news(self, state: State) -> News:
        """Where the trial stands."""
        return News(self._trial.number, state, self._env_steps, self._return, self._values)
