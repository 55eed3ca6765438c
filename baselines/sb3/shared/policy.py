"""A trained shared policy: the library's network, saved without pickle."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import ConstantSchedule

from baselines.runs.files import RunError, read_json, write_json
from baselines.runs.folder import RunFolder
from baselines.runs.tensors import read_tensors, write_tensors
from baselines.sb3.policy import Normalization

WEIGHTS = "policy.safetensors"
SHAPE = "policy.json"


class SharedPolicy:
    """Every robot acts on its own observation, all with the same network.

    Args:
        network: actor and critic.
        arguments: of the network's class, beside spaces and learning rate (JSON values).
        normalization: of the observations; ``None`` if it sees them raw.
    """

    observes: Literal["observations", "state"] = "observations"

    def __init__(
        self,
        network: BasePolicy,
        arguments: dict[str, Any],
        normalization: Normalization | None,
    ) -> None:
        self.network = network
        self.arguments = arguments
        self.normalization = normalization

    @classmethod
    def of(cls, model: BaseAlgorithm) -> SharedPolicy:
        """The policy of a learner as it is now."""
        arguments = {"use_sde": model.use_sde, **model.policy_kwargs}
        return cls(model.policy, arguments, Normalization.of(model.get_vec_normalize_env()))

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Actions (worlds, n, 2) for observations (worlds, n, obs_size)."""
        rows = seen.reshape(-1, seen.shape[-1])
        rows = rows if self.normalization is None else self.normalization(rows)
        actions, _ = self.network.predict(rows, deterministic=deterministic)
        return actions.reshape(*seen.shape[:2], 2)

    def save(self, folder: Path) -> None:
        """Write the weights (safetensors), and shape and normalisation (JSON), into ``folder``."""
        normalization = None if self.normalization is None else self.normalization.to_json()
        shape = {
            "obs_size": spaces.flatdim(self.network.observation_space),
            "arguments": self.arguments,
            "normalization": normalization,
        }
        write_json(folder / SHAPE, shape)
        write_tensors(folder / WEIGHTS, self.network.state_dict())


def load_policy(folder: Path) -> SharedPolicy:
    """Load a policy that :meth:`SharedPolicy.save` wrote.

    Raises:
        RunError: a file is missing or damaged.
    """
    shape = read_json(folder / SHAPE)
    network = PPO.policy_aliases["MlpPolicy"](
        spaces.Box(-np.inf, np.inf, (shape["obs_size"],), np.float32),
        spaces.Box(-1.0, 1.0, (2,), np.float32),
        ConstantSchedule(0.0),
        **shape["arguments"],
    )
    try:
        network.load_state_dict(read_tensors(folder / WEIGHTS))
    except RuntimeError as error:
        raise RunError(f"{folder / WEIGHTS} does not fit {SHAPE}: {error}") from None
    normalization = shape["normalization"]
    if normalization is not None:
        normalization = Normalization.from_json(normalization)
    return SharedPolicy(network, shape["arguments"], normalization)


def load(run: RunFolder) -> SharedPolicy:
    """Load the latest policy of a run."""
    return load_policy(run.policy)
