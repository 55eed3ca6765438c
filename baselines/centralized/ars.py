"""Augmented random search, told apart from the library's by two details."""

from __future__ import annotations

from typing import Any

import torch
from sb3_contrib import ARS
from stable_baselines3.common.callbacks import BaseCallback


class PopulationSearch(ARS):  # type: ignore[misc]  # the library ships no types
    """SB3-Contrib's ARS, made to go on exactly where a saved one stopped.

    - A rollout starts before the random directions are drawn, so that what is saved at that moment
      draws the same ones.
    - The search goes on from the parameters that were loaded. The library would begin at zero
      again: it sets its parameter vector when the object is made, and does not save it.
    """

    def _do_one_update(self, callback: BaseCallback, async_eval: Any) -> None:
        callback.on_rollout_start()
        super()._do_one_update(callback, async_eval)

    def set_parameters(self, *arguments: Any, **options: Any) -> None:
        """Load parameters into the policy and into the vector that the search moves."""
        super().set_parameters(*arguments, **options)
        parameters = self.policy.parameters()
        self.weights = torch.nn.utils.parameters_to_vector(parameters).detach()
