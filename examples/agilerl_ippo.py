"""AgileRL: IPPO with one policy for all robots, on PettingZoo's parallel form.

Requirements: pip install . torch==2.13.0 agilerl==2.58.0 peft==0.21.2 (which AgileRL
    imports but does not ask for; PettingZoo 1.26.1 comes with it, so not with the suite's
    constraints.txt)
Command: python examples/agilerl_ippo.py
Printed: team return of 10 episodes, with sampled actions: -234,309 (22 s on one core; too few
    steps to learn from: it shows that it runs)
"""

import argparse

import torch
from agilerl.algorithms import IPPO
from agilerl.training.train_multi_agent_on_policy import train_multi_agent_on_policy
from supersuit import reward_lambda_v0

from mbn_marl import parallel_env

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=16_384, help="env-steps to learn from")
arguments = parser.parse_args()

REWARD_SCALE = 5e-5
torch.manual_seed(0)
env = parallel_env("field_03", one_hot=True, max_steps=256)
env = reward_lambda_v0(env, lambda reward: REWARD_SCALE * reward)
agents = env.possible_agents  # AgileRL puts robot_0, robot_1 ... into one group
policy = IPPO(
    [env.observation_space(agent) for agent in agents],
    [env.action_space(agent) for agent in agents],
    agent_ids=agents,
    learn_step=2048,
    batch_size=512,
    lr=5e-4,
)
_, scores = train_multi_agent_on_policy(
    env,
    "field_03",
    "IPPO",
    [policy],
    max_steps=arguments.steps,
    evo_steps=arguments.steps,
    eval_loop=10,
    verbose=False,
)
print(f"team return of 10 episodes, with sampled actions: {scores[-1] / REWARD_SCALE:,.0f}")
