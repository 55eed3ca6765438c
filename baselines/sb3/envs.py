"""The worlds of training, as a learner of the library sees them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pettingzoo.utils.wrappers import BaseParallelWrapper
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from baselines.sb3.config import SB3Config
from baselines.training.aids import RoiCurriculum
from baselines.training.config import Task
from baselines.training.run_logger import EpisodeWindow
from mbn_marl.adapters.pettingzoo import NavigationParallelEnv, StepResult
from mbn_marl.adapters.sb3 import CentralizedVecEnv, NavigationVecEnv, SharedPolicyVecEnv
from mbn_marl.engine import BatchEngine


class LearnersView(VecEnvWrapper):
    """The worlds as the learner gets them: rewards scaled, ended episodes noted.

    A world has ``stride`` rows, of which the first one reports the world's episodes.

    Attributes:
        watched: (num_envs,) bool, the rows whose episodes are noted: all, unless a learner steps
            some worlds only because they are beside others.
    """

    def __init__(
        self, venv: VecEnv, scale: float, episodes: EpisodeWindow, stride: int = 1
    ) -> None:
        super().__init__(venv)
        self._scale, self._episodes = scale, episodes
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
                [info["episode_return"] for info in ended], [info["is_success"] for info in ended]
            )
        return observations, rewards * self._scale, dones, infos


class ShrinkingRois(VecEnvWrapper):
    """Worlds whose ROIs change size as a curriculum says; then new episodes begin in all of them.

    To the learner, episodes that run at that moment are truncated: values are bootstrapped.

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
        """Reset the worlds."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step; change the size of the ROIs when it is time."""
        observations: Any
        observations, rewards, dones, infos = self.venv.step_wait()
        self.curriculum.add([infos[row]["is_success"] for row in np.flatnonzero(dones)])
        self._steps += 1
        if self._steps % self.every == 0 and self.curriculum.move():
            for row in np.flatnonzero(~dones):
                cut = {"TimeLimit.truncated": True, "terminal_observation": observations[row]}
                infos[row].update(cut)
            observations, dones = self.begin(self.curriculum), np.ones_like(dones)
        return observations, rewards, dones, infos

    def begin(self, curriculum: RoiCurriculum) -> VecEnvObs:
        """Begin new episodes with ROIs of the size that ``curriculum`` says."""
        self.curriculum, self.venv = curriculum, self._make(curriculum)
        return self.venv.reset()


class EpisodeEnd(BaseParallelWrapper):  # type: ignore[misc]  # the library ships no types
    """Adds return and success to an episode's last infos, in which SuperSuit puts the next's."""

    def step(self, actions: Mapping[str, Any]) -> StepResult:
        """Move all robots."""
        result: StepResult = self.env.step(actions)
        if not self.env.agents:
            metrics = self.unwrapped.engine.metrics(("episode_return", "success"))
            team_return, success = (float(values[0]) for values in metrics.values())
            for info in result[-1].values():
                info |= {"episode_return": team_return, "is_success": success}
        return result


def engine_rows(task: Task, hyperparameters: SB3Config, curriculum: RoiCurriculum) -> VecEnv:
    """All worlds in one batch: a row for each, or row ``w * n + i`` for robot i of world w."""
    how: dict[str, Any] = {"seed": curriculum.seed(task.config.seed), "threads": 1}
    how |= hyperparameters.in_training(task, curriculum, hyperparameters.num_envs)
    if task.config.algorithm == "ppo-shared":
        return SharedPolicyVecEnv(num_worlds=hyperparameters.num_envs, **how)
    how["joint_observation"] = hyperparameters.joint_observation
    return CentralizedVecEnv(num_envs=hyperparameters.num_envs, **how)


def supersuit_rows(task: Task, hyperparameters: SB3Config, _: RoiCurriculum) -> VecEnv:
    """The rows of :func:`engine_rows` from copies of one PettingZoo environment, stepped in turn.

    SuperSuit cannot seed them, so the one is seeded before it is copied: with ``random_starts``
    all worlds draw the same starts. To the learner, its time limits are terminations.
    """
    from supersuit import concat_vec_envs_v1, pettingzoo_env_to_vec_env_v1

    env = NavigationParallelEnv(task.field, **task.settings)
    env.reset(seed=task.config.seed)
    rows = pettingzoo_env_to_vec_env_v1(EpisodeEnd(env))
    worlds: VecEnv = concat_vec_envs_v1(
        rows, hyperparameters.num_envs, base_class="stable_baselines3"
    )
    return worlds


def make_env(task: Task, hyperparameters: SB3Config, episodes: EpisodeWindow) -> VecEnv:
    """The worlds of training, as the learner sees them."""
    rows = supersuit_rows if task.config.algorithm == "ppo-supersuit" else engine_rows

    def make(curriculum: RoiCurriculum) -> VecEnv:
        worlds = rows(task, hyperparameters, curriculum)
        stride = worlds.num_envs // hyperparameters.num_envs
        return LearnersView(worlds, hyperparameters.reward_scale, episodes, stride)

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The `render_mode` attribute")  # SuperSuit hides it
        curriculum = hyperparameters.curriculum(window=hyperparameters.num_envs)
        env = ShrinkingRois(make, curriculum) if curriculum.radius > 1.0 else make(curriculum)
        curriculum.window = env.num_envs  # it counts rows
        normalized = hyperparameters.normalize_observation
        return VecNormalize(env, norm_reward=False) if normalized else env


def engines(env: VecEnv) -> list[BatchEngine]:
    """The engines below the rows: one for all worlds, or one for each."""
    worlds: Any = env.unwrapped
    if isinstance(worlds, NavigationVecEnv):
        return [worlds.engine]
    return [rows.par_env.unwrapped.engine for rows in worlds.vec_envs]
