"""A learner of the library: made, kept in a checkpoint, resumed, moved to another field."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import unwrap_vec_wrapper

from baselines.algorithms import find_algorithm
from baselines.runs.files import read_arrays, read_json, reading, write_arrays, write_json
from baselines.runs.folder import RunFolder, saved_at
from baselines.runs.tensors import restore_generators, save_generators
from baselines.sb3.config import SB3Config, algorithm_class, model_arguments
from baselines.sb3.envs import ShrinkingRois, engines, make_env
from baselines.sb3.policy import SHAPE, Normalization, SB3Policy, put_into
from baselines.training.aids import RoiCurriculum
from baselines.training.config import Task
from baselines.training.run_logger import EpisodeWindow

WORLDS = "worlds.npz"
REPLAY = "replay.npz"
COUNTERS = "counters.json"
SEEN = ("_last_obs", "_last_original_obs", "_last_episode_starts")
"""The entries of the worlds' last step that a learner keeps."""
COUNTED = ("num_timesteps", "_episode_num")
LOGGED = ("ep_info_buffer", "ep_success_buffer")


class Learner:
    """A fresh learner of the library on the worlds of a task; notes its ``episodes``.

    The library's own ``seed`` would seed the worlds too, which SuperSuit's refuse.

    Attributes:
        model: the library's object.
        stride: rows of a world: the library counts a step of each.
        repeat: env-steps of a decision: the library counts those too, see :meth:`count_repeats`.
    """

    def __init__(self, task: Task, hyperparameters: SB3Config, episodes: EpisodeWindow) -> None:
        config = task.config
        self._algorithm, self._steps, self._aids = config.algorithm, config.steps, hyperparameters
        self._env = make_env(task, hyperparameters, episodes)
        self.stride = self._env.num_envs // hyperparameters.num_envs
        set_random_seed(config.seed, using_cuda=config.device == "cuda")
        self._env.action_space.seed(config.seed)
        self.model: Any = algorithm_class(config.algorithm)(
            hyperparameters.policy,
            self._env,
            device=config.device,
            **model_arguments(hyperparameters),
        )
        self.repeat, self._gamma = 1, getattr(self.model, "gamma", 1.0)
        self._rois = unwrap_vec_wrapper(self._env, ShrinkingRois)
        if self._rois is not None:
            assert isinstance(self.model, OnPolicyAlgorithm)  # no other offers it
            self._rois.every = self.model.n_steps

    @property
    def env_steps(self) -> int:
        """The env-steps so far."""
        return int(self.model.num_timesteps) // self.stride

    @property
    def diagnostics(self) -> dict[str, float]:
        """Numbers for a progress row."""
        return {} if self._rois is None else {"roi_radius": self._rois.curriculum.radius}

    def begin_rollout(self) -> None:
        """Set the env-steps of the next rollout's decisions, and the discount of a decision."""
        if self._aids.action_repeat == (1, 1):
            return
        self.repeat = self._aids.repeat_at(self.env_steps / self._steps)
        self._env.set_attr("action_repeat", self.repeat)
        self.model.gamma = self.model.rollout_buffer.gamma = self._gamma**self.repeat

    def count_repeats(self) -> None:
        """Count the env-steps of a decision that the library does not: all but the first."""
        self.model.num_timesteps += (self.repeat - 1) * self._env.num_envs

    @property
    def policy(self) -> SB3Policy:
        """The policy as it is now."""
        by_robot = find_algorithm(self._algorithm).form == "decentralized"
        observations = by_robot or self._aids.joint_observation
        observes = "observations" if observations else "state"
        return SB3Policy.of(self.model, self._algorithm, observes)

    def begin_with(self, source: RunFolder) -> None:
        """Begin with networks, optimisers and normalisation of another run.

        Raises:
            RunError: the run has saved no policy, or a damaged one.
        """
        self._put(source.policy)

    def _put(self, policy: Path) -> None:
        """Load a saved policy and the normalisation of what it observes."""
        put_into(self.model, policy)
        normalization = Normalization.from_json(read_json(policy / SHAPE)["normalization"])
        if normalization is not None:
            normalization.put_into(self.model.get_vec_normalize_env())

    def save(self, folder: Path) -> None:
        """Write, beside the policy, all else that :meth:`restore` needs into ``folder``."""
        model, worlds = self.model, self._worlds()
        seen = {name: array for name in SEEN if (array := getattr(model, name)) is not None}
        write_arrays(folder / WORLDS, {**worlds, **seen}, compress=True)
        if (buffer := getattr(model, "replay_buffer", None)) is not None:
            filled = buffer.buffer_size if buffer.full else buffer.pos
            arrays = {name: array[:filled] for name, array in _transitions(buffer).items()}
            place = {"pos": np.array(buffer.pos), "full": np.array(buffer.full)}
            write_arrays(folder / REPLAY, {**arrays, **place})
        counters = {
            **{name: getattr(model, name) for name in COUNTED},
            "ep_info_buffer": [
                {name: float(value) for name, value in episode.items()}
                for episode in model.ep_info_buffer
            ],
            "ep_success_buffer": list(map(float, model.ep_success_buffer)),
            "actions": model.action_space.np_random.bit_generator.state,
            "generators": save_generators(),
            "curriculum": None if self._rois is None else asdict(self._rois.curriculum),
        }
        write_json(folder / COUNTERS, counters)

    def _worlds(self) -> dict[str, NDArray[Any]]:
        """The state of every engine, whose number is before the name."""
        return {
            f"{number}/{name}": array
            for number, engine in enumerate(engines(self._env))
            for name, array in engine.save_state().items()
        }

    def restore(self, checkpoint: Path) -> None:
        """Resume the learner of a checkpoint at exactly the same point.

        Raises:
            RunError: a file is missing or damaged, or an older version wrote it.
        """
        with reading(checkpoint):
            self._restore(checkpoint)

    def _restore(self, checkpoint: Path) -> None:
        model = self.model
        model._setup_learn(0)  # makes what is filled here
        self._put(checkpoint / "policy")
        counters = read_json(checkpoint / COUNTERS)
        arrays = read_arrays(checkpoint / WORLDS)
        for name in SEEN:
            seen, own = arrays.get(name), getattr(model, name)
            if getattr(seen, "shape", None) != getattr(own, "shape", None):
                raise ValueError(f"{WORLDS}: {name} is of other worlds")
            setattr(model, name, seen)
        if self._rois is not None:
            self._rois.begin(TypeAdapter(RoiCurriculum).validate_python(counters["curriculum"]))
        for number, engine in enumerate(engines(self._env)):
            own = [key for key in arrays if key.startswith(f"{number}/")]
            engine.load_state({key.partition("/")[2]: arrays[key] for key in own})
        if (buffer := getattr(model, "replay_buffer", None)) is not None:
            saved = read_arrays(checkpoint / REPLAY)
            for name, array in _transitions(buffer).items():
                array[: len(saved[name])] = saved[name]
            buffer.pos, buffer.full = int(saved["pos"]), bool(saved["full"])
            if not 0 <= buffer.pos < buffer.buffer_size:
                raise ValueError(f"{REPLAY}: pos {buffer.pos}; allowed: below buffer_size")
        for name in COUNTED:
            setattr(model, name, int(counters[name]))
        saved_at(checkpoint, self.env_steps)
        for name in LOGGED:
            getattr(model, name).extend(counters[name])
        model.action_space.np_random.bit_generator.state = counters["actions"]
        restore_generators(counters["generators"])


def _transitions(buffer: ReplayBuffer) -> dict[str, NDArray[Any]]:
    """The arrays of a replay buffer that have a row for every transition."""
    arrays = {name: value for name, value in vars(buffer).items() if isinstance(value, np.ndarray)}
    return {name: array for name, array in arrays.items() if len(array) == buffer.buffer_size}
