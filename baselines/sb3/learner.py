"""A learner of the library on disk: kept in a checkpoint, taken up again, moved to a new field."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from baselines.runs.files import read_arrays, read_json, write_arrays, write_json
from baselines.runs.folder import RunFolder
from baselines.runs.rng_state import restore_generators, save_generators
from baselines.sb3.policy import (
    MODEL,
    NORMALIZATION,
    CentralizedPolicy,
    Normalization,
    load_model,
    model_file,
)
from baselines.training.config import Task
from mbn_marl.adapters.sb3 import CentralizedVecEnv

WORLDS = "worlds.npz"
REPLAY = "replay.npz"
GENERATORS = "generators.json"


def policy_of(model: BaseAlgorithm) -> CentralizedPolicy:
    """The policy of a learner as it is now."""
    return CentralizedPolicy(model, Normalization.of(model.get_vec_normalize_env()))


def save(model: BaseAlgorithm, folder: Path) -> None:
    """Write, beside its policy, all else that :func:`restore` needs into ``folder``.

    The policy's file has the networks, optimisers and counters; here are the worlds, the replay
    buffer as far as it is filled, and the random number generators.
    """
    worlds = _worlds_of(model.get_env())
    write_arrays(folder / WORLDS, worlds.engine.save_state(), compress=True)
    if isinstance(model, OffPolicyAlgorithm):
        buffer = _buffer_of(model)
        filled = buffer.buffer_size if buffer.full else buffer.pos
        arrays = {name: array[:filled] for name, array in _transitions(buffer).items()}
        place = {"pos": np.array(buffer.pos), "full": np.array(buffer.full)}
        write_arrays(folder / REPLAY, {**arrays, **place})
    generators = {"global": save_generators(), "actions": _state_of(model)}
    write_json(folder / GENERATORS, generators)


def restore(task: Task, env: VecEnv, checkpoint: Path, *, trust: bool) -> BaseAlgorithm:
    """The learner of a checkpoint, on ``env``, at exactly the same point.

    Args:
        task: what is trained.
        env: its worlds.
        checkpoint: the folder.
        trust: load it whoever made it.

    Raises:
        RunError: a file is missing or damaged, or was made by someone else.
    """
    path, options = checkpoint / "policy" / MODEL, {"device": task.config.device, "env": env}
    model = load_model(task.config.algorithm, path, trust=trust, force_reset=False, **options)
    normalizing = model.get_vec_normalize_env()
    if normalizing is not None:
        saved_normalization = read_json(checkpoint / "policy" / NORMALIZATION)
        Normalization.from_json(saved_normalization).put_into(normalizing)
    if isinstance(model, OffPolicyAlgorithm):
        saved, buffer = read_arrays(checkpoint / REPLAY), _buffer_of(model)
        for name, array in _transitions(buffer).items():
            array[: len(saved[name])] = saved[name]
        buffer.pos, buffer.full = int(saved["pos"]), bool(saved["full"])
    worlds = _worlds_of(env)
    worlds._reset_seeds()  # the library has seeded them again, from the next reset on
    worlds.engine.load_state(read_arrays(checkpoint / WORLDS))
    generators = read_json(checkpoint / GENERATORS)
    model.action_space.np_random.bit_generator.state = generators["actions"]
    restore_generators(generators["global"])
    return model


def transfer(task: Task, env: VecEnv, source: RunFolder) -> BaseAlgorithm:
    """A learner that begins with the networks and optimisers of another run.

    Counters, replay buffer and random numbers begin anew.

    Raises:
        RunError: the run has saved no policy or a damaged one, or someone else made it.
    """
    options = {"device": task.config.device, "env": env, "seed": task.config.seed}
    algorithm, path = task.config.algorithm, model_file(source)
    model = load_model(algorithm, path, trust=source.trust, **options)
    model.num_timesteps = 0
    return model


def _worlds_of(env: VecEnv | None) -> CentralizedVecEnv:
    """The worlds inside the wrappers of a learner's environment."""
    worlds = None if env is None else env.unwrapped
    assert isinstance(worlds, CentralizedVecEnv)
    return worlds


def _buffer_of(model: OffPolicyAlgorithm) -> ReplayBuffer:
    """The replay buffer of a learner."""
    buffer = model.replay_buffer
    assert buffer is not None
    return buffer


def _transitions(buffer: ReplayBuffer) -> dict[str, NDArray[Any]]:
    """The arrays of a replay buffer that have a row for every transition."""
    arrays = {name: value for name, value in vars(buffer).items() if isinstance(value, np.ndarray)}
    return {name: array for name, array in arrays.items() if len(array) == buffer.buffer_size}


def _state_of(model: BaseAlgorithm) -> Any:
    """The state of the generator that draws random actions before learning starts."""
    return model.action_space.np_random.bit_generator.state
