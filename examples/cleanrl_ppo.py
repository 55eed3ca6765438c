"""PPO in the style of CleanRL, one file, on the single MDP in Gymnasium's vector form.

Requirements: pip install . torch
Command: python examples/cleanrl_ppo.py
Printed: 430 episodes ended in the last rollout, return 158,810 (13 s on one core; optimum 159,490)
"""

import argparse

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics
from torch import nn
from torch.distributions import Normal

import mbn_marl  # noqa: F401 - registers the ids

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=655_360, help="env-steps to learn from")
parser.add_argument("--worlds", type=int, default=128, help="worlds side by side")
arguments = parser.parse_args()

LENGTH, EPOCHS, MINIBATCHES = 64, 4, 4
GAMMA, LAMBDA, CLIP, ENTROPY = 0.99, 0.95, 0.2, 0.01
REWARD_SCALE = 5e-5

torch.manual_seed(0)
envs = gymnasium.make_vec("mbn/field_03-v0", num_envs=arguments.worlds)
envs = NormalizeObservation(RecordEpisodeStatistics(envs))
shape = envs.single_action_space.shape
inputs, outputs = envs.single_observation_space.shape[0], int(np.prod(shape))


def network(size: int, gain: float) -> nn.Sequential:
    layers = [nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, size)]
    for layer, scale in zip(layers[::2], (2**0.5, 2**0.5, gain), strict=True):
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)


actor, critic = network(outputs, 0.01), network(1, 1.0)
log_std = nn.Parameter(torch.zeros(outputs))
parameters = [*actor.parameters(), *critic.parameters(), log_std]
optimizer = torch.optim.Adam(parameters, 5e-4, eps=1e-5)


def tensor(array: np.ndarray) -> torch.Tensor:
    """Return a float32 copy."""
    return torch.as_tensor(array, dtype=torch.float32).clone()


state, _ = envs.reset(seed=0)
state, waits = tensor(state), torch.zeros(arguments.worlds)
returns: list[float] = []
for _ in range(max(1, arguments.steps // (arguments.worlds * LENGTH))):
    steps, returns = [], []
    for _ in range(LENGTH):
        with torch.no_grad():
            policy, value = Normal(actor(state), log_std.exp()), critic(state)[:, 0]
            action = policy.sample()
        forces = action.reshape(-1, *shape).clamp(-1, 1).numpy()
        after, reward, terminated, truncated, infos = envs.step(forces)
        after, ended = tensor(after), tensor(terminated | truncated)
        with torch.no_grad():  # a time limit ends an episode, not its future
            ahead = GAMMA * critic(after)[:, 0] * (1 - tensor(terminated))
        error = REWARD_SCALE * tensor(reward) + ahead - value
        log_prob = policy.log_prob(action).sum(-1)
        # A world that has ended restarts in the next step, which is no transition.
        steps.append((state, action, log_prob, value, error, ended, 1 - waits))
        if "episode" in infos:
            returns += infos["episode"]["r"][infos["_episode"]].tolist()
        state, waits = after, ended
    states, actions, log_probs, values, errors, ends, counts = map(
        torch.stack, zip(*steps, strict=True)
    )
    advantages, ahead = torch.empty_like(errors), torch.zeros(arguments.worlds)
    for step in reversed(range(LENGTH)):
        ahead = errors[step] + GAMMA * LAMBDA * (1 - ends[step]) * ahead
        advantages[step] = ahead
    valid = counts.flatten().nonzero()[:, 0]
    batch = [
        part.flatten(0, 1)[valid]
        for part in (states, actions, log_probs, advantages, advantages + values)
    ]
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(valid)).chunk(MINIBATCHES):
            seen, taken, before, advantage, target = (part[rows] for part in batch)
            policy = Normal(actor(seen), log_std.exp())
            ratio = (policy.log_prob(taken).sum(-1) - before).exp()
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            gain = torch.min(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage)
            entropy = policy.entropy().sum(-1).mean()
            loss = 0.5 * (critic(seen)[:, 0] - target).square().mean()
            optimizer.zero_grad()
            (loss - gain.mean() - ENTROPY * entropy).backward()
            nn.utils.clip_grad_norm_(parameters, 0.5)
            optimizer.step()
mean = np.mean(returns) if returns else float("nan")
print(f"{len(returns)} episodes ended in the last rollout, return {mean:,.0f}")
