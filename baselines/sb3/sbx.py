"""CrossQ of sbx, by the authors of Stable-Baselines3: JAX learns, SB3-Contrib's networks act."""

import os
from collections.abc import Mapping
from operator import itemgetter
from typing import Any, ClassVar

import jax
import numpy as np
import sbx
import torch
from gymnasium import spaces
from jax import Array
from sb3_contrib.common.torch_layers import BatchRenorm1d
from sb3_contrib.crossq.policies import CrossQPolicy
from stable_baselines3.common.utils import ConstantSchedule
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn
from torch import nn

# One thread, as torch has in training: XLA's sums are in another order for each number of threads.
# It reads this at its first computation.
os.environ.setdefault("NPROC", "1")


class FlatActions(VecEnvWrapper):
    """Worlds whose actions (n, 2) are flat, as the library's critics need them."""

    def __init__(self, venv: VecEnv) -> None:
        self._shape = venv.action_space.shape or ()
        size = spaces.flatdim(venv.action_space)
        super().__init__(venv, action_space=spaces.Box(-1.0, 1.0, (size,)))

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        self.venv.step_async(actions.reshape(-1, *self._shape))

    def step_wait(self) -> VecEnvStepReturn:
        return self.venv.step_wait()


class CrossQ(sbx.CrossQ):
    policy_aliases: ClassVar[dict[str, Any]] = {"MlpPolicy": sbx.CrossQ.policy_aliases["MlpPolicy"]}

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return FlatActions(env)

    def _setup_model(self) -> None:
        super()._setup_model()
        where = self.observation_space, self.action_space
        self._network = CrossQPolicy(*where, ConstantSchedule(0.0), **self.policy_kwargs)

    def in_torch(self) -> CrossQPolicy:
        policy, network = self.policy, self._network
        _copy(policy.actor_state.params, policy.actor_state.batch_stats, network.actor)
        state = policy.qf_state
        critics = [part["VmapCritic_0"] for part in (state.params, state.batch_stats)]
        for index, critic in enumerate(network.critic.q_networks):
            parameters, statistics = jax.tree.map(itemgetter(index), critics)
            _copy(parameters, statistics, critic)
        return network

    def get_parameters(self) -> dict[str, dict[str, Any]]:
        """Return all that it learns, and its random keys, in the form of an optimiser's state."""
        leaves = jax.tree.leaves(self._learned())
        return {"jax": {"state": {i: {"leaf": _tensor(leaf)} for i, leaf in enumerate(leaves)}}}

    def set_parameters(
        self, load_path_or_dict: Any, exact_match: bool = True, device: Any = "auto"
    ) -> None:
        leaves, tree = jax.tree.flatten(self._learned())
        saved = load_path_or_dict["jax"]["state"]
        types = [jax.numpy.asarray(leaf).dtype for leaf in leaves]
        new = [jax.numpy.asarray(saved[i]["leaf"].numpy(), kind) for i, kind in enumerate(types)]
        actor, critics, entropy, self.key, *keys = jax.tree.unflatten(tree, new)
        self.policy.actor_state, self.policy.qf_state, self.ent_coef_state = actor, critics, entropy
        self.policy.key, self.policy.noise_key = keys

    def _learned(self) -> tuple[Any, ...]:
        policy = self.policy
        states = policy.actor_state, policy.qf_state, self.ent_coef_state
        return *states, self.key, policy.key, policy.noise_key


def _copy(parameters: Mapping[str, Any], statistics: Mapping[str, Any], into: nn.Module) -> None:
    for index, linear in enumerate(_layers(into, nn.Linear)):
        dense = parameters[f"Dense_{index}"]
        _fill(linear, weight=dense["kernel"].T, bias=dense["bias"])
    for index, renorm in enumerate(_layers(into, BatchRenorm1d)):
        own, seen = (part[f"BatchRenorm_{index}"] for part in (parameters, statistics))
        _fill(renorm, ra_mean=seen["mean"], ra_var=seen["var"], steps=seen["steps"], **own)


def _layers(module: nn.Module, kind: type[nn.Module]) -> list[nn.Module]:
    return [layer for layer in module.modules() if isinstance(layer, kind)]


def _fill(layer: nn.Module, **leaves: Array) -> None:
    layer.load_state_dict({name: _tensor(leaf) for name, leaf in leaves.items()})


def _tensor(leaf: Array | float) -> torch.Tensor:
    array = np.array(leaf)  # of keys, torch has few operations on unsigned numbers
    return torch.from_numpy(array.astype(np.int64) if array.dtype.kind == "u" else array)
