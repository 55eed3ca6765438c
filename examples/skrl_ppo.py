"""skrl: PPO on the single MDP in Gymnasium's vector form.

Requirements: pip install . torch skrl==2.1.1
Command: python examples/skrl_ppo.py
Printed: 18383 episodes ended, return of the last 100: 159,048 (15 s on one core; optimum 159,490)
"""

import argparse

import gymnasium
import numpy as np
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from skrl.agents.torch import ExperimentCfg
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

import mbn_marl  # noqa: F401 - registers the ids

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=655_360, help="env-steps to learn from")
parser.add_argument("--worlds", type=int, default=128, help="worlds side by side")
arguments = parser.parse_args()

LENGTH = 64
set_seed(0)
# skrl takes every row for a transition. So worlds restart in the step in which they end, and a time
# limit counts as an end.
worlds = gymnasium.make_vec("mbn/field_03-v0", num_envs=arguments.worlds, autoreset_mode="SameStep")
worlds = RecordEpisodeStatistics(worlds)
envs = wrap_env(worlds)
spaces = {"observation_space": envs.observation_space, "action_space": envs.action_space}
layers = {"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "tanh"}
models = {
    "policy": gaussian_model(**spaces, network=[layers], output="ACTIONS"),
    "value": deterministic_model(**spaces, network=[layers], output="ONE"),
}
settings = PPO_CFG(
    rollouts=LENGTH,
    learning_epochs=4,
    mini_batches=4,
    learning_rate=5e-4,
    entropy_loss_scale=0.01,
    value_clip=0.0,
    value_loss_scale=0.5,
    rewards_shaper=lambda rewards, *_: 5e-5 * rewards,
    observation_preprocessor=RunningStandardScaler,
    observation_preprocessor_kwargs={"size": envs.observation_space},
    experiment=ExperimentCfg(write_interval=0, checkpoint_interval=0),
)
agent = PPO(
    models=models,
    memory=RandomMemory(memory_size=LENGTH, num_envs=envs.num_envs),
    **spaces,
    cfg=settings,
)
rollouts = max(1, arguments.steps // (arguments.worlds * LENGTH))
length = {"timesteps": rollouts * LENGTH, "headless": True, "disable_progressbar": True}
SequentialTrainer(env=envs, agents=agent, cfg=length).train()
returns = worlds.return_queue  # of the last 100 episodes
mean = np.mean(returns) if returns else float("nan")
print(f"{worlds.episode_count} episodes ended, return of the last 100: {mean:,.0f}")
