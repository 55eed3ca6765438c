"""Augmented random search: the library's, but for three details."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray
from sb3_contrib import ARS
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper


class PopulationSearch(ARS):
    """SB3-Contrib's ARS, for many worlds, and able to resume exactly where it was saved.

    - With several worlds each evaluates a candidate of its own, not all of them the same one.
    - A rollout starts before the random directions are drawn, so that a learner saved at that
      moment draws the same ones.
    - The search continues from the parameters that were loaded, not from zero, and schedules from
      where they were.

    Its environment is a ``LearnersView``, perhaps inside a ``VecNormalize``.
    """

    action_space: Box
    weights: Any  # a tensor; the library's types have it as None
    ep_info_buffer: Any  # a list; the library's types have it as a deque

    @property
    def _worlds(self) -> VecEnvWrapper:
        """The environment; what a wrapper does not have it looks up in the one inside."""
        assert isinstance(self.env, VecEnvWrapper)
        return self.env

    def _do_one_update(self, callback: BaseCallback, async_eval: Any) -> None:
        callback.on_rollout_start()
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        super()._do_one_update(callback, async_eval)

    def set_parameters(self, *arguments: Any, **options: Any) -> None:
        """Load parameters into the policy and into the vector that the search moves."""
        super().set_parameters(*arguments, **options)
        parameters = self.policy.parameters()
        self.weights = torch.nn.utils.parameters_to_vector(parameters).detach()

    def evaluate_candidates(
        self, candidate_weights: torch.Tensor, callback: BaseCallback, async_eval: Any
    ) -> torch.Tensor:
        """The sum of each candidate's returns over ``n_eval_episodes`` episodes."""
        if self._worlds.num_envs == 1:
            returns: torch.Tensor = super().evaluate_candidates(
                candidate_weights, callback, async_eval
            )
            return returns
        self.ep_info_buffer = []
        callback.on_rollout_start()
        groups = [
            torch.stack([self._episodes(group, callback) for _ in range(self.n_eval_episodes)])
            for group in torch.split(candidate_weights, self._worlds.num_envs)
        ]
        self._worlds.watched[:] = True
        callback.on_rollout_end()
        return torch.cat([group.sum(dim=0) for group in groups])

    def _episodes(self, candidates: torch.Tensor, callback: BaseCallback) -> torch.Tensor:
        """The returns of an episode of each candidate, side by side.

        A world whose episode has ended continues until all have, but neither its steps nor its next
        episodes count.
        """
        worlds, count = self._worlds.num_envs, len(candidates)
        act = self._side_by_side(candidates)
        returns, lengths = np.zeros(count), np.zeros(count)
        running = np.arange(worlds) < count
        observations: Any = self._worlds.reset()
        while running.any():
            self._worlds.watched[:] = running
            actions = np.zeros((worlds, *self.action_space.shape), np.float32)
            actions[:count] = act(observations[:count])
            observations, _, dones, infos = self._worlds.step(actions)
            self.num_timesteps += int(running.sum())
            callback.on_step()
            for world in np.flatnonzero(dones & running):
                episode = infos[world]["episode"]
                returns[world], lengths[world] = episode["r"], episode["l"]
            running &= ~dones
        self._mimic_monitor_wrapper(returns, lengths)
        totals = returns + self.alive_bonus_offset * lengths
        return torch.as_tensor(totals, dtype=torch.float32, device=self.device)

    def _side_by_side(self, candidates: torch.Tensor) -> Any:
        """A function from observations (count, size) to each candidate's actions for its own."""
        policies = [deepcopy(self.policy) for _ in candidates]
        for policy, weights in zip(policies, candidates, strict=True):
            policy.load_from_vector(weights.cpu().numpy())
        stacked, _ = torch.func.stack_module_state(policies)

        def one(parameters: dict[str, torch.Tensor], observation: torch.Tensor) -> torch.Tensor:
            actions: torch.Tensor = torch.func.functional_call(
                self.policy, parameters, (observation[None],)
            )
            return actions[0]

        def act(observations: NDArray[Any]) -> NDArray[Any]:
            seen = torch.as_tensor(observations, device=self.device)
            outputs = torch.vmap(one)(stacked, seen).numpy(force=True)
            actions = outputs.reshape(len(outputs), *self.action_space.shape)
            clipped: NDArray[Any] = np.clip(actions, -1.0, 1.0)  # as `predict` does in this space
            return clipped

        return act
