"""The one trainer of the centralised algorithms: Stable-Baselines3 on the single MDP."""

from __future__ import annotations

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from baselines.centralized.config import CentralizedConfig, algorithm_class, model_arguments
from baselines.centralized.policy import CentralizedPolicy, Normalization
from baselines.recorder import Recorder
from baselines.runs import Task
from mbn_marl.adapters.sb3 import CentralizedVecEnv


class ScaledReward(VecEnvWrapper):
    """Rewards times a constant.

    Args:
        venv: the environments.
        scale: the constant.
    """

    def __init__(self, venv: VecEnv, scale: float) -> None:
        super().__init__(venv)
        self._scale = scale

    def reset(self) -> VecEnvObs:
        """Reset the environments."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step and scale its rewards."""
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards * self._scale, dones, infos


class Reporter(BaseCallback):
    """Reports the end of every rollout, and the episodes in between, to a recorder.

    Args:
        recorder: where progress goes.
        env: the normalised environments of training.
    """

    def __init__(self, recorder: Recorder, env: VecNormalize) -> None:
        super().__init__()
        self._recorder = recorder
        self._env = env

    @property
    def policy(self) -> CentralizedPolicy:
        """The policy as it is now."""
        return CentralizedPolicy(self.model, Normalization.of(self._env))

    def _on_training_start(self) -> None:
        self._recorder.start()

    def _on_step(self) -> bool:
        ended = [info for info in self.locals["infos"] if "episode" in info]
        self._recorder.episodes.add(
            [info["episode"]["r"] for info in ended], [info["is_success"] for info in ended]
        )
        return True

    def _on_rollout_end(self) -> None:
        self._recorder.update(self.num_timesteps, self.policy, {})


def train(task: Task, hyperparameters: CentralizedConfig, recorder: Recorder) -> None:
    """Train on ``task`` for its budget, rounded up to whole rollouts, and evaluate the result."""
    seed = task.config.seed
    worlds = CentralizedVecEnv(
        task.field, hyperparameters.num_envs, seed=seed, threads=1, **task.settings
    )
    env = VecNormalize(ScaledReward(worlds, hyperparameters.reward_scale), norm_reward=False)
    arguments = model_arguments(hyperparameters)
    model = algorithm_class(task.config.algorithm)(
        "MlpPolicy", env, seed=seed, device="cpu", **arguments
    )
    reporter = Reporter(recorder, env)
    model.learn(task.config.steps, callback=reporter)
    recorder.finish(model.num_timesteps, reporter.policy)
