"""The centralised form as Gymnasium environments: one world, or a native vector of many."""

from __future__ import annotations

import copy
from typing import Any, Unpack

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from mbn_marl.adapters.infos import Infos
from mbn_marl.adapters.one_world import (
    RENDER_FPS,
    OfEngine,
    OneWorld,
    central_problems,
    flag_problems,
    fresh_seed,
    make_parts,
    real_numbers,
    rename_max_steps,
)
from mbn_marl.config import FixedSettings
from mbn_marl.engine import FieldLike, Fields
from mbn_marl.engine.validation import option_problems, reset_problems
from mbn_marl.errors import ActionError, ConfigError
from mbn_marl.field import FieldSampler
from mbn_marl.render.viewer import RENDER_SIZE

State = NDArray[Any]
Actions = NDArray[np.float32]


class _WithSpec(OfEngine):
    """Adds the time limit to the spec that ``gymnasium.make`` and ``make_vec`` give."""

    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The registered spec; ``max_episode_steps`` is the environment's time limit."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = copy.copy(spec)
        if self._spec is not None:
            self._spec.max_episode_steps = self.engine.config.max_steps


class CentralizedEnv(_WithSpec, OneWorld, gymnasium.Env[State, Actions]):
    """The single MDP of the paper. ``centralized_env`` is this class under its usual name.

    ============  ==================================================================================
    action        ``(n, 2)`` float32 in [-1, 1]: each robot's force along x and y, in units of f_max
    observation   ``(4n+1,)`` in the engine's dtype: positions, velocities, visit code, raw units
    reward        the team's
    info          flat and numeric, see :mod:`mbn_marl.adapters.infos`
    ============  ==================================================================================

    The state has n headings (radians) more if a robot has one, then n flags with ``failures`` or
    if teams vary, before the visit code.

    Args:
        field: a catalogue name, the path of a field file, or a :class:`~mbn_marl.Field`; or a
            :class:`~mbn_marl.field.FieldSampler`, which draws one for each episode.
        n_robots: team size; the first starts of the field are used; ``None`` uses all of them.
        render_mode: ``"human"`` shows every step, ``"rgb_array"`` draws on :meth:`render`.
        render_size: width and height of a frame or the window, pixels, each at least 200.
        flat: whether an action is ``(2n,)``, robot after robot, as many libraries want it.
        **settings: the fields of :class:`~mbn_marl.config.NavigationConfig`.

    Raises:
        FieldError: listing every problem with the field.
        ConfigError: listing every problem with the settings.

    Source:
        Choton, Woods, Hsu, section 3: state, action and reward of the single MDP.
    """

    def __init__(
        self,
        field: FieldLike | FieldSampler = "field_03",
        n_robots: int | None = None,
        *,
        render_mode: str | None = None,
        render_size: tuple[int, int] = RENDER_SIZE,
        flat: bool = False,
        **settings: Unpack[FixedSettings],
    ) -> None:
        if "frameskip" in settings:  # TorchRL's GymEnv tries it, and expects the error of Python
            raise TypeError("CentralizedEnv() got an unexpected keyword argument 'frameskip'")
        wrong = flag_problems(flat=flat) + central_problems(settings)
        super().__init__(field, render_mode, render_size, wrong, n_robots=n_robots, **settings)
        self.observation_space = self.state_space
        n = self.engine.n_robots
        self._action_shape = (2 * n,) if flat else (n, 2)
        self.action_space = spaces.Box(-1.0, 1.0, self._action_shape, np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[State, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: restarts the random numbers; ``None`` continues with those of the current seed.
                A first reset without one draws it.
            options: ``"field"``, a name, a path or a Field for this episode alone, of the same
                arena and with no more ROIs; ``"starts"``, where its robots start, ``(n, 2)`` units.

        Returns:
            The state, ``(4n+1,)`` in raw units, and the info.

        Raises:
            ConfigError: the seed or an option is not allowed; nothing has changed.
            FieldError: the field of the options is invalid or unknown; nothing has changed.
        """
        self._start(seed, options)
        super().reset(seed=None if seed is None else int(seed))
        return self.engine.state()[0], self._infos.of_reset()

    def step(self, action: ArrayLike) -> tuple[State, float, bool, bool, dict[str, Any]]:
        """Move all robots.

        Args:
            action: finite numbers, ``(n, 2)``, or ``(2n,)`` if flat, clipped to [-1, 1].

        Returns:
            State ``(4n+1,)``, reward, terminated (success or collision), truncated
            (``max_steps``), info.

        Raises:
            ActionError: wrong shape or not finite; nothing has moved.
            StepError: before the first reset, or after the end of an episode.
        """
        numbers = real_numbers(action, self._action_shape)
        if numbers is None:
            given = f"{action!r:.80}"
            if isinstance(action, np.ndarray):
                given = f"{action.dtype} of shape {action.shape}"
            allowed = f"numbers of shape {self._action_shape}"
            raise ActionError(f"action: {given}; allowed: {allowed}")
        _, _, terminated, truncated = self._move(numbers.reshape(-1, 2))
        info = self._infos.of_team(terminated or truncated)
        return self.state(), float(self.engine.team_rewards[0]), terminated, truncated, info


class CentralizedVectorEnv(_WithSpec, VectorEnv[State, Actions, NDArray[Any]]):
    """Many worlds of the single MDP in one engine; ``gymnasium.make_vec`` makes it.

    Spaces, rewards and infos are those of :class:`CentralizedEnv` with a first axis of worlds.

    With ``SAME_STEP``, a world that ends starts its next episode in the same step, and the returned
    state is the new episode's. ``infos["final_obs"][world]`` and ``infos["final_info"]`` contain
    the last ones of the old episode, in the worlds that ``infos["_final_obs"]`` marks.

    Args:
        num_envs: number of worlds, W.
        field: a catalogue name, a path or a :class:`~mbn_marl.Field`, or a sequence of these;
            world w uses the one at ``w % len(field)``. Or a :class:`~mbn_marl.field.FieldSampler`.
        render_mode: ``"rgb_array"`` or ``None``.
        autoreset_mode: Gymnasium's mode or its value, also in ``metadata["autoreset_mode"]``; by
            default ``NEXT_STEP``, as Gymnasium's own vectors.
        max_episode_steps: Gymnasium's name of ``max_steps``; give only one of the two.
        threads: threads of the engine; ``None`` lets it choose.

    Other arguments, and errors, are those of :class:`CentralizedEnv`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        field: Fields = "field_03",
        n_robots: int | None = None,
        *,
        render_mode: str | None = None,
        render_size: tuple[int, int] = RENDER_SIZE,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        threads: int | None = None,
        **settings: Unpack[FixedSettings],
    ) -> None:
        problems = rename_max_steps("max_episode_steps", max_episode_steps, settings)
        problems += central_problems(settings)
        names = {"num_worlds": "num_envs"}
        if max_episode_steps is not None:
            names["max_steps"] = "max_episode_steps"
        self.render_mode, mode = render_mode, AutoresetMode.NEXT_STEP
        try:
            mode = AutoresetMode(autoreset_mode)
        except ValueError:
            known = ", ".join(repr(known.value) for known in AutoresetMode)
            problems.append(f"autoreset_mode: unknown mode {autoreset_mode!r}; known: {known}")
        self.autoreset_mode = mode
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": RENDER_FPS}
        self.metadata["autoreset_mode"] = mode
        view = render_mode, ("rgb_array",), render_size
        how = {"autoreset": mode.name.lower(), "threads": threads, "n_robots": n_robots}
        how["seed"] = fresh_seed()  # of a first reset with a mask, which draws none
        self._viewer, engine = make_parts(
            self, view, field, num_envs, settings, problems, names, **how
        )
        self.engine = engine
        self._infos = Infos(engine)
        self.num_envs = num_envs
        self.single_observation_space = spaces.Box(
            engine.state_low, engine.state_high, dtype=engine.dtype.type
        )
        self.single_action_space = spaces.Box(-1.0, 1.0, (engine.n_robots, 2), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[State, dict[str, Any]]:
        """Start an episode in every world, or in some.

        Args:
            seed: of all worlds; otherwise as in :class:`CentralizedEnv`.
            options: ``"reset_mask"``, ``(W,)`` bool, resets only these worlds (without a seed).

        Returns:
            The states ``(W, 4n+1)``, fresh, and the infos.

        Raises:
            ConfigError: the seed or an option is not allowed; nothing has changed.
        """
        self._check(options, seed)
        super().reset(seed=None if seed is None else int(seed))
        mask = (options or {}).get("reset_mask")
        if mask is None:
            begun = bool((self.engine.episode_numbers >= 0).any())
            self.engine.reset(fresh_seed() if seed is None and not begun else seed)
            mask = np.ones(self.num_envs, np.bool_)
        else:
            self.engine.reset_worlds(mask)
        rows = np.where(mask[:, None], self._infos.of_resets(), 0.0)
        return self.engine.state(), self._by_key(rows, mask)

    def step(
        self, actions: ArrayLike
    ) -> tuple[State, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Move the robots of all worlds.

        Args:
            actions: finite numbers, ``(W, n, 2)``, clipped to [-1, 1].

        Returns:
            States ``(W, 4n+1)``, the teams' rewards ``(W,)``, terminated ``(W,)``, truncated
            ``(W,)`` and infos; all arrays are fresh.

        Raises:
            ActionError: wrong shape or not finite; nothing has moved.
            StepError: before the first reset, or (``DISABLED``) with an ended world.
        """
        engine = self.engine
        _, _, terminated, truncated = engine.step(actions)
        copies = (engine.team_rewards.copy(), terminated.copy(), truncated.copy())
        return engine.state(), *copies, self._step_infos(terminated | truncated)

    def render(self) -> tuple[Any, ...] | None:
        """Return a frame of every world, ``(height, width, 3)`` uint8; ``None`` without a mode."""
        frames = tuple(self._viewer.draw(self.engine, world) for world in range(self.num_envs))
        return None if self.render_mode is None else frames

    def close_extras(self, **kwargs: Any) -> None:
        self._viewer.close()

    def _check(self, options: dict[str, Any] | None, seed: int | None) -> None:
        problems = option_problems(options, ("reset_mask",))
        if not problems and options and (mask := options.get("reset_mask")) is not None:
            if not (isinstance(mask, np.ndarray) and mask.dtype == np.bool_):
                problems.append(f"reset_mask: {type(mask).__name__}, allowed: a bool array")
            elif mask.shape != (self.num_envs,):
                problems.append(f"reset_mask: shape {mask.shape}, allowed: ({self.num_envs},)")
            if seed is not None:
                problems.append("reset_mask: a seed restarts all worlds; give only one of the two")
        problems += reset_problems(seed, 0)
        if problems:
            raise ConfigError("reset", problems)

    def _step_infos(self, ended: NDArray[np.bool_]) -> dict[str, Any]:
        everywhere = np.ones(self.num_envs, np.bool_)
        rows = self._infos.of_teams(ended)
        if self.autoreset_mode is not AutoresetMode.SAME_STEP or not ended.any():
            return self._by_key(rows, everywhere)
        states, final = np.full(self.num_envs, None, object), self.engine.final_state()
        for world in np.flatnonzero(ended):
            states[world] = final[world]
        return {
            **self._by_key(np.where(ended[:, None], self._infos.of_resets(), rows), everywhere),
            "final_obs": states,
            "_final_obs": ended,
            "final_info": self._by_key(np.where(ended[:, None], rows, 0.0), ended),
            "_final_info": ended,
        }

    def _by_key(self, rows: NDArray[np.float64], mask: NDArray[np.bool_]) -> dict[str, Any]:
        infos = dict(zip(self._infos.keys, rows.T.copy(), strict=True))
        return {**infos, **{f"_{key}": mask for key in infos}}


centralized_env = CentralizedEnv
