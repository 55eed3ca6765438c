"""The one trainer of Stable-Baselines3's algorithms: a learner, its checkpoints, its log."""

import inspect
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter
from sb3_contrib import ARS
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from baselines.algorithms import find_algorithm
from baselines.runs.files import read_arrays, read_json, reading, write_arrays, write_json
from baselines.runs.folder import RunFolder, saved_at
from baselines.runs.tensors import restore_generators, save_generators
from baselines.sb3.config import SB3Config, algorithm_class, model_arguments
from baselines.sb3.policy import SHAPE, Normalization, SB3Policy, put_into
from baselines.training.aids import RoiCurriculum
from baselines.training.config import Budget, Task
from baselines.training.run_logger import ROW_STEPS, EpisodeWindow, Recorder
from mbn_marl.adapters.sb3 import CentralizedVecEnv, NavigationVecEnv, SharedPolicyVecEnv
from mbn_marl.config import make_config
from mbn_marl.errors import ConfigError, MbnError

WORLDS, REPLAY, COUNTERS = "worlds.npz", "replay.npz", "counters.json"
# The entries of the worlds' last step that a learner keeps.
SEEN = ("_last_obs", "_last_original_obs", "_last_episode_starts")
COUNTED = ("num_timesteps", "_episode_num")
LOGGED = ("ep_info_buffer", "ep_success_buffer")


class TrainingWorlds(VecEnvWrapper):
    """Worlds as the learner gets them: rewards scaled, episodes noted, ROIs of a changing size."""

    venv: NavigationVecEnv

    def __init__(
        self,
        make: Callable[[RoiCurriculum], NavigationVecEnv],
        curriculum: RoiCurriculum,
        episodes: EpisodeWindow,
        scale: float = 1.0,
    ) -> None:
        self._make, self.curriculum, self._episodes, self._scale = make, curriculum, episodes, scale
        super().__init__(make(curriculum))
        # The size of ROIs may change after so many steps: the rollout of an on-policy learner.
        self.every, self._steps = 1, 0
        # A world has so many rows, of which the first one reports its episodes. The curriculum
        # counts those of every row.
        self.stride = self.num_envs // curriculum.window
        curriculum.window = self.num_envs

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        observations: Any
        observations, rewards, dones, infos = self.venv.step_wait()
        ended = np.flatnonzero(dones)
        self.curriculum.add([infos[row]["is_success"] for row in ended])
        worlds = [infos[row] for row in ended if row % self.stride == 0]
        self._episodes.add(
            [info["episode_return"] for info in worlds], [info["is_success"] for info in worlds]
        )
        self._steps += 1
        if self._steps % self.every == 0 and self.curriculum.move():
            # Episodes that still run are cut off here: the learner bootstraps from the value of
            # their own last observation, not from that of the new worlds' first.
            for row in np.flatnonzero(~dones):
                cut = {"TimeLimit.truncated": True, "terminal_observation": observations[row]}
                infos[row].update(cut)
            observations, dones = self.begin(self.curriculum), np.ones_like(dones)
        return observations, rewards * self._scale, dones, infos

    def begin(self, curriculum: RoiCurriculum) -> VecEnvObs:
        self.curriculum, self.venv = curriculum, self._make(curriculum)
        return self.venv.reset()


def make_env(
    task: Task, hyperparameters: SB3Config, episodes: EpisodeWindow
) -> tuple[TrainingWorlds, VecEnv]:
    """The worlds of training: a row for each, or row ``w * n + i`` for robot i of world w."""
    # The second is what the learner sees, which may be normalised.
    count, config = hyperparameters.num_envs, task.config

    def make(curriculum: RoiCurriculum) -> NavigationVecEnv:
        how: dict[str, Any] = {"seed": curriculum.seed(config.seed), "threads": 1}
        how |= hyperparameters.in_training(task, curriculum, count)
        if config.algorithm == "ppo-shared":
            return SharedPolicyVecEnv(num_worlds=count, **how)
        joint = hyperparameters.joint_observation
        return CentralizedVecEnv(num_envs=count, joint_observation=joint, **how)

    curriculum = RoiCurriculum(hyperparameters.roi_radius, window=count)
    worlds = TrainingWorlds(make, curriculum, episodes, hyperparameters.reward_scale)
    normalized = hyperparameters.normalize_observation
    return worlds, VecNormalize(worlds, norm_reward=False) if normalized else worlds


class ResumableARS(ARS):
    """ARS whose rollouts begin before their directions are drawn, so that it can be saved there."""

    def _do_one_update(self, callback: BaseCallback, async_eval: Any) -> None:
        callback.on_rollout_start()
        # The library counts a resumed run's progress from where it was resumed.
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        super()._do_one_update(callback, async_eval)


class Learner:
    def __init__(self, task: Task, hyperparameters: SB3Config, episodes: EpisodeWindow) -> None:
        config = task.config
        self._algorithm, self._aids = config.algorithm, hyperparameters
        self.worlds, env = make_env(task, hyperparameters, episodes)
        self.stride = self.worlds.stride  # the library counts a step of each row
        set_random_seed(config.seed, using_cuda=config.device == "cuda")
        kind: Any = algorithm_class(config.algorithm)
        self.model: Any = (ResumableARS if kind is ARS else kind)(
            hyperparameters.policy, env, device=config.device, **model_arguments(hyperparameters)
        )
        self.model.action_space.seed(config.seed)
        self.worlds.every = getattr(self.model, "n_steps", 1)

    @property
    def env_steps(self) -> int:
        return int(self.model.num_timesteps) // self.stride

    @property
    def diagnostics(self) -> dict[str, float]:
        curriculum = self.worlds.curriculum
        return {"roi_radius": curriculum.radius} if curriculum.first > 1.0 else {}

    @property
    def policy(self) -> SB3Policy:
        by_robot = find_algorithm(self._algorithm).form == "decentralized"
        observations = by_robot or self._aids.joint_observation
        observes = "observations" if observations else "state"
        return SB3Policy.of(self.model, self._algorithm, observes)

    def begin_with(self, policy: Path) -> None:
        put_into(self.model, policy)
        normalization = Normalization.from_json(read_json(policy / SHAPE)["normalization"])
        if normalization is not None:
            normalization.put_into(self.model.get_vec_normalize_env())

    def save(self, folder: Path) -> None:
        model, worlds = self.model, self.worlds.venv.engine.save_state()
        seen = {name: array for name in SEEN if (array := getattr(model, name)) is not None}
        write_arrays(folder / WORLDS, {**worlds, **seen}, compress=True)
        if (buffer := getattr(model, "replay_buffer", None)) is not None:
            filled = buffer.buffer_size if buffer.full else buffer.pos
            arrays = {name: array[:filled] for name, array in _transitions(buffer).items()}
            place = {"pos": np.array(buffer.pos), "full": np.array(buffer.full)}
            write_arrays(folder / REPLAY, {**arrays, **place})
        episodes = [{k: float(v) for k, v in one.items()} for one in model.ep_info_buffer]
        counters = {
            **{name: getattr(model, name) for name in COUNTED},
            "ep_info_buffer": episodes,
            "ep_success_buffer": list(map(float, model.ep_success_buffer)),
            "actions": model.action_space.np_random.bit_generator.state,
            "generators": save_generators(),
            "curriculum": asdict(self.worlds.curriculum),
        }
        write_json(folder / COUNTERS, counters)

    def restore(self, checkpoint: Path, began: int) -> None:
        model, counters = self.model, read_json(checkpoint / COUNTERS)
        model._setup_learn(0)  # makes what is filled here
        self.begin_with(checkpoint / "policy")
        self.worlds.begin(TypeAdapter(RoiCurriculum).validate_python(counters["curriculum"]))
        arrays = read_arrays(checkpoint / WORLDS)
        for name in SEEN:
            seen, own = arrays.pop(name, None), getattr(model, name)
            # without normalization the library keeps no original observation until its first step
            if own is not None and getattr(seen, "shape", None) != own.shape:
                raise ValueError(f"{WORLDS}: {name} is of other worlds")
            setattr(model, name, seen)
        self.worlds.venv.engine.load_state(arrays)
        if (buffer := getattr(model, "replay_buffer", None)) is not None:
            saved = read_arrays(checkpoint / REPLAY)
            for name, array in _transitions(buffer).items():
                array[: len(saved[name])] = saved[name]
            buffer.pos, buffer.full = int(saved["pos"]), bool(saved["full"])
            if not 0 <= buffer.pos < buffer.buffer_size:
                raise ValueError(f"{REPLAY}: pos {buffer.pos}; allowed: below buffer_size")
        for name in COUNTED:
            setattr(model, name, int(counters[name]))
        saved_at(checkpoint, began + self.env_steps)
        for name in LOGGED:
            getattr(model, name).extend(counters[name])
        model.action_space.np_random.bit_generator.state = counters["actions"]
        restore_generators(counters["generators"])


def _transitions(buffer: ReplayBuffer) -> dict[str, NDArray[Any]]:
    arrays = {name: value for name, value in vars(buffer).items() if isinstance(value, np.ndarray)}
    return {name: array for name, array in arrays.items() if len(array) == buffer.buffer_size}


class LearnerEndedError(Exception):
    """Ends ``learn`` before a rollout; a callback's False ends it a step later, and ARS never."""


class Reporter(BaseCallback, KVWriter):
    def __init__(self, recorder: Recorder, learner: Learner) -> None:
        super().__init__()
        self._recorder, self._learner, self._reported = recorder, learner, 0

    def _on_training_start(self) -> None:
        self._recorder.start()
        self._reported = self._learner.env_steps

    def _on_rollout_start(self) -> None:
        self._report()
        learner = self._learner
        begun = learner.worlds.curriculum.begun
        more = self._recorder.has_more(learner.env_steps, begun=begun)
        if self._recorder.checkpoint_due:
            self._recorder.save_checkpoint(learner.env_steps, learner.policy, learner.save)
        if not more:
            raise LearnerEndedError

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._report()

    def _report(self) -> None:
        learner = self._learner
        if (env_steps := learner.env_steps) > self._reported:
            self._recorder.update(env_steps, lambda: learner.policy, learner.diagnostics)
            self._reported = env_steps

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        values = {
            name: float(value)
            for name, value in key_values.items()
            if "tensorboard" not in key_excluded[name] and isinstance(value, Real)
        }
        self._recorder.scalars(self._recorder.began + step // self._learner.stride, values)

    def close(self) -> None:
        pass  # the recorder does


def train(task: Task, hyperparameters: SB3Config, recorder: Recorder) -> None:
    learner = Learner(task, hyperparameters, recorder.episodes)
    model, stride = learner.model, learner.stride
    if recorder.checkpoint is not None:
        with reading(recorder.checkpoint):
            learner.restore(recorder.checkpoint, recorder.began)
    elif task.config.transferred_from is not None:
        learner.begin_with(RunFolder.open(task.config.transferred_from).policy)
    reporter = Reporter(recorder, learner)
    model.set_logger(Logger(None, [reporter]))
    log_interval = 4  # episodes, or updates of ARS; below rollouts
    if isinstance(model, OnPolicyAlgorithm):
        log_interval = math.ceil(ROW_STEPS * stride / (model.n_steps * model.n_envs))
    if (parts := recorder.left / task.config.steps) > 1.0:
        whole = model._update_current_progress_remaining

        def update(taken: int, total: int) -> None:
            whole(taken, total)
            left = 1.0 - parts * (1.0 - model._current_progress_remaining)
            model._current_progress_remaining = max(0.0, left)

        model._update_current_progress_remaining = update
    with suppress(LearnerEndedError):
        model.learn(
            recorder.left * stride - model.num_timesteps,
            callback=reporter,
            log_interval=log_interval,
            reset_num_timesteps=recorder.checkpoint is None,
        )
    recorder.finish(learner.env_steps, learner.policy)


def check(task: Task, hyperparameters: SB3Config) -> None:
    try:
        Learner(task, hyperparameters, EpisodeWindow())
    except MbnError:
        raise
    except Exception as error:  # whatever the library and torch have against them
        place = task.config.hyperparams or f"hyperparameters of {task.config.algorithm}"
        what = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(str(place), [f"no learner can be made with them: {what}"]) from error


def budget(task: Task, hyperparameters: SB3Config) -> Budget:
    library = algorithm_class(task.config.algorithm)
    known = inspect.signature(library).parameters.values()
    model = {one.name: one.default for one in known} | hyperparameters.model
    steps, worlds = task.config.steps, hyperparameters.num_envs
    if library is ARS:
        episodes = 2 * model["n_delta"] * model["n_eval_episodes"]
        # Worlds that have no episode left step beside the others, and the library counts them.
        rounds = 2 * model["n_delta"] * worlds * -(-model["n_eval_episodes"] // worlds)
        longest = rounds * make_config(task.settings).max_steps
        return Budget(steps - 1 + longest, f"updates from {episodes} whole episodes", exact=False)
    length = model["n_steps"] if issubclass(library, OnPolicyAlgorithm) else model["train_freq"]
    rollout = length * worlds
    return Budget(-(-steps // rollout) * rollout, f"rollouts of {length} steps in {worlds} worlds")
