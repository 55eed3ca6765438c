"""The decentralised form as PettingZoo environments: parallel, or one agent after the other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Unpack, get_args

import numpy as np
from gymnasium import spaces
from gymnasium.utils.seeding import np_random
from numpy.typing import ArrayLike, NDArray
from pettingzoo import ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from mbn_marl.adapters.one_world import OneWorld, real_numbers, rename_max_steps
from mbn_marl.config import FixedSettings
from mbn_marl.engine import FieldLike
from mbn_marl.engine.validation import REAL
from mbn_marl.errors import ActionError, MbnError, StepError, unknown
from mbn_marl.field import FieldSampler
from mbn_marl.render.viewer import RENDER_SIZE

Observation = NDArray[np.float32]
Action = NDArray[np.float32]
Info = dict[str, float]
Flags = dict[str, bool]
FailedAgents = Literal["keep", "terminate"]
StepResult = tuple[dict[str, Observation], dict[str, float], Flags, Flags, dict[str, Info]]


class NavigationParallelEnv(OneWorld, ParallelEnv[str, Observation, Action]):
    """All robots act at once. ``parallel_env`` is this class under its usual name.

    The agents are ``robot_0`` to ``robot_{n-1}``. An episode ends for all of them in the same
    step: ``terminated`` on success or collision, ``truncated`` after ``max_steps`` steps.

    ============  ==================================================================================
    action        ``(2,)`` float32 in [-1, 1]: the force along x and y, in units of ``f_max``
    observation   ``(obs_size,)`` float32, bounded; ``engine.observation_table`` lists the entries
    state         ``(4n+1,)`` in the engine's dtype: positions, velocities, visit code, raw units
    reward        the robot's share; the shares sum to the team's reward (unless shared by the team)
    info          flat and numeric, see :mod:`mbn_marl.adapters.infos`
    ============  ==================================================================================

    The state has n headings (radians) more if a robot has one, then n flags with ``failures`` or
    if teams vary, before the visit code. If teams vary, ``agents`` are the episode's robots.

    Args:
        field: a catalogue name, the path of a field file, or a :class:`~mbn_marl.Field`; or a
            :class:`~mbn_marl.field.FieldSampler`, which draws one for each episode.
        n_robots: team size; the first starts of the field are used; ``None`` uses all of them.
        render_mode: ``"human"`` shows every step, ``"rgb_array"`` draws on :meth:`render`.
        render_size: width and height of a frame or the window, pixels, each at least 200.
        max_cycles: PettingZoo's name of ``max_steps``; give only one of the two.
        failed_agents: ``"keep"``: robots that fail remain agents, whose actions do nothing;
            ``"terminate"``: they are terminated in that step, and gone from ``agents``.
        **settings: the fields of :class:`~mbn_marl.config.NavigationConfig`.

    Attributes:
        np_random: a generator for wrappers alone, restarted by the seed.

    Raises:
        FieldError: listing every problem with the field.
        ConfigError: listing every problem with the settings.

    Source:
        Choton, Woods, Hsu, section 3, made multi-agent: ``docs/mdp.md``, "The decentralised form".
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - the base class declares an instance attribute
        **OneWorld.metadata,
        "name": "navigation_v0",
        "is_parallelizable": True,
    }

    def __init__(
        self,
        field: FieldLike | FieldSampler = "field_03",
        n_robots: int | None = None,
        *,
        render_mode: str | None = None,
        render_size: tuple[int, int] = RENDER_SIZE,
        max_cycles: int | None = None,
        failed_agents: FailedAgents = "keep",
        **settings: Unpack[FixedSettings],
    ) -> None:
        problems = rename_max_steps("max_cycles", max_cycles, settings)
        if failed_agents not in get_args(FailedAgents):
            allowed = ", ".join(map(repr, get_args(FailedAgents)))
            problems.append(f"failed_agents: {failed_agents!r}; allowed: {allowed}")
        names = {} if max_cycles is None else {"max_steps": "max_cycles"}
        view = render_mode, render_size
        super().__init__(field, *view, problems, names, n_robots=n_robots, **settings)
        self.possible_agents = [f"robot_{index}" for index in range(self.engine.n_robots)]
        self._index = {agent: index for index, agent in enumerate(self.possible_agents)}
        self.agents: list[str] = []
        self._terminate_failed = failed_agents == "terminate"
        self.np_random, _ = np_random(0)
        bounds = self.engine.observation_low, self.engine.observation_high
        self.observation_spaces = {
            agent: spaces.Box(*bounds, dtype=np.float32) for agent in self.possible_agents
        }
        self.action_spaces = {
            agent: spaces.Box(-1.0, 1.0, (2,), np.float32) for agent in self.possible_agents
        }

    def observation_space(self, agent: str) -> spaces.Space[Observation]:
        """Return the space of ``agent``'s observations; an unknown agent is an ``MbnError``."""
        self._check_known(agent)
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Action]:
        """Return the space of ``agent``'s actions; an unknown agent is an ``MbnError``."""
        self._check_known(agent)
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, Info]]:
        """Start an episode; arguments and errors as ``CentralizedEnv.reset``.

        Returns:
            Each agent's observation, ``(obs_size,)`` float32 in the units of
            ``engine.observation_table``, and info.
        """
        observations = self._start(seed, options)
        if seed is not None:
            self.np_random, _ = np_random(int(seed))
        self.agents = self.possible_agents[: int(self.engine.present[0].sum())]
        info = self._infos.of_reset()
        infos = {agent: info.copy() for agent in self.agents}
        return dict(zip(self.agents, observations, strict=False)), infos

    def step(self, actions: Mapping[str, ArrayLike]) -> StepResult:
        """Move all robots.

        Args:
            actions: two finite numbers ``(2,)`` for each of ``agents``, clipped to [-1, 1]. Those
                of agents that have left do nothing.

        Returns:
            Observations ``(obs_size,)`` float32, rewards, terminated, truncated and infos, each a
            dict by agent that acted; five empty dicts without actions when none is left.

        Raises:
            ActionError: naming every missing or unknown agent and wrong action; nothing has moved.
            StepError: before the first reset, or with actions after the end of an episode.
        """
        agents = self.agents
        if not self._started:
            raise StepError("step() before the first reset(): call reset() first")
        if not agents and actions:
            raise StepError("step() with actions after the end of the episode: call reset() first")
        if not agents:
            return {}, {}, {}, {}, {}
        observations, rewards, terminated, truncated = self._move(self._stacked(actions))
        ended = terminated or truncated
        infos = self._infos.of_robots(ended)
        if len(agents) < len(infos):
            there = [self._index[agent] for agent in agents]
            observations, rewards = observations[there], rewards[there]
            infos = [infos[robot] for robot in there]
        lost = dict.fromkeys(agents, terminated)
        if self._terminate_failed and not terminated:
            lost = {agent: bool(info["failed"]) for agent, info in zip(agents, infos, strict=True)}
        self.agents = [] if ended else [agent for agent in agents if not lost[agent]]
        return (
            dict(zip(agents, observations)),  # noqa: B905 - strict takes a microsecond of a step
            dict(zip(agents, rewards.tolist())),  # noqa: B905
            lost,
            {agent: truncated and not lost[agent] for agent in agents},
            dict(zip(agents, infos)),  # noqa: B905
        )

    def _check_known(self, agent: str) -> None:
        if agent not in self.possible_agents:
            raise MbnError(f"{agent!r}: {unknown('agent', str(agent), self.possible_agents)}")

    def _stacked(self, actions: Mapping[str, ArrayLike]) -> NDArray[Any]:
        # An array (n, 2), 0 of robots that are not asked.
        agents = self.agents
        try:
            given = np.array([actions[agent] for agent in agents])
            alike = given.shape == (len(agents), 2) and given.dtype.kind in REAL
        except (LookupError, RuntimeError, TypeError, ValueError):
            alike = False
        if not alike or len(actions) != len(agents):
            if problem := self._problem(actions):
                raise ActionError(problem)
            given = np.array([real_numbers(actions[agent], (2,)) for agent in agents])
        if len(agents) == len(self.possible_agents):
            return given
        stacked = np.zeros((len(self.possible_agents), 2), given.dtype)
        stacked[[self._index[agent] for agent in agents]] = given
        return stacked

    def _problem(self, actions: object) -> str:
        if not isinstance(actions, Mapping):
            return f"actions: {type(actions).__name__}; allowed: a dict of the agents' actions"
        known = self.agents
        problems = [f"{agent!r}: unknown agent" for agent in actions if agent not in self._index]
        for agent in known:
            if agent not in actions:
                problems.append(f"{agent}: missing")
            elif real_numbers(actions[agent], (2,)) is None:
                problems.append(f"{agent}: {actions[agent]!r:.80}, not two numbers")
        allowed = f"two numbers for each of {', '.join(known)}"
        return f"actions: {'; '.join(problems)}; allowed: {allowed}" if problems else ""


class NavigationAECEnv(parallel_to_aec_wrapper[str, Observation, Action]):
    """One robot acts after the other; all move once the last one has acted."""

    def __repr__(self) -> str:
        return repr(self.env).replace(type(self.env).__name__, type(self).__name__, 1)

    def step(self, action: Action | None) -> None:
        """Submit the ``action`` of ``agent_selection``: two numbers ``(2,)``, clipped to [-1, 1].

        Raises:
            ActionError: not two finite numbers, or not ``None`` after the agent's end; nothing has
                changed, so that the robot can act again.
            StepError: before the first reset, or when no agent is left.
        """
        if not getattr(self, "agents", None):
            raise StepError("step() before reset() or after the end: call reset() first")
        agent, numbers = self.agent_selection, real_numbers(action, (2,))
        if self.terminations[agent] or self.truncations[agent]:
            if action is not None:
                raise ActionError(f"{agent}: the episode has ended; allowed: None")
        elif numbers is None or not np.isfinite(numbers).all():
            raise ActionError(f"{agent}: {action!r:.80}; allowed: two finite numbers")
        super().step(numbers)


class EnvSettings(FixedSettings, total=False):
    """The keyword arguments of :class:`NavigationParallelEnv`."""

    render_mode: str | None
    render_size: tuple[int, int]
    max_cycles: int | None
    failed_agents: FailedAgents


def raw_env(
    field: FieldLike | FieldSampler = "field_03",
    n_robots: int | None = None,
    **settings: Unpack[EnvSettings],
) -> NavigationAECEnv:
    """Return the AEC form; arguments and errors as :class:`NavigationParallelEnv`."""
    return NavigationAECEnv(NavigationParallelEnv(field, n_robots, **settings))


def env(
    field: FieldLike | FieldSampler = "field_03",
    n_robots: int | None = None,
    **settings: Unpack[EnvSettings],
) -> OrderEnforcingWrapper[str, Observation, Action | None]:
    """Return the AEC form with order checks; arguments as :class:`NavigationParallelEnv`."""
    return OrderEnforcingWrapper(raw_env(field, n_robots, **settings))


parallel_env = NavigationParallelEnv
