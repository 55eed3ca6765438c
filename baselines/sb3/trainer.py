"""The one trainer of Stable-Baselines3's algorithms."""

from __future__ import annotations

import inspect
import math
from contextlib import suppress
from numbers import Real
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from baselines.runs.folder import RunFolder
from baselines.sb3.ars import PopulationSearch
from baselines.sb3.config import SB3Config, algorithm_class
from baselines.sb3.learner import Learner
from baselines.training.config import Budget, Task
from baselines.training.run_logger import ROW_STEPS, EpisodeWindow, Recorder
from mbn_marl.config import make_config
from mbn_marl.errors import ConfigError, MbnError

REFUSALS = (
    *(ArithmeticError, AssertionError, AttributeError, LookupError, MemoryError),
    *(RuntimeError, TypeError, ValueError),
)
"""The errors of the library and torch for arguments that make no learner."""


class Passed(Exception):  # noqa: N818
    """A fresh evaluation met the run's criterion: not every learner can be stopped otherwise."""


class Reporter(BaseCallback):
    """Reports every update to a recorder, and saves between updates when that is due."""

    def __init__(self, recorder: Recorder, learner: Learner) -> None:
        super().__init__()
        self._recorder, self._learner, self._reported = recorder, learner, 0

    def _on_training_start(self) -> None:
        self._recorder.start()
        self._reported = self._learner.env_steps

    def _on_rollout_start(self) -> None:
        self._report()
        if self._recorder.passed:
            raise Passed
        if self._recorder.checkpoint_due:
            learner = self._learner
            self._recorder.save_checkpoint(learner.env_steps, learner.policy, learner.save)
        self._learner.begin_rollout()

    def _on_step(self) -> bool:
        self._learner.count_repeats()
        return True

    def _on_training_end(self) -> None:
        self._report()

    def _report(self) -> None:
        """Report the policy after its last update, with the episodes before it."""
        learner = self._learner
        if (env_steps := learner.env_steps) > self._reported:
            self._recorder.update(env_steps, learner.policy, learner.diagnostics)
            self._reported = env_steps


class ToRecorder(KVWriter):
    """Passes what the library logs to the recorder; a world has ``stride`` rows."""

    def __init__(self, recorder: Recorder, stride: int) -> None:
        self._recorder, self._stride = recorder, stride

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Write the values that are numbers and meant for TensorBoard."""
        values = {
            name: float(value)
            for name, value in key_values.items()
            if "tensorboard" not in key_excluded[name] and isinstance(value, Real)
        }
        self._recorder.scalars(step // self._stride, values)

    def close(self) -> None:
        """Nothing to close: the recorder does."""


def train(task: Task, hyperparameters: SB3Config, recorder: Recorder) -> None:
    """Train on ``task`` for its budget, rounded up to whole rollouts, and evaluate the result.

    The learner is a fresh one, or begins with the policy of another run, or resumes the recorder's
    checkpoint, bit for bit as if it had not been interrupted.
    """
    learner = Learner(task, hyperparameters, recorder.episodes)
    model, stride = learner.model, learner.stride
    if recorder.checkpoint is not None:
        learner.restore(recorder.checkpoint)
    elif task.config.transferred_from is not None:
        learner.begin_with(RunFolder.open(task.config.transferred_from))
    model.set_logger(Logger(None, [ToRecorder(recorder, stride)]))
    log_interval = 4  # episodes, or updates of ARS; below rollouts
    if isinstance(model, OnPolicyAlgorithm):
        log_interval = math.ceil(ROW_STEPS * stride / (model.n_steps * model.n_envs))
    with suppress(Passed):
        model.learn(
            task.config.steps * stride - model.num_timesteps,
            callback=Reporter(recorder, learner),
            log_interval=log_interval,
            reset_num_timesteps=recorder.checkpoint is None,
        )
    recorder.finish(learner.env_steps, learner.policy)


def check(task: Task, hyperparameters: SB3Config) -> None:
    """Check that a learner can be made with these hyperparameters.

    Raises:
        ConfigError: with the library's objection to them.
    """
    try:
        Learner(task, hyperparameters, EpisodeWindow())
    except MbnError:
        raise
    except REFUSALS as error:
        place = task.config.hyperparams or f"hyperparameters of {task.config.algorithm}"
        what = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(str(place), [f"no learner can be made with them: {what}"]) from error


def budget(task: Task, hyperparameters: SB3Config) -> Budget:
    """How many env-steps a run takes, rounded up to whole rollouts."""
    library = algorithm_class(task.config.algorithm)
    known = inspect.signature(library).parameters.values()
    model = {one.name: one.default for one in known} | hyperparameters.model
    steps, worlds = task.config.steps, hyperparameters.num_envs
    if library is PopulationSearch:
        episodes = 2 * model["n_delta"] * model["n_eval_episodes"]
        longest = episodes * make_config(task.settings).max_steps
        return Budget(steps - 1 + longest, f"updates from {episodes} whole episodes", exact=False)
    length = model["n_steps"] if issubclass(library, OnPolicyAlgorithm) else model["train_freq"]
    rounded = hyperparameters.rounded_up(steps, length * worlds)
    return Budget(rounded, f"rollouts of {length} steps in {worlds} worlds")
