"""A TorchRL environment that does nothing: what TorchRL itself costs."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase


class EmptyEnv(EnvBase):  # type: ignore[misc]
    """Has the specs of another environment, and returns fresh tensors of zeros.

    Args:
        like: the other environment, with batch size (W,).
        ending: whether one world, each in its turn, ends at every step, so that TorchRL has to
            reset it; otherwise none ever does.
    """

    def __init__(self, like: EnvBase, *, ending: bool) -> None:
        super().__init__(device=like.device, batch_size=like.batch_size)
        self.action_spec = like.full_action_spec.clone()
        self.reward_spec = like.full_reward_spec.clone()
        self.observation_spec = like.observation_spec.clone()
        self.done_spec = like.full_done_spec.clone()
        self._first = self.observation_spec.zero().update(self.full_done_spec.zero())
        self._next = self._first.clone().update(self.full_reward_spec.zero())
        self._ending = ending
        self._steps = 0

    def _set_seed(self, seed: int | None) -> None:
        """There is nothing random."""

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        return self._first.clone()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        after = self._next.clone()
        if self._ending:
            world = self._steps % self.batch_size[0]
            self._steps += 1
            for name in ("done", "terminated"):
                after[name][world] = torch.ones(1, dtype=torch.bool)
        return after
