"""RLlib: PPO with one policy for all robots, on PettingZoo's parallel form.

Requirements: pip install . -r examples/rllib_requirements.txt (RLlib wants gymnasium 1.2.2, so not
    with the suite's constraints.txt)
Command: python examples/rllib_ppo.py
Printed: 12,000 env-steps, team return -144,114 (too few to learn from: it shows that it runs)
"""

import argparse

import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from mbn_marl import parallel_env

parser = argparse.ArgumentParser()
parser.add_argument("--iterations", type=int, default=3, help="of 4,000 env-steps")
arguments = parser.parse_args()

ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
register_env("navigation", lambda config: ParallelPettingZooEnv(parallel_env(**config)))
config = (
    PPOConfig()
    .environment("navigation", env_config={"field": "field_03", "one_hot": True})
    .env_runners(num_env_runners=0)
    .multi_agent(policies={"shared"}, policy_mapping_fn=lambda agent, *_, **__: "shared")
    .training(lr=5e-4, num_epochs=4, train_batch_size_per_learner=4000, vf_clip_param=float("inf"))
)
algorithm = config.build_algo()
for _ in range(arguments.iterations):
    result = algorithm.train()
runners = result["env_runners"]
print(f"{runners['num_env_steps_sampled_lifetime']:,.0f} env-steps", end=", ")
print(f"team return {runners['episode_return_mean']:,.0f}")
ray.shutdown()
