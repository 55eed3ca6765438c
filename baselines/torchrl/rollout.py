"""Rollouts: the policy acts in many worlds of one engine, and every quantity has its buffer.

TorchRL's ``step_and_maybe_reset`` on ``NavigationEnv`` gives the same transitions in tensordicts;
this loop fills tensors directly (see ``trainer`` for what that saves).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch

from baselines.torchrl.loss import log_prob
from baselines.torchrl.networks import GaussianPolicy
from mbn_marl.engine import BatchEngine


class Rollout(NamedTuple):
    """T decisions of each of W worlds of n robots; overwritten by the next rollout.

    A decision is one env-step, or the same action for several (action repeat). Where it ended the
    episode, what the world did afterwards belongs to no decision.
    """

    observations: torch.Tensor  # (T + 1, W, n, obs_size): the last are where the worlds now are
    actions: torch.Tensor  # (T, W, n, 2), as sampled; the engine clips them
    log_probs: torch.Tensor  # (T, W, n)
    rewards: torch.Tensor  # (T, W, n), true ones
    terminated: torch.Tensor  # (T, W) bool
    truncated: torch.Tensor  # (T, W) bool
    final_observations: torch.Tensor  # (T, W, n, obs_size), where the decision ended an episode
    before: torch.Tensor  # (T, W, 4n + 1): the paper's states that decisions were taken in
    after: torch.Tensor  # (T, W, 4n + 1): and those they led to, before any reset

    @property
    def done(self) -> torch.Tensor:
        """Where a decision ended the episode, (T, W) bool."""
        return self.terminated | self.truncated


class Worlds:
    """The worlds of a training, in the middle of their episodes.

    Args:
        engine: resets worlds within the step that ends them; only this object steps it.
        decisions: T, of every world in a rollout.
        device: where the tensors live.
        generator: of the actions' noise, on that device.
        report: is called with the returns and the successes (1 or 0) of episodes that end.
    """

    def __init__(
        self,
        engine: BatchEngine,
        decisions: int,
        device: torch.device,
        generator: torch.Generator,
        report: Callable[[list[float], list[float]], None],
    ) -> None:
        self.engine = engine
        self._device = device
        self._generator = generator
        self._report = report
        steps, worlds, robots = decisions, engine.num_worlds, engine.n_robots

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(*shape, dtype=dtype, device=device)

        self._rollout = Rollout(
            observations=zeros(steps + 1, worlds, robots, engine.obs_size),
            actions=zeros(steps, worlds, robots, 2),
            log_probs=zeros(steps, worlds, robots),
            rewards=zeros(steps, worlds, robots),
            terminated=zeros(steps, worlds, dtype=torch.bool),
            truncated=zeros(steps, worlds, dtype=torch.bool),
            final_observations=zeros(steps, worlds, robots, engine.obs_size),
            before=zeros(steps, worlds, 4 * robots + 1),
            after=zeros(steps, worlds, 4 * robots + 1),
        )
        self.observations = self._tensor(engine.reset()).clone()

    @torch.no_grad()
    def roll_out(self, policy: GaussianPolicy, repeat: int) -> Rollout:
        """Let every world take its decisions, each for ``repeat`` env-steps."""
        rollout = self._rollout
        noise = torch.empty_like(rollout.actions).normal_(generator=self._generator)
        rollout.observations[0] = self.observations
        for t in range(len(noise)):
            mean, std = policy(rollout.observations[t])
            torch.addcmul(mean, std, noise[t], out=rollout.actions[t])
            rollout.before[t] = self._tensor(self.engine.state())
            self._decide(t, repeat)
        rollout.log_probs.copy_(log_prob(noise, policy.log_std))
        self.observations = rollout.observations[-1].clone()
        return rollout

    def _decide(self, t: int, repeat: int) -> None:
        """Take decision ``t``: the same actions ``repeat`` times."""
        rollout, engine = self._rollout, self.engine
        rewards, terminated, truncated = (
            part[t].zero_() for part in (rollout.rewards, rollout.terminated, rollout.truncated)
        )
        actions: Any = rollout.actions[t]
        if engine.device == "cpu":
            actions = actions.numpy()
        for _ in range(repeat):
            observations, *outcome = map(self._tensor, engine.step(actions))
            running = ~(terminated | truncated)
            rewards += outcome[0] * running.unsqueeze(-1)
            terminated |= outcome[1] & running
            truncated |= outcome[2] & running
            ended = outcome[1] | outcome[2]
            if ended.any():
                self._end(t, ended, ended & running)
        rollout.observations[t + 1] = observations
        rollout.after[t] = torch.where(
            (terminated | truncated).unsqueeze(-1), rollout.after[t], self._tensor(engine.state())
        )

    def _end(self, t: int, ended: torch.Tensor, decided: torch.Tensor) -> None:
        """Keep the last moments of episodes.

        Args:
            t: the decision.
            ended: worlds that the engine has just reset.
            decided: those of them that had not been reset during this decision before.
        """
        metrics = self.engine.metrics()
        names = ("episode_return", "success")
        self._report(*(self._tensor(metrics[name])[ended].tolist() for name in names))
        final = self._tensor(self.engine.final_observations)
        self._rollout.final_observations[t, decided] = final[decided]
        states = self._tensor(self.engine.final_state())
        self._rollout.after[t, decided] = states[decided].float()

    def _tensor(self, array: Any) -> torch.Tensor:
        """An array of the engine on the trainer's device; its own memory where that is the same."""
        return torch.as_tensor(array, device=self._device)
