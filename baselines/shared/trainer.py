"""The trainer of shared-policy PPO: Stable-Baselines3's PPO on the robots' rows."""

from __future__ import annotations

from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed

from baselines.centralized.config import CentralizedConfig, model_arguments
from baselines.centralized.trainer import Keeping, learn
from baselines.recorder import Recorder
from baselines.runs import Task
from baselines.shared.learner import restore, save
from baselines.shared.policy import SharedPolicy
from baselines.shared.worlds import make_env


def train(task: Task, hyperparameters: CentralizedConfig, recorder: Recorder) -> None:
    """Train on ``task`` for its budget, rounded up to whole rollouts, and evaluate the result.

    An env-step moves every robot of one world, so a row for each robot is one env-step together.
    """
    set_random_seed(task.config.seed)  # PPO's own `seed` would seed the worlds: SuperSuit has none
    env = make_env(task, hyperparameters, recorder.episodes)
    model = PPO(
        hyperparameters.policy,
        env,
        device=task.config.device,
        **model_arguments(hyperparameters),
    )
    if recorder.checkpoint is not None:
        restore(model, recorder.checkpoint)
    stride = env.num_envs // hyperparameters.num_envs
    learn(model, task, recorder, Keeping(SharedPolicy.of, save, stride))
