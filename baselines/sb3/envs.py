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
from mbn_marl.engine import BatchEngine


class LearnersView(VecEnvWrapper):
    """The worlds as the learner gets them: rewards scaled, ended episodes noted.

    A world has ``stride`` rows, of which the first one reports the world's episodes.
    """

    def __init__(
        self, venv: VecEnv, scale: float, episodes: EpisodeWindow, stride: int = 1
    ) -> None:
        super().__init__(venv)
        self._scale, self._episodes, self._stride = scale, episodes, stride

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = self.venv.step_wait()
        ended = [infos[row] for row in np.flatnonzero(dones) if row % self._stride == 0]
        self._episodes.add(
            [info["episode_return"] for info in ended], [info["is_success"] for info in ended]
        )
        return observations, rewards * self._scale, dones, infos


class ShrinkingRois(VecEnvWrapper):
    """Worlds whose ROIs change size as a curriculum says; then new episodes begin in all of them.

    Attributes:
        curriculum: it counts each row's episodes.
        every: the size may change after so many steps: the rollout of an on-policy learner.
    """

    def __init__(
        self, make: Callable[[RoiCurriculum], VecEnv], curriculum: RoiCurriculum, every: int = 1
    ) -> None:
        self._make, self.curriculum, self.every, self._steps = make, curriculum, every, 0
        super().__init__(make(curriculum))

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        observations: Any
        observations, rewards, dones, infos = self.venv.step_wait()
        self.curriculum.add([infos[row]["is_success"] for row in np.flatnonzero(dones)])
        self._steps += 1
        if self._steps % self.every == 0 and self.curriculum.move():
            # Episodes that still run are cut off here: the learner bootstraps from the value of
            # their own last observation, not from that of the new worlds' first.
            for row in np.flatnonzero(~dones):
                cut = {"TimeLimit.truncated": True, "terminal_observation": observations[row]}
                infos[row].update(cut)
            observations, dones = self.begin(self.curriculum), np.ones_like(dones)
        return observations, rewards, dones, infos

    def begin(self, curriculum: RoiCurriculum) -> VecEnvObs:
        """Begin new episodes with ROIs of the size that ``curriculum`` says."""
        self.curriculum, self.venv = curriculum, self._make(curriculum)
        return self.venv.reset()


def make_env(task: Task, hyperparameters: SB3Config, episodes: EpisodeWindow) -> VecEnv:
    """The worlds of training: a row for each, or row ``w * n + i`` for robot i of world w."""
    count, config = hyperparameters.num_envs, task.config

    def make(curriculum: RoiCurriculum) -> VecEnv:
        how: dict[str, Any] = {"seed": curriculum.seed(config.seed), "threads": 1}
        how |= hyperparameters.in_training(task, curriculum, count)
        worlds: NavigationVecEnv
        if config.algorithm == "ppo-shared":
            worlds = SharedPolicyVecEnv(num_worlds=count, **how)
        else:
            joint = hyperparameters.joint_observation
            worlds = CentralizedVecEnv(num_envs=count, joint_observation=joint, **how)
        scale, stride = hyperparameters.reward_scale, worlds.num_envs // count
        return LearnersView(worlds, scale, episodes, stride)

    curriculum = RoiCurriculum(hyperparameters.roi_radius, window=count)
    env = ShrinkingRois(make, curriculum) if curriculum.radius > 1.0 else make(curriculum)
    curriculum.window = env.num_envs  # it counts rows
    return VecNormalize(env, norm_reward=False) if hyperparameters.normalize_observation else env


def engine_of(env: VecEnv) -> BatchEngine:
    """The engine of all worlds."""
    engine: BatchEngine = env.get_attr("engine")[0]
    return engine
