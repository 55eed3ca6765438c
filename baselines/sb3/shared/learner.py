"""A learner of shared-policy PPO in a checkpoint, without pickle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from baselines.runs.files import read_arrays, read_json, write_arrays, write_json
from baselines.runs.rng_state import restore_generators, save_generators
from baselines.runs.tensors import moments_of, read_tensors, restore_moments, write_tensors
from baselines.sb3.shared.envs import engines
from baselines.sb3.shared.policy import load_policy

MOMENTS = "optimizer.safetensors"
WORLDS = "worlds.npz"
COUNTERS = "counters.json"


def save(model: BaseAlgorithm, folder: Path) -> None:
    """Write, beside its policy, all else that :func:`restore` needs into ``folder``."""
    ppo: Any = model
    write_tensors(folder / MOMENTS, moments_of(ppo.policy.optimizer))
    worlds = {
        f"{number}/{name}": array
        for number, engine in enumerate(engines(ppo.get_env()))
        for name, array in engine.save_state().items()
    }
    seen = {"observations": ppo._last_obs, "episode_starts": ppo._last_episode_starts}
    write_arrays(folder / WORLDS, {**worlds, **seen}, compress=True)
    counters = {
        "num_timesteps": ppo.num_timesteps,
        "updates": ppo._n_updates,
        "episodes": list(ppo.ep_info_buffer),
        "successes": list(ppo.ep_success_buffer),
        "generators": save_generators(),
    }
    write_json(folder / COUNTERS, counters)


def restore(model: BaseAlgorithm, checkpoint: Path) -> None:
    """Take up the learner of a checkpoint at exactly the same point.

    Args:
        model: a fresh learner of the same hyperparameters, on worlds of the same task.
        checkpoint: where it was saved.

    Raises:
        RunError: a file is missing or damaged.
    """
    ppo: Any = model
    ppo._setup_learn(0)  # makes what is filled here, and would be made anew without it
    policy = load_policy(checkpoint / "policy")
    ppo.policy.load_state_dict(policy.network.state_dict())
    if policy.normalization is not None:
        policy.normalization.put_into(ppo.get_vec_normalize_env())
    restore_moments(ppo.policy.optimizer, read_tensors(checkpoint / MOMENTS))
    saved = read_arrays(checkpoint / WORLDS)
    ppo._last_obs = saved.pop("observations")
    ppo._last_episode_starts = saved.pop("episode_starts")
    worlds: dict[str, dict[str, NDArray[Any]]] = {}
    for key, array in saved.items():
        number, name = key.split("/")
        worlds.setdefault(number, {})[name] = array
    for index, engine in enumerate(engines(ppo.get_env())):
        engine.load_state(worlds[str(index)])
    counters = read_json(checkpoint / COUNTERS)
    ppo.num_timesteps, ppo._n_updates = counters["num_timesteps"], counters["updates"]
    ppo.ep_info_buffer.extend(counters["episodes"])
    ppo.ep_success_buffer.extend(counters["successes"])
    restore_generators(counters["generators"])
