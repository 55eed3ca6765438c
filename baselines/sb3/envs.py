"""The worlds of training, as a learner of the library sees them."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from baselines.sb3.config import CentralizedConfig
from baselines.training.config import Task
from baselines.training.run_logger import EpisodeWindow
from mbn_marl.adapters.sb3 import CentralizedVecEnv


class LearnersView(VecEnvWrapper):
    """The worlds as the learner gets them: rewards scaled, ended episodes noted.

    Args:
        venv: the worlds.
        scale: the learner sees the reward times this.
        episodes: where true returns and successes of ended episodes go.
        stride: rows of a world; its first row tells about the world's episodes.

    Attributes:
        watched: (num_envs,) bool, the rows whose episodes are noted: all, unless a learner steps
            some worlds only because they stand beside others.
    """

    def __init__(
        self, venv: VecEnv, scale: float, episodes: EpisodeWindow, stride: int = 1
    ) -> None:
        super().__init__(venv)
        self._scale = scale
        self._episodes = episodes
        self.watched = np.arange(venv.num_envs) % stride == 0

    def reset(self) -> VecEnvObs:
        """Reset the worlds."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step."""
        observations, rewards, dones, infos = self.venv.step_wait()
        if dones.any():
            ended = [infos[row] for row in np.flatnonzero(dones & self.watched)]
            self._episodes.add(
                [info["episode_return"] for info in ended], [info["success"] for info in ended]
            )
        return observations, rewards * self._scale, dones, infos


def make_env(task: Task, hyperparameters: CentralizedConfig, episodes: EpisodeWindow) -> VecEnv:
    """The worlds of training, as the learner sees them."""
    worlds = CentralizedVecEnv(
        task.field,
        hyperparameters.num_envs,
        seed=task.config.seed,
        threads=1,
        **task.settings,
    )
    env = LearnersView(worlds, hyperparameters.reward_scale, episodes)
    return VecNormalize(env, norm_reward=False) if hyperparameters.normalize_observation else env
