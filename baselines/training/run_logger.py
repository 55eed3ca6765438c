"""The log of a training: progress rows, fresh evaluations, policies, checkpoints, bars."""

import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import numpy as np
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
from rich.table import Column
from torch.utils.tensorboard import SummaryWriter

from baselines.console import console
from baselines.evaluation.evaluate import (
    EVALUATION_SEED,
    Evaluation,
    Place,
    evaluate,
    is_one_episode,
    unseen,
)
from baselines.policies.load import load_trained
from baselines.policies.policy import TrainedPolicy
from baselines.runs.files import read_json, reading, write_json
from baselines.runs.folder import RunFolder, saved_at
from baselines.training.config import Task, TrainConfig
from mbn_marl.config import make_config
from mbn_marl.errors import ConfigError
from mbn_marl.field import FieldSampler, load_split
from mbn_marl.field.splits import SEARCH, search_side_by_side

# A progress row spans at least so many env-steps, except the last one and one before a fresh
# evaluation: some learners update every few steps.
ROW_STEPS = 2048
# A checkpoint is due after every fresh evaluation, and after so many seconds of slow training.
CHECKPOINT_SECONDS = 600.0
# The final evaluation has so many times the episodes of one on the way.
FINAL_TIMES = 10
# The folder of the best policy so far in a checkpoint.
BEST = "best"
NO_POLICY = [0.0, 0.0, 0]
# A learner begins if so many env-steps are left for it.
LEAST_STEPS = 655_360


@dataclass(frozen=True)
class Report:
    run: str
    env_steps: int = 0
    finished: bool = False
    # Of training, evaluations excluded.
    steps_per_second: float = 0.0
    # Of the last evaluation, if there was one: share of successes, and their mean length.
    success_rate: float | None = None
    makespan: float | None = None
    # Why the run failed.
    error: str | None = None

    def __str__(self) -> str:
        if self.error is not None:
            return "failed"
        speed = f"{self.steps_per_second:,.0f}/s"
        if self.success_rate is None:
            return speed
        steps = "" if self.makespan is None else f" makespan {self.makespan:.1f}"
        return f"{speed} success {self.success_rate:.0%}{steps}"


Listener = Callable[[Report], None]


@contextmanager
def progress_bars(runs: Iterable[TrainConfig]) -> Iterator[Listener]:
    # Without a terminal (in a log file) each finished run prints one line.
    screen = console()
    # The bar takes the room that the words leave, so that a narrow terminal cuts no number.
    bar = BarColumn(None, table_column=Column(ratio=1))
    name, state = TextColumn("{task.description}"), TextColumn("{task.fields[state]}")
    columns, quiet = (name, bar, TaskProgressColumn(), state), not screen.is_terminal
    with Progress(*columns, console=screen, disable=quiet, expand=True) as progress:
        add, total = progress.add_task, {run.name: run.steps for run in runs}
        tasks = {run: add(run, False, steps, state="waiting") for run, steps in total.items()}

        def show(report: Report) -> None:
            task, done = tasks[report.run], min(report.env_steps, total[report.run])
            progress.start_task(task)
            progress.update(task, completed=done, state=str(report))
            if report.finished or report.error is not None:
                progress.stop_task(task)
            if report.error is not None:
                print(report.error, flush=True)
            elif report.finished and not screen.is_terminal:
                print(f"{report.run}: {report.env_steps:,} steps, {report}", flush=True)

        yield show


def find_wandb() -> ModuleType:
    try:
        return import_module("wandb")
    except ImportError:
        problem = "wandb: the package is not installed; pip install wandb, or leave it out"
        raise ConfigError("training", [problem]) from None


class EpisodeWindow:
    # Their mean is optimistic, since stuck worlds finish rarely: results are of fresh evaluations.
    def __init__(self) -> None:
        self._episodes: list[tuple[float, float]] = []

    def add(self, returns: Iterable[float], successes: Iterable[float]) -> None:
        self._episodes += zip(returns, successes, strict=True)

    def pop(self) -> dict[str, float]:
        count, some = float(len(self._episodes)), self._episodes or [(np.nan, np.nan)]
        (returns, successes), self._episodes = np.array(some, float).T, []
        names = ("mean", "std", "min", "max")
        row = {f"return_{name}": float(getattr(returns, name)()) for name in names}
        return {"episodes": count, **row, "success_rate": float(successes.mean())}


class Recorder:
    """Records the run of a task in its folder, from the start or from the newest checkpoint."""

    # ``listener`` receives the progress after every row. Numbers go to TensorBoard's events too,
    # and to ``wandb``, a project of Weights & Biases.
    def __init__(
        self, folder: RunFolder, task: Task, listener: Listener, wandb: str | None = None
    ) -> None:
        # The training episodes since the last row.
        self.episodes = EpisodeWindow()
        # The checkpoint that the trainer has to resume.
        self.checkpoint = folder.checkpoint
        # Then the trainer should call save_checkpoint as soon as it is between two updates.
        self.checkpoint_due = False
        self._folder, self._task, self._listener = folder, task, listener
        self._budget = task.config.steps
        self._name = task.config.name
        self._diagnostics: Mapping[str, float] = {}
        self._started_at = self._wall_started_at = 0.0
        with reading((self.checkpoint or folder.path) / "recorder.json"):
            state = read_json(self.checkpoint / "recorder.json") if self.checkpoint else {}
            self._last_row = saved_at(self.checkpoint, state["env_steps"]) if self.checkpoint else 0
            self._seconds = self._saved_at = float(state.get("seconds", 0.0))
            self._wall_seconds = float(state.get("wall_seconds", 0.0))
            self._evaluations: list[dict[str, Any]] = list(state.get("evaluations", []))
            # The learners that have ended, and the env-steps that they took.
            self.learner, self.began = int(state.get("learner", 0)), int(state.get("began", 0))
            # The rank of the best policy so far, and its env-steps.
            self._best: list[float] = state.get("best", NO_POLICY)
            # The files of the best policy so far.
            self._kept = TemporaryDirectory()
            if self.checkpoint is not None:
                shutil.copytree(self.checkpoint / BEST, self._kept.name, dirs_exist_ok=True)
            folder.cut_progress(int(state.get("progress_bytes", 0)))
        write_json(folder.path / "evaluations.json", self._evaluations)
        # A resumed run is logged to the same one, whose id is in the folder.
        self._wandb: Any = None
        if wandb is not None:
            library, place = find_wandb(), folder.path / "wandb.json"
            if not place.exists():
                write_json(place, {"project": wandb, "id": uuid.uuid4().hex})
            how = {"name": task.config.name, "config": folder.config, "dir": str(folder.path)}
            self._wandb = library.init(**read_json(place), **how, resume="allow")
        # Events after the checkpoint are hidden: their steps are taken again.
        events = folder.path / "tensorboard"
        self._board = SummaryWriter(events, purge_step=self._last_row + 1)

    def begin(self, task: Task) -> None:
        """Record another learner; it counts its env-steps from 0."""
        self._task = task

    @property
    def left(self) -> int:
        """The env-steps that the learners that have ended have left."""
        return self._budget - self.began

    def has_more(self, env_steps: int, *, begun: bool) -> bool:
        """Return whether a learner has steps left: its part, then all while others would fail."""
        # The next learner begins as soon as a policy is perfect, if enough is left for it. One that
        # is still at the first stage of its curriculum is stuck: the next one does better.
        rest = self.left - env_steps
        needed = self._best[0] < 1.0 or rest < LEAST_STEPS
        return env_steps < self._task.config.steps or (rest > 0 and begun and needed)

    def scalars(self, env_steps: int, values: Mapping[str, float]) -> None:
        """Log numbers of a step of the run: those of all its learners are counted."""
        for name, value in values.items():
            self._board.add_scalar(name, value, env_steps)
        if self._wandb is not None:
            self._wandb.log(dict(values), step=env_steps)

    def start(self) -> None:
        """Start the training clock: the libraries are imported, the engine is compiled."""
        # It is stopped during evaluations and while files are written: "seconds" are seconds of
        # training alone. "wall_seconds" are all but those between an interruption and resumption.
        self._started_at = time.perf_counter()
        self._wall_started_at = self._wall_started_at or self._started_at

    def update(
        self,
        env_steps: int,
        policy: Callable[[], TrainedPolicy],
        diagnostics: Mapping[str, float],
    ) -> None:
        # ``policy`` is called if it is to be evaluated: to make one takes time.
        # ``diagnostics`` are numbers for progress.csv, with the same names every time.
        self._diagnostics = diagnostics
        every, last = self._task.config.evaluate_every, not self.has_more(env_steps, begun=True)
        env_steps += self.began
        evaluation_due = env_steps // every > self._last_row // every and not last
        if env_steps - self._last_row < ROW_STEPS and not evaluation_due:
            return
        self._write_row(env_steps)
        if evaluation_due:
            self._evaluate_on_the_way(env_steps, policy())
        slow = self._seconds - self._saved_at >= CHECKPOINT_SECONDS
        due = self.checkpoint_due or evaluation_due or slow
        self.checkpoint_due = due and not last
        if not last:
            self._report(env_steps, self._evaluations[-1] if self._evaluations else {})
        self.start()

    def save_checkpoint(
        self, env_steps: int, policy: TrainedPolicy, save: Callable[[Path], None]
    ) -> None:
        """Write a checkpoint; no step may have been taken since the last :meth:`update`."""
        # ``save`` writes what the trainer needs to resume into a folder.
        self._stop()
        self._board.flush()
        env_steps += self.began
        with self._folder.new_checkpoint(env_steps) as folder:
            policy.save(folder / "policy")
            shutil.copytree(self._kept.name, folder / BEST)
            save(folder)
            state = {**self._times(env_steps), "learner": self.learner, "began": self.began}
            state |= {"progress_bytes": self._folder.progress_bytes, "best": self._best}
            write_json(folder / "recorder.json", {**state, "evaluations": self._evaluations})
        self.checkpoint_due = False
        self._saved_at = self._seconds
        self.start()

    def finish(self, env_steps: int, policy: TrainedPolicy, *, changed: bool = False) -> None:
        """Record the end of a learner, whose policy may have changed since the last update."""
        self.began += env_steps
        if self.began > self._last_row:
            self._write_row(self.began)
        last = self._evaluations[-1]["env_steps"] if self._evaluations else 0
        if changed and last == self.began:
            self._evaluations.pop()
        if changed or last < self.began:
            self._evaluate_on_the_way(self.began, policy)
        self.checkpoint, self.learner = None, self.learner + 1

    def conclude(self) -> None:
        """Keep the best policy of all learners, and measure it."""
        env_steps = self.began
        with self._folder.new_policy() as place:
            shutil.copytree(self._kept.name, place, dirs_exist_ok=True)
        # The best of several measurements looks better than it is: it is measured again.
        sampled, mean = self._measure(load_trained(self._folder), FINAL_TIMES, EVALUATION_SEED)
        self._board.close()
        if self._wandb is not None:
            self._wandb.finish()
        results = {"stochastic": sampled.to_json(), "deterministic": mean.to_json()}
        kept = {"policy_env_steps": self._best[-1]}
        self._folder.finish({**self._times(env_steps), **kept, **results})
        self._report(env_steps, sampled.summary(), finished=True)

    def _write_row(self, env_steps: int) -> None:
        self._stop()
        row = {"seconds": self._seconds, **self.episodes.pop(), **self._diagnostics}
        self._folder.append_progress({"env_steps": float(env_steps), **row})
        known = {f"training/{name}": value for name, value in row.items() if value == value}
        self.scalars(env_steps, known)
        self._last_row = env_steps

    def _stop(self) -> None:
        self._seconds += time.perf_counter() - self._started_at

    def _times(self, env_steps: int) -> dict[str, Any]:
        wall = self._wall_seconds + time.perf_counter() - self._wall_started_at
        return {"env_steps": env_steps, "seconds": self._seconds, "wall_seconds": wall}

    def _measure(
        self, policy: TrainedPolicy, times: int, seed: int
    ) -> tuple[Evaluation, Evaluation]:
        task, several = self._task, times * self._task.config.episodes
        settings, tier = dict(task.settings), task.config.tier
        place: Place = unseen(task.field, seed)
        if tier is not None:
            split = "test" if times > 1 else "validation"
            if tier == SEARCH:
                place = search_side_by_side(split, make_config(settings).comm_radius)
                settings |= place[0].settings
            else:
                place = load_split(split, tier)
            several = max(1, several // len(place))
        drawn = not is_one_episode(policy, settings, deterministic=True)
        drawn |= isinstance(place, FieldSampler)
        # Without random numbers all episodes with mean actions on a field are the same.
        sampled, mean = (
            evaluate(policy, place, settings, episodes=n, seed=seed, deterministic=deterministic)
            for n, deterministic in ((several, False), (several if drawn else 1, True))
        )
        return sampled, mean

    def _evaluate_on_the_way(self, env_steps: int, policy: TrainedPolicy) -> None:
        # The seed is that of the evaluation's number, in every run the same.
        number = 1 + len(self._evaluations)
        sampled, mean = self._measure(policy, 1, EVALUATION_SEED + number)
        entry = {**self._times(env_steps), **sampled.summary()}
        for name in ("return_mean", "success_rate", "makespan", "gap", "spl"):
            entry[f"deterministic_{name}"] = mean.summary()[name]
        # Policies that never fail come first, then the fast ones.
        rates = entry["success_rate"], entry["deterministic_success_rate"]
        rank = [min(rates), sampled.pace + mean.pace]
        if rank >= self._best[:2]:
            self._best = [*rank, env_steps]
            policy.save(Path(self._kept.name))
        self._evaluations.append(entry)
        names = ("success_rate", "return_mean", "collision_rate", "rois_visited")
        self.scalars(env_steps, {f"evaluation/{name}": entry[name] for name in names})
        write_json(self._folder.path / "evaluations.json", self._evaluations)

    def _report(self, env_steps: int, found: Mapping[str, Any], *, finished: bool = False) -> None:
        speed = env_steps / self._seconds if self._seconds else 0.0
        results = (found.get(name) for name in ("success_rate", "makespan"))
        self._listener(Report(self._name, env_steps, finished, speed, *results))
