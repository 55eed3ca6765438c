"""Stable-Baselines3: the engine's worlds as one native ``VecEnv``.

:class:`CentralizedVecEnv` shows the single MDP (one row per world), :class:`SharedPolicyVecEnv`
the decentralised form with a policy shared by all robots (one row per robot of each world).
Worlds step together in one compiled call: no subprocesses, no wrapper per world.

What Stable-Baselines3 expects of the infos, and what a row therefore gets:

- at every step ``TimeLimit.truncated``: the episode ended by ``max_steps`` and nothing else;
- at the last step of an episode also ``terminal_observation``, ``is_success``, ``episode``
  (``r``, ``l`` and ``t``: return, length and seconds, as ``Monitor`` writes them, so that
  ``ep_rew_mean`` and ``success_rate`` are logged without a wrapper) and the metrics of the episode.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Unpack

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from mbn_marl.config import Settings
from mbn_marl.engine import BatchEngine, FieldLike
from mbn_marl.errors import ActionError, MbnError, StepError

if TYPE_CHECKING:
    from mbn_marl.engine import Snapshot


class NavigationVecEnv(VecEnv):
    """What the two forms share: stepping, automatic reset, seeding and infos.

    The worlds have one seed: ``seed(s)`` takes effect at the next ``reset``, as always in
    Stable-Baselines3, and only its first number is used; the engine derives a stream of its own
    for each world from it.

    All rows live in one object. ``get_attr`` and ``set_attr`` therefore read and write this object
    (or read the engine), and ``env_method(name, ..., indices=rows)`` calls this object's method
    once for each row, with the row's index as the first argument.

    Args:
        engine: the worlds.
        rows_per_world: 1 for the single MDP, n for a row for each robot.
        observation_space: of a row.
        action_space: of a row.

    Attributes:
        engine: the engine; look at it, but let only this object step and reset it.
    """

    render_mode: str | None = None

    def __init__(
        self,
        engine: BatchEngine,
        rows_per_world: int,
        observation_space: spaces.Box,
        action_space: spaces.Box,
    ) -> None:
        self.engine = engine
        self._rows_per_world = rows_per_world
        self._actions: NDArray[Any] | None = None
        self._start_time = time.time()
        super().__init__(engine.num_worlds * rows_per_world, observation_space, action_space)

    @abstractmethod
    def _observations(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """A fresh array of observations by row, from the engine's ``(num_worlds, n, obs_size)``."""

    @abstractmethod
    def _final_observations(self) -> NDArray[Any]:
        """The last observations of the episodes that have just ended, in those worlds' rows."""

    @abstractmethod
    def _rewards(self, rewards: NDArray[Any]) -> NDArray[np.float32]:
        """A fresh array of rewards by row, from the engine's ``(num_worlds, n)``."""

    @abstractmethod
    def _by_row(self, metric: NDArray[Any]) -> NDArray[Any]:
        """One value for each row, from a metric ``(num_worlds,)`` or ``(num_worlds, n)``."""

    @abstractmethod
    def _returns(self, metrics: dict[str, NDArray[Any]]) -> NDArray[Any]:
        """The return of each row's episode."""

    def reset(self) -> NDArray[Any]:
        """Start a new episode in every world.

        Returns:
            The observations, ``(num_envs, *observation_space.shape)``, a fresh array in the units
            of the class.
        """
        observations = self.engine.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self._actions = None
        return self._observations(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of the next step.

        Args:
            actions: ``(num_envs, *action_space.shape)``, per-axis shares of the full force;
                numbers outside [-1, 1] are clipped.

        Raises:
            ActionError: the shape is another one.
        """
        expected = (self.num_envs, *(self.action_space.shape or ()))
        if np.shape(actions) != expected:
            raise ActionError(f"actions: shape {np.shape(actions)}, expected {expected}")
        engine = self.engine
        self._actions = np.reshape(actions, (engine.num_worlds, engine.n_robots, 2))

    def step_wait(self) -> VecEnvStepReturn:
        """Step every world; worlds that end are reset at once.

        Returns:
            The four ``(observations, rewards, dones, infos)``, with rewards float32 and dones bool,
            each ``(num_envs,)``. Where a row is done its observation is the next episode's first
            one and its info has the last one. All of it is fresh: the caller may keep or change it.

        Raises:
            ActionError: an action is not finite; nothing has moved.
            StepError: there are no actions to step with, or no reset came before.
        """
        if self._actions is None:
            raise StepError("step_wait: no actions; call step_async(actions) after a reset first")
        actions, self._actions = self._actions, None
        observations, rewards, terminated, truncated = self.engine.step(actions)
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(self.num_envs)]
        dones = np.repeat(terminated | truncated, self._rows_per_world)
        if dones.any():
            timeouts = np.repeat(truncated & ~terminated, self._rows_per_world)
            self._close_episodes(infos, np.flatnonzero(dones), timeouts)
        return self._observations(observations), self._rewards(rewards), dones, infos

    def _close_episodes(
        self, infos: list[dict[str, Any]], ended: NDArray[np.intp], timeouts: NDArray[np.bool_]
    ) -> None:
        """Fill the infos of the rows whose episode ended in this step."""
        metrics = self.engine.metrics()
        observations = self._final_observations()[ended]
        columns = {
            name: self._by_row(metric)[ended].tolist()
            for name, metric in metrics.items()
            if name != "return_"
        }
        returns = self._returns(metrics)[ended].tolist()
        seconds = round(time.time() - self._start_time, 6)
        for index, row in enumerate(ended.tolist()):
            info = infos[row]
            info.update((name, column[index]) for name, column in columns.items())
            info["TimeLimit.truncated"] = bool(timeouts[row])
            info["terminal_observation"] = observations[index]
            info["is_success"] = bool(info["success"])
            info["episode"] = {"r": returns[index], "l": info["steps"], "t": seconds}

    def close(self) -> None:
        """Nothing to release: the engine holds memory only."""

    def snapshot(self, row: int) -> Snapshot:
        """What can be seen now of the world of ``row`` (see ``BatchEngine.snapshot``)."""
        return self.engine.snapshot(row // self._rows_per_world)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """``attr_name`` of this object, or else of the engine, once for each row in ``indices``.

        Raises:
            AttributeError: neither has it.
        """
        owner = self if hasattr(self, attr_name) else self.engine
        return [getattr(owner, attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set the attribute ``attr_name`` of this object to ``value``, for all rows.

        Raises:
            MbnError: ``indices`` leaves rows out; all rows live in one object.
        """
        if set(self._rows(indices)) != set(range(self.num_envs)):
            raise MbnError(f"set_attr({attr_name!r}): all rows share it; leave indices out")
        setattr(self, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call ``self.method_name(row, *method_args, **method_kwargs)`` for each row.

        Args:
            method_name: of a method of this object.
            *method_args: handed to it after the row's index.
            indices: the rows; ``None`` for all.
            **method_kwargs: handed to it.
        """
        method = getattr(self, method_name)
        return [method(row, *method_args, **method_kwargs) for row in self._rows(indices)]

    def env_is_wrapped(
        self,
        wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]],
        indices: VecEnvIndices = None,
    ) -> list[bool]:
        """True for each of ``indices`` if ``wrapper_class`` is ``Monitor``: the infos follow it.

        So ``evaluate_policy`` reads the true returns from them, under reward scaling too.
        """
        return [wrapper_class is Monitor] * len(self._rows(indices))

    def _rows(self, indices: VecEnvIndices) -> Sequence[int]:
        rows: Iterable[int] = self._get_indices(indices)
        return list(rows)


class CentralizedVecEnv(NavigationVecEnv):
    """The centralised single MDP, batched: a row is a world.

    Observation ``(4n+1,)`` in the engine's dtype (all positions, all velocities, the visit code;
    raw units, so put a ``VecNormalize`` around it for learning), action ``(n, 2)`` in [-1, 1],
    reward the team's.

    Args:
        field: a catalogue name, a file, a ``Field``, or a list of them (world ``w`` gets number
            ``w`` modulo their count).
        num_envs: number of worlds, which is the number of rows.
        seed: of all worlds, until ``seed()`` gives another.
        threads: of the engine; ``None`` takes as many as there are cores.
        **settings: the fields of ``NavigationConfig``.

    Raises:
        FieldError: the field is not valid.
        ConfigError: a setting is not valid.
    """

    def __init__(
        self,
        field: FieldLike | Sequence[FieldLike],
        num_envs: int = 64,
        *,
        seed: int = 0,
        threads: int | None = None,
        **settings: Unpack[Settings],
    ) -> None:
        engine = BatchEngine(
            field, num_envs, seed=seed, autoreset="same_step", threads=threads, **settings
        )
        observation_space = spaces.Box(engine.state_low, engine.state_high, dtype=engine.dtype.type)
        action_space = spaces.Box(-1.0, 1.0, (engine.n_robots, 2), np.float32)
        super().__init__(engine, 1, observation_space, action_space)

    def _observations(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        return self.engine.state()

    def _final_observations(self) -> NDArray[Any]:
        return self.engine.final_state()

    def _rewards(self, rewards: NDArray[Any]) -> NDArray[np.float32]:
        return self.engine.team_rewards.astype(np.float32)

    def _by_row(self, metric: NDArray[Any]) -> NDArray[Any]:
        return metric if metric.ndim == 1 else metric.sum(axis=1)

    def _returns(self, metrics: dict[str, NDArray[Any]]) -> NDArray[Any]:
        return metrics["episode_return"]


class SharedPolicyVecEnv(NavigationVecEnv):
    """The decentralised form with one policy for all robots: a row is a robot of a world.

    Row ``w * n + i`` is robot ``i`` of world ``w``: ``num_envs = num_worlds * n`` rows with
    observation ``(obs_size,)`` float32, action ``(2,)`` in [-1, 1] and the robot's own reward
    (the team's with ``reward_sharing="team"``). The rows of a world end together. In the infos
    ``wall_hits``, ``path_length`` and ``impulse`` are the robot's own, the other metrics its
    team's. ``one_hot=True`` lets the shared policy tell the robots apart.

    Args:
        field: a catalogue name, a file, a ``Field``, or a list of them (world ``w`` gets number
            ``w`` modulo their count).
        num_worlds: number of worlds.
        seed: of all worlds, until ``seed()`` gives another.
        threads: of the engine; ``None`` takes as many as there are cores.
        **settings: the fields of ``NavigationConfig``.

    Raises:
        FieldError: the field is not valid.
        ConfigError: a setting is not valid.
    """

    def __init__(
        self,
        field: FieldLike | Sequence[FieldLike],
        num_worlds: int = 64,
        *,
        seed: int = 0,
        threads: int | None = None,
        **settings: Unpack[Settings],
    ) -> None:
        engine = BatchEngine(
            field, num_worlds, seed=seed, autoreset="same_step", threads=threads, **settings
        )
        observation_space = spaces.Box(
            engine.observation_low, engine.observation_high, dtype=np.float32
        )
        action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        super().__init__(engine, engine.n_robots, observation_space, action_space)

    def _observations(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        return observations.reshape(self.num_envs, -1).copy()

    def _final_observations(self) -> NDArray[Any]:
        return self.engine.final_observations.reshape(self.num_envs, -1)

    def _rewards(self, rewards: NDArray[Any]) -> NDArray[np.float32]:
        return rewards.reshape(-1).astype(np.float32)

    def _by_row(self, metric: NDArray[Any]) -> NDArray[Any]:
        return np.repeat(metric, self._rows_per_world) if metric.ndim == 1 else metric.reshape(-1)

    def _returns(self, metrics: dict[str, NDArray[Any]]) -> NDArray[Any]:
        return metrics["return_"].reshape(-1)
