"""The decentralised form as PettingZoo environments: parallel, and one agent after the other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Unpack

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from pettingzoo import ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from mbn_marl.adapters.one_world import RENDER_MODES, OneWorld
from mbn_marl.adapters.rendering import RENDER_FPS
from mbn_marl.config import FixedSettings
from mbn_marl.engine import BatchEngine, FieldLike
from mbn_marl.errors import ActionError, ConfigError, MbnError, StepError
from mbn_marl.optimum import optimal_return
from mbn_marl.render.viewer import RENDER_SIZE

Observation = NDArray[np.float32]
Action = NDArray[np.float32]
Info = dict[str, float]
StepResult = tuple[
    dict[str, Observation],
    dict[str, float],
    dict[str, bool],
    dict[str, bool],
    dict[str, Info],
]


class NavigationParallelEnv(ParallelEnv[str, Observation, Action]):
    """All robots act at once. ``parallel_env`` is this class under its usual name.

    The agents are ``robot_0`` to ``robot_{n-1}``. An episode ends for all of them in the same
    step: ``terminated`` on success or collision, ``truncated`` after ``max_steps`` steps.

    ============  ==================================================================================
    action        ``(2,)`` float32 in [-1, 1]: the force along x and y, in parts of ``f_max``
    observation   ``(obs_size,)`` float32, bounded; ``engine.observation_table`` names its entries
    state         ``(4n+1,)`` in the engine's dtype: positions, velocities, visit code, raw units
    reward        the robot's share; the shares sum to the team's reward (unless shared by the team)
    info          flat and numeric, see :mod:`mbn_marl.adapters.infos`
    ============  ==================================================================================

    Args:
        field: a catalogue name, the path of a field file, or a :class:`~mbn_marl.Field`.
        n_robots: team size; the first starts of the field are used; ``None`` uses all of them.
        render_mode: ``"human"`` shows every step, ``"rgb_array"`` draws on :meth:`render`.
        render_size: width and height of a frame or the window, pixels, each at least 200.
        max_cycles: what PettingZoo calls ``max_steps``; ``None`` leaves it to that.
        **settings: the fields of :class:`~mbn_marl.config.NavigationConfig`.

    Raises:
        FieldError: listing every problem with the field.
        ConfigError: listing every problem with the settings.

    Source:
        Choton, Woods, Hsu, section 3, made multi-agent: ``docs/mdp.md``, "The decentralised form".
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - the base class declares an instance attribute
        "render_modes": list(RENDER_MODES),
        "name": "navigation_v0",
        "is_parallelizable": True,
        "render_fps": RENDER_FPS,
    }

    def __init__(
        self,
        field: FieldLike = "field_03",
        n_robots: int | None = None,
        *,
        render_mode: str | None = None,
        render_size: tuple[int, int] = RENDER_SIZE,
        max_cycles: int | None = None,
        **settings: Unpack[FixedSettings],
    ) -> None:
        if max_cycles is not None:
            if "max_steps" in settings:
                raise ConfigError("environment", ["max_cycles: is max_steps, give only one"])
            settings["max_steps"] = max_cycles
        self._world = OneWorld(field, render_mode, render_size, n_robots=n_robots, **settings)
        self.render_mode = render_mode
        self.possible_agents = list(self._world.agents)
        self.agents: list[str] = []
        engine = self.engine
        self._dtype = engine.dtype
        self.observation_spaces = {
            agent: spaces.Box(engine.observation_low, engine.observation_high, dtype=np.float32)
            for agent in self.possible_agents
        }
        self.action_spaces = {
            agent: spaces.Box(-1.0, 1.0, (2,), np.float32) for agent in self.possible_agents
        }
        self.state_space = self._world.state_space()

    @property
    def engine(self) -> BatchEngine:
        """The engine with this environment's world; look at it, but do not step it."""
        return self._world.engine

    @property
    def optimal_return(self) -> float | None:
        """The proved best team return here, see :func:`mbn_marl.optimum.optimal_return`."""
        return optimal_return(self.engine.field, self.engine.config)

    def observation_space(self, agent: str) -> spaces.Space[Observation]:
        """The space of ``agent``'s observations, ``(obs_size,)`` float32, always the same object.

        Its bounds have the units of ``engine.observation_table``.

        Raises:
            MbnError: there is no such agent.
        """
        self._check_known(agent)
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Action]:
        """The space of ``agent``'s actions, ``(2,)`` in [-1, 1], always the same object.

        Raises:
            MbnError: there is no such agent.
        """
        self._check_known(agent)
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, Info]]:
        """Start an episode.

        Args:
            seed: starts the random numbers anew; ``None`` goes on to the next episode of the
                current seed (0 before any was given).
            options: not read, there are none.

        Returns:
            Each agent's observation, ``(obs_size,)`` float32 in the units of
            ``engine.observation_table``, and info.

        Raises:
            ConfigError: the seed is not allowed.
        """
        observations = self._world.reset(seed)
        self.agents = list(self.possible_agents)
        infos = {agent: self._world.infos.nothing() for agent in self.agents}
        return dict(zip(self.agents, observations, strict=True)), infos

    def step(self, actions: Mapping[str, ArrayLike]) -> StepResult:
        """Move all robots.

        Args:
            actions: two finite numbers ``(2,)`` for each agent; what lies outside [-1, 1] is
                clipped.

        Returns:
            Observations ``(obs_size,)`` float32, rewards, terminated, truncated and infos, each a
            dict by agent. Five empty dicts when the episode has ended and there are no actions.

        Raises:
            ActionError: naming every missing or unknown agent and wrong action; nothing has moved.
            StepError: before the first reset, or with actions after the end of an episode.
        """
        agents = self.agents
        if not agents:
            return self._step_without_agents(actions)
        observations, rewards, terminated, truncated = self._world.step(self._together(actions))
        if terminated or truncated:
            self.agents = []
        return (
            dict(zip(agents, observations, strict=True)),
            dict(zip(agents, rewards.tolist(), strict=True)),
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            dict(zip(agents, self._world.infos.of_robots(not self.agents), strict=True)),
        )

    def state(self) -> NDArray[Any]:
        """The paper's state, ``(4n+1,)`` in the engine's dtype, raw units, a fresh array.

        Raises:
            StepError: before the first reset.
        """
        return self._world.state()

    def render(self) -> NDArray[np.uint8] | None:
        """The current frame, ``(height, width, 3)`` uint8; ``None`` in human mode."""
        return self._world.viewer.draw(self.engine)

    def close(self) -> None:
        """Close the window, if there is one. The environment can be used again."""
        self._world.viewer.close()

    def _check_known(self, agent: str) -> None:
        if agent not in self.possible_agents:
            known = ", ".join(self.possible_agents)
            raise MbnError(f"unknown agent {agent!r}; known: {known}")

    def _step_without_agents(self, actions: Mapping[str, ArrayLike]) -> StepResult:
        if not self._world.started:
            raise StepError("step() before the first reset(): call reset() first")
        if actions:
            raise StepError("step() with actions after the end of the episode: call reset() first")
        return {}, {}, {}, {}, {}

    def _together(self, actions: Mapping[str, ArrayLike]) -> NDArray[Any]:
        """The actions as one array, (n, 2) in the engine's dtype, in the agents' order."""
        agents = self.possible_agents
        try:
            together = np.array([actions[agent] for agent in agents], self._dtype)
        except (LookupError, TypeError, ValueError):
            raise ActionError(self._what_is_wrong(actions)) from None
        if together.shape != (len(agents), 2) or len(actions) != len(agents):
            raise ActionError(self._what_is_wrong(actions))
        return together

    def _what_is_wrong(self, actions: object) -> str:
        if not isinstance(actions, Mapping):
            return f"actions: {type(actions).__name__}; allowed: a dict of the agents' actions"
        known = self.possible_agents
        problems = [f"{agent!r}: unknown agent" for agent in actions if agent not in known]
        problems += [f"{agent}: missing" for agent in known if agent not in actions]
        for agent in known:
            if agent in actions and not _is_action(actions[agent]):
                problems.append(f"{agent}: {actions[agent]!r:.80}, not two numbers")
        allowed = f"two numbers for each of {', '.join(known)}"
        return f"actions: {'; '.join(problems)}; allowed: {allowed}"


def _is_action(action: object) -> bool:
    try:
        return np.array(action, np.float64).shape == (2,)
    except (TypeError, ValueError):
        return False


class NavigationAECEnv(parallel_to_aec_wrapper[str, Observation, Action]):
    """One robot after the other; they move together once the last has chosen.

    Each action is checked when it is handed in, so that the error reaches the robot that caused
    it and that robot can choose again.
    """

    def step(self, action: Action | None) -> None:
        """Hand in the ``action`` of ``agent_selection``: two numbers ``(2,)`` in [-1, 1].

        Once the episode has ended it is ``None``.

        Raises:
            ActionError: not two finite numbers, or not ``None`` after the end; nothing has changed.
            StepError: before the first reset, or when no agent is left.
        """
        if not getattr(self, "agents", None):
            raise StepError("step() before reset() or after the end: call reset() first")
        agent = self.agent_selection
        if self.terminations[agent] or self.truncations[agent]:
            if action is not None:
                raise ActionError(f"{agent}: the episode has ended; allowed: None")
        elif not _is_action(action) or not np.isfinite(np.asarray(action)).all():
            raise ActionError(f"{agent}: {action!r:.80}; allowed: two finite numbers")
        super().step(action)


def raw_env(
    field: FieldLike = "field_03",
    n_robots: int | None = None,
    *,
    render_mode: str | None = None,
    render_size: tuple[int, int] = RENDER_SIZE,
    max_cycles: int | None = None,
    **settings: Unpack[FixedSettings],
) -> NavigationAECEnv:
    """The AEC form; arguments and errors as :class:`NavigationParallelEnv`."""
    parallel = NavigationParallelEnv(
        field,
        n_robots,
        render_mode=render_mode,
        render_size=render_size,
        max_cycles=max_cycles,
        **settings,
    )
    return NavigationAECEnv(parallel)


def env(
    field: FieldLike = "field_03",
    n_robots: int | None = None,
    *,
    render_mode: str | None = None,
    render_size: tuple[int, int] = RENDER_SIZE,
    max_cycles: int | None = None,
    **settings: Unpack[FixedSettings],
) -> OrderEnforcingWrapper[str, Observation, Action | None]:
    """The AEC form with PettingZoo's order checks; arguments as :class:`NavigationParallelEnv`."""
    return OrderEnforcingWrapper(
        raw_env(
            field,
            n_robots,
            render_mode=render_mode,
            render_size=render_size,
            max_cycles=max_cycles,
            **settings,
        )
    )


parallel_env = NavigationParallelEnv
