"""Tianshou: PPO on the single MDP, one Gymnasium environment for each world.

Requirements: pip install . torch==2.13.0 tianshou==2.0.1 (pandas 2 comes with it, so
    not with the suite's constraints.txt)
Command: python examples/tianshou_ppo.py
Printed: 163,840 env-steps, return of 100 episodes: 146,432 (35 s on one core; optimum 159,490)
"""

import argparse

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import flatten_space
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, CollectStats, VectorReplayBuffer
from tianshou.env import DummyVectorEnv, VectorEnvNormObs
from tianshou.trainer import OnPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from torch.distributions import Independent, Normal

import mbn_marl  # noqa: F401 - registers the ids

parser = argparse.ArgumentParser()
parser.add_argument("--rollouts", type=int, default=40, help="of 4,096 env-steps")
arguments = parser.parse_args()

WORLDS, ROLLOUT, REWARD_SCALE = 16, 4096, 5e-5
torch.manual_seed(0)
np.random.seed(0)


class World(gymnasium.Wrapper):
    """A world as Tianshou takes it: a flat action, scaled rewards, and no infos, which it keeps."""

    def __init__(self):
        super().__init__(gymnasium.make("mbn/field_03-v0"))
        self.action_space = flatten_space(self.env.action_space)

    def reset(self, **options):
        return self.env.reset(**options)[0], {}

    def step(self, action):
        state, reward, *ends, _ = self.env.step(action.reshape(self.env.action_space.shape))
        return state, REWARD_SCALE * reward, *ends, {}


def network() -> Net:
    return Net(
        state_shape=one.observation_space.shape, hidden_sizes=[64, 64], activation=torch.nn.Tanh
    )


one = World()
envs = VectorEnvNormObs(DummyVectorEnv([World] * WORLDS))
actor = ContinuousActorProbabilistic(
    preprocess_net=network(), action_shape=one.action_space.shape, unbounded=True
)
algorithm = PPO(
    policy=ProbabilisticActorPolicy(
        actor=actor,
        dist_fn=lambda parameters: Independent(Normal(*parameters), 1),
        action_space=one.action_space,
    ),
    critic=ContinuousCritic(preprocess_net=network()),
    optim=AdamOptimizerFactory(lr=5e-4),
    max_grad_norm=0.5,
)
collector = Collector[CollectStats](algorithm, envs, VectorReplayBuffer(ROLLOUT, WORLDS))
algorithm.run_training(
    OnPolicyTrainerParams(
        training_collector=collector,
        max_epochs=1,
        epoch_num_steps=arguments.rollouts * ROLLOUT,
        collection_step_num_env_steps=ROLLOUT,
        batch_size=ROLLOUT // 4,
        update_step_num_repetitions=4,
        show_progress=False,
        verbose=False,
    )
)
stats = Collector(algorithm, envs).collect(n_episode=100, reset_before_collect=True)
mean = stats.returns_stat.mean / REWARD_SCALE
print(f"{arguments.rollouts * ROLLOUT:,} env-steps, return of 100 episodes: {mean:,.0f}")
