"""The worlds of training as rows of robots: the engine's own, or through SuperSuit."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any

from pettingzoo.utils.wrappers import BaseParallelWrapper
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from supersuit import concat_vec_envs_v1, pettingzoo_env_to_vec_env_v1

from baselines.sb3.config import CentralizedConfig
from baselines.sb3.envs import LearnersView
from baselines.training.config import Task
from baselines.training.run_logger import EpisodeWindow
from mbn_marl.adapters.pettingzoo import NavigationParallelEnv, StepResult
from mbn_marl.adapters.sb3 import SharedPolicyVecEnv
from mbn_marl.engine import BatchEngine


class TeamReturn(BaseParallelWrapper):  # type: ignore[misc]  # the library ships no types
    """Adds the team's return to the infos of an episode's last step.

    SuperSuit starts the next episode in the same call, so it cannot be asked for afterwards.
    """

    def step(self, actions: Mapping[str, Any]) -> StepResult:
        """Move all robots."""
        result: StepResult = self.env.step(actions)
        if not self.env.agents:
            team_return = float(self.unwrapped.engine.metrics()["episode_return"][0])
            for info in result[-1].values():
                info["episode_return"] = team_return
        return result


def native_rows(task: Task, num_worlds: int) -> VecEnv:
    """All worlds in one batch."""
    return SharedPolicyVecEnv(
        task.field, num_worlds, seed=task.config.seed, threads=1, **task.settings
    )


def supersuit_rows(task: Task, num_worlds: int) -> VecEnv:
    """Copies of one PettingZoo environment, stepped one after the other.

    SuperSuit cannot seed them, so the one environment is seeded before it is copied: a run can be
    repeated, but with ``random_starts`` all worlds draw the same starts. It does not report time
    limits either: the learner takes them for terminations.
    """
    env = NavigationParallelEnv(task.field, **task.settings)
    env.reset(seed=task.config.seed)
    rows = pettingzoo_env_to_vec_env_v1(TeamReturn(env))
    worlds: VecEnv = concat_vec_envs_v1(rows, num_worlds, base_class="stable_baselines3")
    return worlds


BRIDGES: Mapping[str, Callable[[Task, int], VecEnv]] = {
    "ppo-shared": native_rows,
    "ppo-supersuit": supersuit_rows,
}


def make_env(task: Task, hyperparameters: CentralizedConfig, episodes: EpisodeWindow) -> VecEnv:
    """The rows of training, as the learner sees them: row ``w * n + i`` is robot i of world w."""
    worlds = BRIDGES[task.config.algorithm](task, hyperparameters.num_envs)
    stride = worlds.num_envs // hyperparameters.num_envs
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The `render_mode` attribute")  # SuperSuit hides it
        env = LearnersView(worlds, hyperparameters.reward_scale, episodes, stride)
        normalized = hyperparameters.normalize_observation
        return VecNormalize(env, norm_reward=False) if normalized else env


def engines(env: VecEnv) -> list[BatchEngine]:
    """The engines below the rows: one for all worlds, or one for each."""
    worlds: Any = env.unwrapped
    if isinstance(worlds, SharedPolicyVecEnv):
        return [worlds.engine]
    return [rows.par_env.unwrapped.engine for rows in worlds.vec_envs]
