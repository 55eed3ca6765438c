"""The one trainer of the centralised algorithms: Stable-Baselines3 on the single MDP."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from baselines.evaluation.policy import TrainedPolicy
from baselines.runs.folder import RunFolder
from baselines.sb3.config import CentralizedConfig, algorithm_class, model_arguments
from baselines.sb3.envs import make_env
from baselines.sb3.learner import policy_of, restore, save, transfer
from baselines.training.config import Task
from baselines.training.run_logger import ROW_STEPS, EpisodeWindow, Recorder
from mbn_marl.errors import ConfigError

REFUSALS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What the library and torch raise for arguments that they cannot make a learner from."""


@dataclass(frozen=True)
class Keeping:
    """How a learner is kept, and how its steps are counted.

    Attributes:
        policy_of: the policy of a learner as it is now.
        save: writes what a learner needs to go on, beside its policy, into a folder.
        stride: rows of a world: the library counts a step of each as one.
    """

    policy_of: Callable[[BaseAlgorithm], TrainedPolicy]
    save: Callable[[BaseAlgorithm, Path], None]
    stride: int = 1


class Reporter(BaseCallback):
    """Reports the end of every rollout to a recorder, and saves between updates when that is due.

    Args:
        recorder: where progress goes.
        keeping: of the learner.
    """

    def __init__(self, recorder: Recorder, keeping: Keeping) -> None:
        super().__init__()
        self._recorder = recorder
        self._keeping = keeping

    @property
    def _env_steps(self) -> int:
        return self.num_timesteps // self._keeping.stride

    def _on_training_start(self) -> None:
        self._recorder.start()

    def _on_rollout_start(self) -> None:
        if self._recorder.checkpoint_due:
            self._recorder.save_checkpoint(
                self._env_steps,
                self._keeping.policy_of(self.model),
                lambda folder: self._keeping.save(self.model, folder),
            )

    def _on_step(self) -> bool:
        return not self._recorder.passed

    def _on_rollout_end(self) -> None:
        self._recorder.update(self._env_steps, self._keeping.policy_of(self.model), {})


class ToRecorder(KVWriter):
    """Passes what the library logs on to the recorder's TensorBoard.

    Args:
        recorder: where it goes.
        stride: rows of a world.
    """

    def __init__(self, recorder: Recorder, stride: int) -> None:
        self._recorder = recorder
        self._stride = stride

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Write the values that are numbers and meant for TensorBoard."""
        values: Mapping[str, float] = {
            name: float(value)
            for name, value in key_values.items()
            if "tensorboard" not in key_excluded[name] and isinstance(value, Real)
        }
        self._recorder.scalars(step // self._stride, values)

    def close(self) -> None:
        """Nothing to close: the recorder does."""


def train(task: Task, hyperparameters: CentralizedConfig, recorder: Recorder) -> None:
    """Train on ``task`` for its budget, rounded up to whole rollouts, and evaluate the result.

    The learner is a fresh one, or begins with the policy of another run, or goes on from the
    recorder's checkpoint, bit by bit as if it had not been interrupted.
    """
    env = make_env(task, hyperparameters, recorder.episodes)
    if recorder.checkpoint is not None:
        model = restore(task, env, recorder.checkpoint, trust=recorder.trust)
    elif task.config.transferred_from is not None:
        source = RunFolder.open(task.config.transferred_from, trust=recorder.trust)
        model = transfer(task, env, source)
    else:
        model = make_model(task, hyperparameters, env)
    learn(model, task, recorder, Keeping(policy_of, save))


def learn(model: BaseAlgorithm, task: Task, recorder: Recorder, keeping: Keeping) -> None:
    """Train a learner to the end of the budget, and evaluate the result."""
    stride = keeping.stride
    model.set_logger(Logger(None, [ToRecorder(recorder, stride)]))
    model.learn(
        task.config.steps * stride - model.num_timesteps,
        callback=Reporter(recorder, keeping),
        log_interval=log_interval(model, stride),
        reset_num_timesteps=recorder.checkpoint is None,
    )
    recorder.finish(model.num_timesteps // stride, keeping.policy_of(model))


def check(task: Task, hyperparameters: CentralizedConfig) -> None:
    """Whether a learner can be made with these hyperparameters.

    Raises:
        ConfigError: with what the library says against them.
    """
    env = make_env(task, hyperparameters, EpisodeWindow())
    check_maker(task, lambda: make_model(task, hyperparameters, env))


def check_maker(task: Task, make: Callable[[], BaseAlgorithm]) -> None:
    """Whether ``make`` makes a learner.

    Raises:
        ConfigError: with what the library says against the hyperparameters.
    """
    try:
        make()
    except REFUSALS as error:
        place = task.config.hyperparams or f"hyperparameters of {task.config.algorithm}"
        what = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(str(place), [f"no learner can be made with them: {what}"]) from error


def make_model(task: Task, hyperparameters: CentralizedConfig, env: VecEnv) -> BaseAlgorithm:
    """A fresh learner."""
    make = algorithm_class(task.config.algorithm)
    return make(
        hyperparameters.policy,
        env,
        seed=task.config.seed,
        device=task.config.device,
        **model_arguments(hyperparameters),
    )


def log_interval(model: BaseAlgorithm, stride: int) -> int:
    """The library's interval between two log entries: rollouts on-policy, else episodes."""
    if isinstance(model, OnPolicyAlgorithm):
        return math.ceil(ROW_STEPS * stride / (model.n_steps * model.n_envs))
    return 4
