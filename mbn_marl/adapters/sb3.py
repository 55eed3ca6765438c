"""Stable-Baselines3: the engine's worlds as one native ``VecEnv``, stepped in one compiled call.

The infos follow Stable-Baselines3's conventions. A row has

- at every step ``TimeLimit.truncated``: the episode ended by ``max_steps`` and nothing else; with
  ``failures`` also ``failed``: whether the row's robot, or how many of its robots, have failed;
  if teams vary also ``present``: whether the row's robot, or how many of its robots, are there.
  Rows of robots that are not stay: their observations and rewards are 0. If an episode ends,
  both are of that episode;
- at the end of an episode also ``terminal_observation``, ``is_success``, the metrics, the numbers
  that it had drawn as ``drawn/...``, and
  ``episode`` (return ``r``, length ``l``, seconds ``t``) as from ``Monitor``, so that
  ``ep_rew_mean`` and ``success_rate`` are logged without a wrapper.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Unpack

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from mbn_marl.adapters.one_world import (
    RENDER_FPS,
    OfEngine,
    central_problems,
    flag_problems,
    make_parts,
)
from mbn_marl.config import Settings
from mbn_marl.engine import Fields
from mbn_marl.engine.validation import as_array
from mbn_marl.errors import ActionError, ConfigError, MbnError, StepError
from mbn_marl.render.viewer import RENDER_SIZE

if TYPE_CHECKING:
    from mbn_marl.engine import Snapshot

Flags = NDArray[np.bool_]


class NavigationVecEnv(OfEngine, VecEnv):
    """The base of the two forms: stepping, automatic reset, seeding and infos.

    The worlds have one seed: ``seed(s)`` takes effect at the next ``reset``, as always in
    Stable-Baselines3. Only its first number is used; the engine derives a stream for each world.

    All rows are one object. ``get_attr`` and ``set_attr`` therefore read and write this object (or
    read the engine), and ``env_method(name, ..., indices=rows)`` calls this object's method once
    for each row, with the row's index as the first argument.

    Args:
        field: a catalogue name, a file, a ``Field``, or a list of them (world ``w`` gets number
            ``w`` modulo their count); or a ``FieldSampler``.
        num_worlds: number of worlds.
        seed: of all worlds, until ``seed()`` gives another.
        threads: of the engine; ``None`` lets it choose.
        render_mode: ``"rgb_array"`` draws the world of row 0, or ``None``.
        **settings: the fields of ``NavigationConfig``.

    Attributes:
        engine: the engine; read it, but let only this object step and reset it.

    Raises:
        FieldError: the field is not valid.
        ConfigError: a setting is not valid.
    """

    _return: str  # the metric that is a row's return
    _count = "num_worlds"  # its argument's name
    _problems: Sequence[str] = ()  # of a form's other arguments

    def __init__(
        self,
        field: Fields,
        num_worlds: int = 64,
        *,
        seed: int = 0,
        threads: int | None = None,
        render_mode: str | None = None,
        **settings: Unpack[Settings],
    ) -> None:
        self.render_mode = render_mode
        view = render_mode, ("rgb_array",), RENDER_SIZE
        how: dict[str, Any] = {"seed": seed, "autoreset": "disabled", "threads": threads}
        how |= {"names": {"num_worlds": self._count}, "problems": self._problems}
        self._viewer, self.engine = make_parts(self, view, field, num_worlds, settings, **how)
        self._rows_per_world, observation_space, action_space = self._row()
        self._actions: NDArray[Any] | None = None
        self._start_time = time.time()
        rows = self.engine.num_worlds * self._rows_per_world
        super().__init__(rows, observation_space, action_space)
        self.metadata: dict[str, Any] = {**self.metadata, "render_fps": RENDER_FPS}

    @abstractmethod
    def _row(self) -> tuple[int, spaces.Box, spaces.Box]:
        """Return the rows of a world, and the observation and action space of a row."""

    def _observations(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        return observations.reshape(self.num_envs, -1).copy()

    @abstractmethod
    def _rewards(self, rewards: NDArray[Any]) -> NDArray[np.float32]:
        """Return fresh rewards by row, from the engine's ``(num_worlds, n)``."""

    @abstractmethod
    def _by_row(self, metric: NDArray[Any]) -> NDArray[Any]:
        """Return a value for each row, from ``(num_worlds,)`` or ``(num_worlds, n)``."""

    def reset(self) -> NDArray[Any]:
        """Start a new episode in every world; return fresh observations by row.

        Raises:
            ConfigError: ``set_options`` was given some; there are none.
        """
        if any(self._options):
            raise ConfigError("reset", [f"options: {self._options!r:.80}; allowed: none"])
        observations = self.engine.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self._actions = None
        return self._observations(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of the next step, ``(num_envs, *action_space.shape)`` in [-1, 1].

        Raises:
            ActionError: the shape is wrong.
        """
        expected = (self.num_envs, *(self.action_space.shape or ()))
        try:
            given = as_array(actions)
        except ValueError as error:  # rows of several lengths
            raise ActionError(f"actions: {error}; expected shape {expected}") from None
        if given.shape != expected:
            raise ActionError(f"actions: shape {given.shape}, expected {expected}")
        self._actions = given.reshape(self.engine.num_worlds, self.engine.n_robots, 2)

    def step_wait(self) -> VecEnvStepReturn:
        """Step every world; those that end are reset at once.

        Returns:
            Observations, rewards float32 ``(num_envs,)``, dones bool ``(num_envs,)`` and infos, all
            fresh. The observation of a done row is the next episode's first one; its info has the
            last one.

        Raises:
            ActionError: an action is not finite; nothing has moved.
            StepError: there are no actions, or there was no reset.
        """
        if self._actions is None:
            raise StepError("step_wait: no actions; call step_async(actions) after a reset first")
        actions, self._actions = self._actions, None
        engine = self.engine
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(self.num_envs)]
        observations, own, terminated, truncated = engine.step(actions)
        rewards = self._rewards(own)
        if (ended := terminated | truncated).any():
            self._close_episodes(infos, ended, truncated & ~terminated, observations)
        flags = {"failed": engine.failed} if engine.config.failures else {}
        flags |= {"present": engine.present} if engine.teams_vary else {}
        for name, flag in flags.items():
            for info, value in zip(infos, self._by_row(flag).tolist(), strict=True):
                info[name] = value
        if ended.any():
            observations = engine.reset_worlds(ended)
        dones = np.repeat(ended, self._rows_per_world)
        return self._observations(observations), rewards, dones, infos

    def _close_episodes(
        self, infos: list[dict[str, Any]], ending: Flags, timeouts: Flags, last: NDArray[np.float32]
    ) -> None:
        ended = np.flatnonzero(np.repeat(ending, self._rows_per_world))
        numbers = {f"drawn/{name}": one for name, one in self.engine.drawn().items()}
        numbers |= self.engine.metrics()
        columns = {name: self._by_row(one[ending]).tolist() for name, one in numbers.items()}
        returns = columns[self._return]
        del columns["return_"]
        observations = self._observations(last)[ended]
        seconds = round(time.time() - self._start_time, 6)
        for index, row in enumerate(ended.tolist()):
            info = infos[row]
            info.update((name, column[index]) for name, column in columns.items())
            info["TimeLimit.truncated"] = bool(timeouts[row // self._rows_per_world])
            info["terminal_observation"] = observations[index]
            info["is_success"] = bool(info["success"])
            info["episode"] = {"r": returns[index], "l": info["steps"], "t": seconds}

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return the frame of row 0's world alone, ``(height, width, 3)`` uint8."""
        return [self._viewer.draw(self.engine)]

    def close(self) -> None:
        self._viewer.close()

    def snapshot(self, row: int) -> Snapshot:
        return self.engine.snapshot(row // self._rows_per_world)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        owner = self if hasattr(self, attr_name) else self.engine
        return [getattr(owner, attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of this object; ``indices`` that omit rows are an ``MbnError``."""
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
        method = getattr(self, method_name)
        return [method(row, *method_args, **method_kwargs) for row in self._rows(indices)]

    def env_is_wrapped(
        self,
        wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]],
        indices: VecEnvIndices = None,
    ) -> list[bool]:
        # evaluate_policy then reads the true returns from the infos, under reward scaling too.
        return [wrapper_class is Monitor] * len(self._rows(indices))

    def _rows(self, indices: VecEnvIndices) -> list[int]:
        rows = [int(row) for row in self._get_indices(indices)]
        if wrong := [row for row in rows if not -self.num_envs <= row < self.num_envs]:
            raise IndexError(f"rows {wrong}; allowed: 0 to {self.num_envs - 1}")
        return [row % self.num_envs for row in rows]


class CentralizedVecEnv(NavigationVecEnv):
    """The centralised single MDP, batched: a row is a world.

    Observation ``(4n+1,)`` in the engine's dtype (all positions, all velocities, the visit code, in
    raw units: wrap it in a ``VecNormalize`` for learning; ``(5n+1,)`` with headings before the
    visit code if a robot has one), or with ``joint_observation`` the observations of all robots
    side by side, ``(n * obs_size,)`` float32; action ``(n, 2)`` in [-1, 1], reward the team's.

    There are ``num_envs`` worlds; other arguments and errors as :class:`NavigationVecEnv`.
    """

    _return, _count = "episode_return", "num_envs"

    def __init__(
        self,
        field: Fields,
        num_envs: int = 64,
        *,
        seed: int = 0,
        threads: int | None = None,
        render_mode: str | None = None,
        joint_observation: bool = False,
        **settings: Unpack[Settings],
    ) -> None:
        central = [] if joint_observation else central_problems(settings)
        self._problems = flag_problems(joint_observation=joint_observation) + central
        if settings.pop("num_worlds", None) is not None:  # type: ignore[typeddict-item]
            self._problems.append("num_worlds: unknown name (did you mean num_envs?)")
        self._joint = joint_observation
        how: dict[str, Any] = {"seed": seed, "threads": threads, "render_mode": render_mode}
        super().__init__(field, num_envs, **how, **settings)

    def _row(self) -> tuple[int, spaces.Box, spaces.Box]:
        engine, n = self.engine, self.engine.n_robots
        seen = spaces.Box(engine.state_low, engine.state_high, dtype=engine.dtype.type)
        if self._joint:
            bounds = np.tile(engine.observation_low, n), np.tile(engine.observation_high, n)
            seen = spaces.Box(*bounds, dtype=np.float32)
        return 1, seen, spaces.Box(-1.0, 1.0, (n, 2), np.float32)

    def _observations(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        return super()._observations(observations) if self._joint else self.engine.state()

    def _rewards(self, rewards: NDArray[Any]) -> NDArray[np.float32]:
        return self.engine.team_rewards.astype(np.float32)

    def _by_row(self, metric: NDArray[Any]) -> NDArray[Any]:
        return metric if metric.ndim == 1 else metric.sum(axis=1)


class SharedPolicyVecEnv(NavigationVecEnv):
    """The decentralised form with one policy for all robots: a row is a robot of a world.

    Row ``w * n + i`` is robot ``i`` of world ``w``, in ``num_envs = num_worlds * n`` rows, with
    observation ``(obs_size,)`` float32, action ``(2,)`` in [-1, 1] and the robot's own reward
    (the team's with ``reward_sharing="team"``). The rows of a world end together. In the infos,
    ``wall_hits``, ``path_length``, ``impulse`` and ``failed`` are the robot's own, the others the
    team's. ``one_hot=True`` lets the policy distinguish the robots.

    All arguments and errors as :class:`NavigationVecEnv`.
    """

    _return = "return_"

    def _row(self) -> tuple[int, spaces.Box, spaces.Box]:
        engine = self.engine
        bounds = engine.observation_low, engine.observation_high
        actions = spaces.Box(-1.0, 1.0, (2,), np.float32)
        return engine.n_robots, spaces.Box(*bounds, dtype=np.float32), actions

    def _rewards(self, rewards: NDArray[Any]) -> NDArray[np.float32]:
        return rewards.reshape(-1).astype(np.float32)

    def _by_row(self, metric: NDArray[Any]) -> NDArray[Any]:
        return np.repeat(metric, self._rows_per_world) if metric.ndim == 1 else metric.reshape(-1)
