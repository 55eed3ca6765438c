"""The trainer of shared-policy PPO: Stable-Baselines3's PPO on the robots' rows."""

from __future__ import annotations

from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from baselines.sb3.config import CentralizedConfig, model_arguments
from baselines.sb3.shared.envs import make_env
from baselines.sb3.shared.learner import restore, save
from baselines.sb3.shared.policy import SharedPolicy
from baselines.sb3.trainer import Keeping, check_maker, learn
from baselines.training.config import Task
from baselines.training.run_logger import EpisodeWindow, Recorder


def train(task: Task, hyperparameters: CentralizedConfig, recorder: Recorder) -> None:
    """Train on ``task`` for its budget, rounded up to whole rollouts, and evaluate the result.

    An env-step moves every robot of a world, and is a row for each robot in the library's count.
    """
    env = make_env(task, hyperparameters, recorder.episodes)
    model = make_model(task, hyperparameters, env)
    if recorder.checkpoint is not None:
        restore(model, recorder.checkpoint)
    stride = env.num_envs // hyperparameters.num_envs
    learn(model, task, recorder, Keeping(SharedPolicy.of, save, stride))


def check(task: Task, hyperparameters: CentralizedConfig) -> None:
    """Whether a learner can be made with these hyperparameters.

    Raises:
        ConfigError: with what the library says against them.
    """
    env = make_env(task, hyperparameters, EpisodeWindow())
    check_maker(task, lambda: make_model(task, hyperparameters, env))


def make_model(task: Task, hyperparameters: CentralizedConfig, env: VecEnv) -> PPO:
    """A fresh learner. PPO's own ``seed`` would seed the worlds, which SuperSuit's refuse."""
    set_random_seed(task.config.seed)
    return PPO(
        hyperparameters.policy, env, device=task.config.device, **model_arguments(hyperparameters)
    )
