"""A trained policy of Stable-Baselines3: weights as safetensors, all else as JSON."""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.utils import ConstantSchedule
from stable_baselines3.common.vec_env import VecNormalize
from torch.nn.utils import parameters_to_vector

from baselines.policies.policy import Step, TrainedPolicy
from baselines.runs.files import RunError, read_json, reading, write_json
from baselines.runs.tensors import moments_of, read_tensors, with_moments, write_tensors
from baselines.sb3.config import algorithm_class

WEIGHTS, SHAPE, LEARNER = "policy.safetensors", "policy.json", "learner.safetensors"


@dataclass(frozen=True)
class Normalization:
    """The numbers of ``VecNormalize``; mean and variance are of ``count`` observations."""

    mean: np.ndarray
    variance: np.ndarray
    count: float
    epsilon: float
    clip: float

    @classmethod
    def of(cls, env: VecNormalize | None) -> Self | None:
        if env is None:
            return None
        seen: Any = env.obs_rms
        return cls(seen.mean.copy(), seen.var.copy(), seen.count, env.epsilon, env.clip_obs)

    def put_into(self, env: VecNormalize) -> None:
        seen: Any = env.obs_rms
        seen.mean, seen.var, seen.count = self.mean, self.variance, self.count

    @classmethod
    def from_json(cls, values: dict[str, Any] | None) -> Self | None:
        if values is None:
            return None
        arrays = {name: np.asarray(values[name], float) for name in ("mean", "variance")}
        made = cls(**{**values, **arrays})
        if made.mean.shape != made.variance.shape or not all(
            np.isfinite(number).all() for number in vars(made).values()
        ):
            raise RunError("normalization: allowed: finite numbers, as many means as variances")
        return made

    def __call__(self, seen: np.ndarray) -> np.ndarray:
        scaled = (seen - self.mean) / np.sqrt(self.variance + self.epsilon)
        return np.asarray(np.clip(scaled, -self.clip, self.clip), np.float32)

    def to_json(self) -> dict[str, Any]:
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}


class SB3Policy(TrainedPolicy):
    """One policy for every robot's observation, or for the team's, or for the paper's state."""

    # ``shape`` is what :meth:`of` makes. A ``model`` is the learner whose policy this is, and is
    # saved too.
    def __init__(
        self,
        network: BasePolicy,
        shape: Mapping[str, Any],
        normalization: Normalization | None,
        model: BaseAlgorithm | None = None,
    ) -> None:
        self.network, self.shape, self._model = network, shape, model
        self.normalization = normalization
        self.observes = shape["observes"]

    @classmethod
    def of(cls, model: BaseAlgorithm, algorithm: str, observes: str) -> Self:
        names = {kind: name for name, kind in model.policy_aliases.items()}
        network = model.policy
        if hasattr(model, "in_torch"):  # of crossq-sbx, whose networks are those of crossq
            algorithm, network = "crossq", model.in_torch()
        shape = {
            "algorithm": algorithm,
            "observes": observes,
            "policy": names[type(model.policy)],
            "obs_size": spaces.flatdim(model.observation_space),
            "action_shape": list(model.action_space.shape or ()),
            "arguments": {
                name: value
                for name, value in model.policy_kwargs.items()
                if value is not None and not name.startswith("optimizer_")
            },
        }
        normalization = Normalization.of(model.get_vec_normalize_env())
        return cls(network, shape, normalization, model)

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Actions (worlds, n, 2) for states (worlds, 4n+1) or observations (worlds, n, size)."""
        rows = seen.reshape(-1, self.shape["obs_size"])
        rows = rows if self.normalization is None else self.normalization(rows)
        actions, _ = self.network.predict(rows, deterministic=deterministic)
        return np.asarray(actions.reshape(len(seen), -1, 2))

    def step(self, seen: torch.Tensor, past: torch.Tensor | None) -> Step:
        network: Any = self.network
        rows, norm = seen.reshape(-1, self.shape["obs_size"]), self.normalization
        if norm is not None:
            scale = np.sqrt(norm.variance + norm.epsilon)
            scaled = (rows.double() - torch.tensor(norm.mean)) / torch.tensor(scale)
            rows = scaled.clamp(-norm.clip, norm.clip).float()
        if isinstance(network, ActorCriticPolicy):
            parts = [network.mlp_extractor.policy_net, network.action_net]
        elif hasattr(network, "actor"):
            parts = [network.actor.latent_pi, network.actor.mu, torch.nn.Tanh()]
        else:
            parts = [network.action_net]
        means: torch.Tensor = torch.nn.Sequential(*parts)(rows)
        return means.reshape(seen.shape[0], -1, 2), past

    def save(self, folder: Path) -> None:
        normalization = None if self.normalization is None else self.normalization.to_json()
        write_json(folder / SHAPE, {**self.shape, "normalization": normalization})
        write_tensors(folder / WEIGHTS, self.network.state_dict())
        if self._model is not None:
            write_tensors(folder / LEARNER, _learned(self._model))


def _learned(model: Any) -> dict[str, torch.Tensor]:
    tensors = {
        f"{name}/{key}": moment
        for name, state in model.get_parameters().items()
        if name != "policy"
        for key, moment in moments_of(state).items()
    }
    entropy = getattr(model, "log_ent_coef", None)
    learned = {} if entropy is None else {"log_ent_coef": entropy.detach()}
    return {**tensors, **learned, "updates": torch.tensor(model._n_updates)}


def put_into(model: Any, folder: Path) -> None:
    with reading(folder):
        weights = read_tensors(folder / WEIGHTS, model.policy.state_dict())
        learned = read_tensors(folder / LEARNER)
        parameters = model.get_parameters()
        for part, state in parameters.items():
            own = [key for key in learned if key.startswith(f"{part}/")]
            moments = {key.rpartition("/")[2]: learned[key] for key in own}
            parameters[part] = weights if part == "policy" else with_moments(state, moments)
        model.set_parameters(parameters, device=model.device)
        if hasattr(model, "weights"):  # of ARS: the vector that the search moves
            model.weights = parameters_to_vector(model.policy.parameters()).detach()
        if "log_ent_coef" in learned:
            model.log_ent_coef.data.copy_(learned["log_ent_coef"])
        model._n_updates = int(learned["updates"])


def load_policy(folder: Path) -> SB3Policy:
    with reading(folder / SHAPE):
        shape = read_json(folder / SHAPE)
        if shape["observes"] not in ("observations", "state"):
            raise RunError(f"observes: {shape['observes']!r}; allowed: observations, state")
        normalization = Normalization.from_json(shape.pop("normalization"))
        kind: Any = algorithm_class(shape["algorithm"]).policy_aliases[shape["policy"]]
        learns = "lr_schedule" in inspect.signature(kind).parameters
        network = kind(
            spaces.Box(-np.inf, np.inf, (shape["obs_size"],), np.float32),
            spaces.Box(-1.0, 1.0, tuple(shape["action_shape"]), np.float32),
            **({"lr_schedule": ConstantSchedule(0.0)} if learns else {}),
            **shape["arguments"],
        )
    with reading(folder / WEIGHTS):
        network.load_state_dict(read_tensors(folder / WEIGHTS, network.state_dict()))
    return SB3Policy(network, shape, normalization)
