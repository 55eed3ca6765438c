"""The log of a training: progress rows, fresh evaluations, policies, the progress bar."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from baselines.evaluation.evaluate import EVALUATION_SEED, Evaluation, evaluate
from baselines.evaluation.intervals import passes
from baselines.evaluation.policy import TrainedPolicy
from baselines.runs.files import read_json, write_json
from baselines.runs.folder import RunFolder
from baselines.training.config import Task
from baselines.training.loggers import Logger, TensorBoard, WeightsAndBiases
from baselines.training.progress_bar import Listener, Report


class EpisodeWindow:
    """Training episodes that ended since the last progress row.

    Their mean is optimistic as a measure of a policy, since stuck worlds finish rarely; that is
    why every result is taken from fresh evaluations instead.
    """

    def __init__(self) -> None:
        self._returns: list[float] = []
        self._successes: list[float] = []

    def add(self, returns: Iterable[float], successes: Iterable[float]) -> None:
        """Add ended episodes: true team returns, and 1 for success or 0."""
        self._returns += map(float, returns)
        self._successes += map(float, successes)

    def pop(self) -> dict[str, float]:
        """Count, mean, range and success rate since the last call; NaN without any episode."""
        returns = np.asarray(self._returns or [np.nan])
        row = {
            "episodes": float(len(self._returns)),
            "return_mean": float(returns.mean()),
            "return_std": float(returns.std()),
            "return_min": float(returns.min()),
            "return_max": float(returns.max()),
            "success_rate": float(np.mean(self._successes or [np.nan])),
        }
        self._returns.clear()
        self._successes.clear()
        return row


ROW_STEPS = 2048
"""A progress row spans at least so many env-steps, except the last one and one before a fresh
evaluation: a learner that updates every few steps would otherwise write more than it learns."""


CHECKPOINT_SECONDS = 600.0
"""A checkpoint is due after every fresh evaluation, and after so many seconds of slow training."""


MEAN_ACTION_NAMES = ("return_mean", "success_rate")
"""What the history of evaluations has of those with mean actions, as ``deterministic_...``."""


class Recorder:
    """Records one run in its folder, from the start or from the newest checkpoint there.

    The training clock runs between :meth:`start` and the end, and stands still during evaluations
    and while files are written, so ``seconds`` are seconds of training alone; ``wall_seconds`` are
    seconds since the first :meth:`start`, without the time that an interrupted run lay still.

    Args:
        folder: the run's folder.
        task: what is trained; evaluations have its field and settings.
        listener: is told where the run stands after every row.
        wandb: a project of Weights & Biases to log to as well, or ``None``.

    Attributes:
        episodes: the training episodes since the last row.
        checkpoint: the checkpoint that the trainer has to go on from, or ``None``.
        passed: whether a fresh evaluation met the run's criterion for stopping early; the trainer
            then goes straight to :meth:`finish`.
        checkpoint_due: whether the trainer should call :meth:`save_checkpoint` as soon as it is
            between two updates.
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
        state: dict[str, Any] = {
            "env_steps": 0,
            "seconds": 0.0,
            "wall_seconds": 0.0,
            "progress_bytes": 0,
            "evaluations": [],
        }
        if self.checkpoint is not None:
            state = read_json(self.checkpoint / "recorder.json")
        self._last_row: int = state["env_steps"]
        self._seconds: float = state["seconds"]
        self._saved_at = self._seconds
        self._wall_seconds: float = state["wall_seconds"]
        self._started_at = 0.0
        self._wall_started_at: float | None = None
        self._evaluations: list[dict[str, Any]] = state["evaluations"]
        folder.cut_progress(state["progress_bytes"])
        write_json(folder.path / "evaluations.json", self._evaluations)
        self._loggers: list[Logger] = [TensorBoard(folder, self._last_row)]
        if wandb is not None:
            self._loggers.append(WeightsAndBiases(folder, task.config.name, wandb))

    def start(self) -> None:
        """Start the training clock: the libraries are imported, the engine is compiled."""
        self._started_at = time.perf_counter()
        if self._wall_started_at is None:
            self._wall_started_at = self._started_at

    def update(
        self, env_steps: int, policy: TrainedPolicy, diagnostics: Mapping[str, float]
    ) -> None:
        """Report an update of the learner; takes a fresh evaluation when one is due.

        Args:
            env_steps: env-steps so far.
            policy: the current policy.
            diagnostics: numbers of the learner for ``progress.csv``, the same names every time.
        """
        self._diagnostics = diagnostics
        every, last = self._task.config.evaluate_every, env_steps >= self._task.config.steps
        evaluation_due = env_steps // every > self._last_row // every and not last
        if env_steps - self._last_row < ROW_STEPS and not evaluation_due:
            return
        self._write_row(env_steps)
        if evaluation_due:
            number = 1 + len(self._evaluations)
            sampled = self._fresh(policy, deterministic=False, number=number)
            mean = self._glance(policy, number)
            self._note(env_steps, sampled, mean)
            self.passed = self._passes(sampled, mean)
        slow = self._seconds - self._saved_at >= CHECKPOINT_SECONDS
        due = self.checkpoint_due or evaluation_due or slow
        self.checkpoint_due = due and not (last or self.passed)
        if not last:
            self._tell(env_steps)
        self.start()

    def save_checkpoint(
        self, env_steps: int, policy: TrainedPolicy, save: Callable[[Path], None]
    ) -> None:
        """Write a checkpoint; no step may have been taken since the last :meth:`update`.

        Args:
            env_steps: env-steps so far.
            policy: the current policy.
            save: writes what the trainer needs to go on into a folder.
        """
        self._stop()
        for logger in self._loggers:
            logger.flush()
        with self._folder.new_checkpoint(env_steps) as folder:
            policy.save(folder / "policy")
            save(folder)
            state = {
                "env_steps": env_steps,
                "seconds": self._seconds,
                "wall_seconds": self._wall(),
                "progress_bytes": self._folder.progress_bytes,
                "evaluations": self._evaluations,
            }
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
        stochastic = self._fresh(policy, deterministic=False, number=0)
        deterministic = self._fresh(policy, deterministic=True, number=0)
        self._note(env_steps, stochastic, deterministic)
        for logger in self._loggers:
            logger.close()
        result = {
            "env_steps": env_steps,
            "seconds": self._seconds,
            "wall_seconds": self._wall(),
            "stochastic": stochastic.to_json(),
            "deterministic": deterministic.to_json(),
        }
        self._folder.finish(result)
        self._tell(env_steps, finished=True)

    def scalars(self, env_steps: int, values: Mapping[str, float]) -> None:
        """Write numbers to the loggers alone, not to ``progress.csv``."""
        for logger in self._loggers:
            logger.scalars(env_steps, values)

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

    def _wall(self) -> float:
        """Seconds since the first start."""
        assert self._wall_started_at is not None
        return self._wall_seconds + time.perf_counter() - self._wall_started_at

    def _note(self, env_steps: int, sampled: Evaluation, mean: Evaluation) -> None:
        """Append an evaluation, with sampled and with mean actions, to the history."""
        entry = {
            "env_steps": env_steps,
            "seconds": self._seconds,
            "wall_seconds": self._wall(),
            **sampled.summary(),
            **{f"deterministic_{name}": mean.summary()[name] for name in MEAN_ACTION_NAMES},
        }
        self._evaluations.append(entry)
        names = ("return_mean", "success_rate", "collision_rate", "rois_visited")
        self.scalars(env_steps, {f"evaluation/{name}": entry[name] for name in names})
        write_json(self._folder.path / "evaluations.json", self._evaluations)

    def _glance(self, policy: TrainedPolicy, number: int) -> Evaluation:
        """Evaluate mean actions as cheaply as can be: from fixed starts all episodes are equal."""
        random_starts = self._task.settings.get("random_starts", False)
        episodes = self._task.config.episodes if random_starts else 1
        return self._fresh(policy, deterministic=True, number=number, episodes=episodes)

    def _fresh(
        self,
        policy: TrainedPolicy,
        *,
        deterministic: bool,
        number: int,
        episodes: int | None = None,
    ) -> Evaluation:
        """Evaluate with the seed of the evaluation's ``number``; every run has the same seeds."""
        return evaluate(
            policy,
            self._task.field,
            self._task.settings,
            episodes=episodes or self._task.config.episodes,
            deterministic=deterministic,
            seed=EVALUATION_SEED + number,
        )

    def _passes(self, sampled: Evaluation, mean: Evaluation) -> bool:
        """Return whether evaluations meet the run's ``stop_at``."""
        stop_at = self._task.config.stop_at
        return stop_at is not None and passes(
            sampled.summary(), mean.summary()["success_rate"], stop_at
        )

    def _tell(self, env_steps: int, *, finished: bool = False) -> None:
        last = self._evaluations[-1] if self._evaluations else {}
        self._listener(
            Report(
                run=self._task.config.name,
                env_steps=env_steps,
                finished=finished,
                steps_per_second=env_steps / self._seconds if self._seconds else 0.0,
                return_mean=last.get("return_mean"),
                success_rate=last.get("success_rate"),
            )
        )
