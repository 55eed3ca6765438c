"""The worlds of training, as a learner of the library sees them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from baselines.sb3.config import SB3Config
from baselines.training.aids import RoiCurriculum
from baselines.training.config import Task
from baselines.training.run_logger import EpisodeWindow
from mbn_marl.adapters.sb3 import CentralizedVecEnv, NavigationVecEnv, SharedPolicyVecEnv


class TrainingWorlds(VecEnvWrapper):
    """Worlds as the learner gets them: rewards scaled, episodes noted, ROIs of a changing size."""

    def __init__(
        self,
        make: Callable[[RoiCurriculum], NavigationVecEnv],
        curriculum: RoiCurriculum,
        episodes: EpisodeWindow,
        scale: float = 1.0,
    ) -> None:
        self._make, self.curriculum, self._episodes, self._scale = make, curriculum, episodes, scale
        super().__init__(make(curriculum))
        # The size of ROIs may change after so many steps: the rollout of an on-policy learner.
        self.every, self._steps = 1, 0
        # A world has so many rows, of which the first one reports its episodes. The curriculum
        # counts those of every row.
        self.stride = self.num_envs // curriculum.window
        curriculum.window = self.num_envs

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        observations: Any
        observations, rewards, dones, infos = self.venv.step_wait()
        ended = np.flatnonzero(dones)
        self.curriculum.add([infos[row]["is_success"] for row in ended])
        worlds = [infos[row] for row in ended if row % self.stride == 0]
        self._episodes.add(
            [info["episode_return"] for info in worlds], [info["is_success"] for info in worlds]
        )
        self._steps += 1
        if self._steps % self.every == 0 and self.curriculum.move():
            # Episodes that still run are cut off here: the learner bootstraps from the value of
            # their own last observation, not from that of the new worlds' first.
            for row in np.flatnonzero(~dones):
                cut = {"TimeLimit.truncated": True, "terminal_observation": observations[row]}
                infos[row].update(cut)
            observations, dones = self.begin(self.curriculum), np.ones_like(dones)
        return observations, rewards * self._scale, dones, infos

    def begin(self, curriculum: RoiCurriculum) -> VecEnvObs:
        """Begin new episodes with ROIs of the size that ``curriculum`` says."""
        self.curriculum, self.venv = curriculum, self._make(curriculum)
        return self.venv.reset()


def make_env(
    task: Task, hyperparameters: SB3Config, episodes: EpisodeWindow
) -> tuple[TrainingWorlds, VecEnv]:
    """The worlds of training: a row for each, or row ``w * n + i`` for robot i of world w."""
    # The second is what the learner sees, which may be normalised.
    count, config = hyperparameters.num_envs, task.config

    def make(curriculum: RoiCurriculum) -> NavigationVecEnv:
        how: dict[str, Any] = {"seed": curriculum.seed(config.seed), "threads": 1}
        how |= hyperparameters.in_training(task, curriculum, count)
        if config.algorithm == "ppo-shared":
            return SharedPolicyVecEnv(num_worlds=count, **how)
        joint = hyperparameters.joint_observation
        return CentralizedVecEnv(num_envs=count, joint_observation=joint, **how)

    curriculum = RoiCurriculum(hyperparameters.roi_radius, window=count)
    worlds = TrainingWorlds(make, curriculum, episodes, hyperparameters.reward_scale)
    normalized = hyperparameters.normalize_observation
    return worlds, VecNormalize(worlds, norm_reward=False) if normalized else worlds
