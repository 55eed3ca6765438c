"""Minari: a data set of episodes of a policy, in the single MDP.

Requirements: pip install ".[baselines]" "minari[create,hdf5]==0.5.4"
Command: python examples/minari_dataset.py
Printed: 20 episodes, 588 steps, return 159,118, in mbn/field_03/greedy-v0 (9 s on one core)
"""

import argparse

import gymnasium
import minari

from baselines import load_policy

parser = argparse.ArgumentParser()
parser.add_argument("--name", default="mbn/field_03/greedy-v0", help="of the data set")
parser.add_argument("--episodes", type=int, default=20)
arguments = parser.parse_args()

policy = load_policy("greedy", "field_03")  # acts on the state
env = minari.DataCollector(gymnasium.make("mbn/field_03-v0", random_starts=True))
for seed in range(arguments.episodes):
    # Without a seed Minari draws one of 64 bits, which may be more than the environment takes.
    state, ended = env.reset(seed=seed)[0], False
    while not ended:
        state, _, terminated, truncated, _ = env.step(policy.act(state))
        ended = terminated or truncated
env.create_dataset(arguments.name, algorithm_name="greedy", requirements=["mbn_marl"])
env.close()

episodes = list(minari.load_dataset(arguments.name).iterate_episodes())
steps = sum(len(episode) for episode in episodes)
mean = sum(episode.rewards.sum() for episode in episodes) / len(episodes)
print(f"{len(episodes)} episodes, {steps} steps, return {mean:,.0f}, in {arguments.name}")
