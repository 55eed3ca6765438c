"""A learner of shared-policy PPO in a checkpoint, without pickle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from safetensors import torch as safetensors_torch
from stable_baselines3 import PPO

from baselines.generators import restore_generators, save_generators
from baselines.optimizers import moments_of, restore_moments
from baselines.shared.policy import load_policy
from baselines.shared.worlds import engines
from baselines.storage import read_arrays, read_json, write_arrays, write_json

MOMENTS = "optimizer.safetensors"
WORLDS = "worlds.npz"
COUNTERS = "counters.json"


def save(model: PPO, folder: Path) -> None:
    """Write, beside its policy, all else that :func:`restore` needs into ``folder``."""
    safetensors_torch.save_file(moments_of(model.policy.optimizer), folder / MOMENTS)
    worlds = {
        f"{number}/{name}": array
        for number, engine in enumerate(engines(model.get_env()))
        for name, array in engine.save_state().items()
    }
    seen = {"observations": model._last_obs, "episode_starts": model._last_episode_starts}
    write_arrays(folder / WORLDS, {**worlds, **seen}, compress=True)
    counters = {
        "num_timesteps": model.num_timesteps,
        "updates": model._n_updates,
        "episodes": list(model.ep_info_buffer),
        "successes": list(model.ep_success_buffer),
        "generators": save_generators(),
    }
    write_json(folder / COUNTERS, counters)


def restore(model: PPO, checkpoint: Path) -> None:
    """Take up the learner of a checkpoint at exactly the same point.

    Args:
        model: a fresh learner of the same hyperparameters, on worlds of the same task.
        checkpoint: where it was saved.

    Raises:
        RunError: a file is missing or damaged.
    """
    model._setup_learn(0)  # makes what is filled here, and would be made anew without it
    policy = load_policy(checkpoint / "policy")
    model.policy.load_state_dict(policy.network.state_dict())
    if policy.normalization is not None:
        policy.normalization.put_into(model.get_vec_normalize_env())
    restore_moments(model.policy.optimizer, safetensors_torch.load_file(checkpoint / MOMENTS))
    saved = read_arrays(checkpoint / WORLDS)
    model._last_obs = saved.pop("observations")
    model._last_episode_starts = saved.pop("episode_starts")
    worlds: dict[str, dict[str, NDArray[Any]]] = {}
    for key, array in saved.items():
        number, name = key.split("/")
        worlds.setdefault(number, {})[name] = array
    for number, engine in enumerate(engines(model.get_env())):
        engine.load_state(worlds[str(number)])
    counters = read_json(checkpoint / COUNTERS)
    model.num_timesteps, model._n_updates = counters["num_timesteps"], counters["updates"]
    model.ep_info_buffer.extend(counters["episodes"])
    model.ep_success_buffer.extend(counters["successes"])
    restore_generators(counters["generators"])
