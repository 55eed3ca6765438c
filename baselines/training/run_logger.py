"""The log of a training: progress rows, fresh evaluations, policies, checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from baselines.evaluation.evaluate import EVALUATION_SEED, Evaluation, evaluate, unseen
from baselines.evaluation.intervals import passes
from baselines.policies.policy import TrainedPolicy
from baselines.runs.files import read_json, reading, write_json
from baselines.runs.folder import RunFolder, saved_at
from baselines.training.config import Task
from baselines.training.loggers import Loggers
from baselines.training.progress_bar import Listener, Report
from mbn_marl.config import make_config
from mbn_marl.field import FieldSampler


class EpisodeWindow:
    """Training episodes that ended since the last progress row.

    Their mean is optimistic, since stuck worlds finish rarely: results are of fresh evaluations.
    """

    def __init__(self) -> None:
        self._returns: list[float] = []
        self._successes: list[float] = []

    def add(self, returns: Iterable[float], successes: Iterable[float]) -> None:
        """Add ended episodes: true team returns, and 1 for success or 0."""
        self._returns += map(float, returns)
        self._successes += map(float, successes)

    def pop(self) -> dict[str, float]:
        """Return count, mean, range and success rate since the last call; NaN without episodes."""
        returns = np.asarray(self._returns or [np.nan])
        names = ("mean", "std", "min", "max")
        row = {
            "episodes": float(len(self._returns)),
            **{f"return_{name}": float(getattr(returns, name)()) for name in names},
            "success_rate": float(np.mean(self._successes or [np.nan])),
        }
        self._returns.clear()
        self._successes.clear()
        return row


ROW_STEPS = 2048
"""A progress row spans at least so many env-steps, except the last one and one before a fresh
evaluation: some learners update every few steps."""
CHECKPOINT_SECONDS = 600.0
"""A checkpoint is due after every fresh evaluation, and after so many seconds of slow training."""
MEAN_ACTION_NAMES = ("return_mean", "success_rate")
"""The numbers that the history has of evaluations with mean actions, as ``deterministic_...``."""


class Recorder:
    """Records the run of a task in its folder, from the start or from the newest checkpoint.

    Evaluations have the task's field and settings; ``listener`` receives the progress after every
    row; ``wandb`` is a project of Weights & Biases to log to as well.

    The training clock runs from :meth:`start`, but not during evaluations and while files are
    written: ``seconds`` are seconds of training alone. ``wall_seconds`` are all seconds since the
    first :meth:`start`, without the time between an interruption and its resumption.

    Attributes:
        episodes: the training episodes since the last row.
        checkpoint: the checkpoint that the trainer has to resume, or ``None``.
        passed: whether a fresh evaluation met the run's criterion for stopping early; the trainer
            then goes straight to :meth:`finish`.
        checkpoint_due: whether the trainer should call :meth:`save_checkpoint` as soon as it is
            between two updates.
        scalars: ``scalars(env_steps, values)`` writes numbers to the loggers alone, not to
            ``progress.csv``.
    """

    def __init__(
        self, folder: RunFolder, task: Task, listener: Listener, wandb: str | None = None
    ) -> None:
        self.episodes = EpisodeWindow()
        self.checkpoint = folder.checkpoint
        self.checkpoint_due = False
        self.passed = False
        self._folder = folder
        self._task = task
        self._listener = listener
        self._diagnostics: Mapping[str, float] = {}
        self._started_at = 0.0
        self._wall_started_at: float | None = None
        place = (self.checkpoint or folder.path) / "recorder.json"
        with reading(place):
            state = read_json(place) if self.checkpoint else {}
            self._last_row = 0
            if self.checkpoint:
                self._last_row = saved_at(self.checkpoint, state["env_steps"])
            self._seconds = self._saved_at = float(state.get("seconds", 0.0))
            self._wall_seconds = float(state.get("wall_seconds", 0.0))
            self._evaluations: list[dict[str, Any]] = list(state.get("evaluations", []))
            folder.cut_progress(int(state.get("progress_bytes", 0)))
        write_json(folder.path / "evaluations.json", self._evaluations)
        self._loggers = Loggers(folder, task.config.name, self._last_row, wandb)
        self.scalars = self._loggers.scalars

    def start(self) -> None:
        """Start the training clock: the libraries are imported, the engine is compiled."""
        self._started_at = time.perf_counter()
        if self._wall_started_at is None:
            self._wall_started_at = self._started_at

    def update(
        self, env_steps: int, policy: TrainedPolicy, diagnostics: Mapping[str, float]
    ) -> None:
        """Record an update of the learner; make a fresh evaluation when one is due.

        ``diagnostics`` are numbers for ``progress.csv``, with the same names every time.
        """
        self._diagnostics = diagnostics
        config = self._task.config
        every, last = config.evaluate_every, env_steps >= config.steps
        evaluation_due = env_steps // every > self._last_row // every and not last
        if env_steps - self._last_row < ROW_STEPS and not evaluation_due:
            return
        self._write_row(env_steps)
        if evaluation_due:
            # Without random numbers all episodes with mean actions are the same.
            several = make_config(self._task.settings).is_random
            several = several or isinstance(self._task.field, FieldSampler)
            sampled, mean = self._evaluate(
                env_steps,
                policy,
                number=1 + len(self._evaluations),
                mean_episodes=config.episodes if several else 1,
            )
            self.passed = config.stop_at is not None and passes(
                sampled.summary(), mean.summary()["success_rate"], config.stop_at
            )
        slow = self._seconds - self._saved_at >= CHECKPOINT_SECONDS
        due = self.checkpoint_due or evaluation_due or slow
        self.checkpoint_due = due and not (last or self.passed)
        if not last:
            self._report(env_steps)
        self.start()

    def save_checkpoint(
        self, env_steps: int, policy: TrainedPolicy, save: Callable[[Path], None]
    ) -> None:
        """Write a checkpoint; no step may have been taken since the last :meth:`update`.

        ``save`` writes what the trainer needs to resume into a folder.
        """
        self._stop()
        self._loggers.flush()
        with self._folder.new_checkpoint(env_steps) as folder:
            policy.save(folder / "policy")
            save(folder)
            size = {"progress_bytes": self._folder.progress_bytes}
            state = {**self._times(env_steps), **size, "evaluations": self._evaluations}
            write_json(folder / "recorder.json", state)
        self.checkpoint_due = False
        self._saved_at = self._seconds
        self.start()

    def finish(self, env_steps: int, policy: TrainedPolicy) -> None:
        """Make the final evaluation of the last policy; its file marks the run as finished."""
        if env_steps > self._last_row:
            self._write_row(env_steps)
        with self._folder.new_policy() as place:
            policy.save(place)
        episodes = self._task.config.episodes
        sampled, mean = self._evaluate(env_steps, policy, number=0, mean_episodes=episodes)
        self._loggers.close()
        results = {"stochastic": sampled.to_json(), "deterministic": mean.to_json()}
        self._folder.finish({**self._times(env_steps), **results})
        self._report(env_steps, finished=True)

    def _write_row(self, env_steps: int) -> None:
        """Stop the clock, and write the row of the window since the last one."""
        self._stop()
        row = {"seconds": self._seconds, **self.episodes.pop(), **self._diagnostics}
        self._folder.append_progress({"env_steps": float(env_steps), **row})
        known = {f"training/{name}": value for name, value in row.items() if value == value}
        self.scalars(env_steps, known)
        self._last_row = env_steps

    def _stop(self) -> None:
        """Stop the training clock."""
        self._seconds += time.perf_counter() - self._started_at

    def _times(self, env_steps: int) -> dict[str, Any]:
        """Return the env-steps, the seconds of training and those since the first start."""
        assert self._wall_started_at is not None
        wall = self._wall_seconds + time.perf_counter() - self._wall_started_at
        return {"env_steps": env_steps, "seconds": self._seconds, "wall_seconds": wall}

    def _evaluate(
        self, env_steps: int, policy: TrainedPolicy, *, number: int, mean_episodes: int
    ) -> tuple[Evaluation, Evaluation]:
        """Evaluate with sampled and with mean actions, and append both to the history.

        The seed is that of the evaluation's ``number``, in every run the same.
        """

        def fresh(episodes: int, *, deterministic: bool) -> Evaluation:
            task, seed = self._task, EVALUATION_SEED + number
            how: dict[str, Any] = {"episodes": episodes, "seed": seed}
            fields = unseen(task.field, seed)
            return evaluate(policy, fields, task.settings, deterministic=deterministic, **how)

        sampled = fresh(self._task.config.episodes, deterministic=False)
        mean = fresh(mean_episodes, deterministic=True)
        entry = {
            **self._times(env_steps),
            **sampled.summary(),
            **{f"deterministic_{name}": mean.summary()[name] for name in MEAN_ACTION_NAMES},
        }
        self._evaluations.append(entry)
        names = ("return_mean", "success_rate", "collision_rate", "rois_visited")
        self.scalars(env_steps, {f"evaluation/{name}": entry[name] for name in names})
        write_json(self._folder.path / "evaluations.json", self._evaluations)
        return sampled, mean

    def _report(self, env_steps: int, *, finished: bool = False) -> None:
        last = self._evaluations[-1] if self._evaluations else {}
        speed = env_steps / self._seconds if self._seconds else 0.0
        results = (last.get(name) for name in ("return_mean", "success_rate"))
        self._listener(Report(self._task.config.name, env_steps, finished, speed, *results))
