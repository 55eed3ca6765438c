"""Policies brought to what an environment shows, and checked against it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baselines.evaluation.policy import Origin, Policy, restart, show
from mbn_marl.config import MAX_ROBOTS, NavigationConfig, make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.engine.mdp.dynamics import count_headings
from mbn_marl.engine.mdp.observations import WITH_RADIUS, observation_table
from mbn_marl.errors import ConfigError, unknown
from mbn_marl.field import Field, FieldSampler

Actions = NDArray[np.float32]
OfEach = dict[str, Actions]


class LoadedPolicy:
    """A policy that is ready to act, with the environment that it wants.

    :func:`baselines.load_policy` makes it.

    Args:
        name: where it comes from.
        policy: the policy.
        settings: the keyword arguments of its environment.
        field: its field, if it has one.

    Attributes:
        name: where it comes from.
        settings: the keyword arguments of the environment that it wants, as in
            ``parallel_env(policy.field, **policy.settings)``.
        field: the :class:`~mbn_marl.Field` that it was trained in or made for; ``None``: any.
        observes: ``"observations"``, the robots' own, or ``"state"``, that of the environment.
        policy: the policy itself, without the checks.

    Raises:
        ConfigError: naming all that the policy was trained with otherwise, or what is wrong with
            the settings.
    """

    def __init__(
        self, name: str, policy: Policy, settings: Mapping[str, Any], field: Field | None
    ) -> None:
        self.name, self.policy, self.observes = name, policy, policy.observes
        self.settings, self.field = dict(settings), field
        self._acting = policy
        self._shape: tuple[int, ...] | None = None  # of what one world shows
        if field is not None:
            engine = BatchEngine(field, 1, threads=1, **settings)
            self._acting = fitted(policy, engine)
            sizes = engine.n_robots, engine.obs_size
            self._shape = engine.state_low.shape if self.observes == "state" else sizes

    @overload
    def act(self, observations: Mapping[str, ArrayLike], deterministic: bool = True) -> OfEach: ...

    @overload
    def act(self, observations: ArrayLike, deterministic: bool = True) -> Actions: ...

    def act(
        self, observations: ArrayLike | Mapping[str, ArrayLike], deterministic: bool = True
    ) -> Actions | OfEach:
        """Choose actions, float32 in [-1, 1], shares of the full force.

        They are ``(W, n, 2)`` for W worlds, ``(n, 2)`` for one; for PettingZoo's dictionary, one
        with an action ``(2,)`` for each of its agents.

        Args:
            observations: what the environment shows, in its units: ``(W, n, obs_size)``,
                ``(n, obs_size)``, or a dictionary with ``(obs_size,)`` for each agent. A policy
                that ``observes`` the state takes ``engine.state()``, ``(W, size)``, or
                ``env.state()``, ``(size,)``, with size 4n+1 for n point masses.
            deterministic: take the mean actions; else sample them, from torch's generator.

        Raises:
            ConfigError: the observations are not those of an environment with ``settings``; the
                message says what they are, and what came.
        """
        if isinstance(observations, Mapping):
            return self._act_by_name(observations, deterministic)
        rank = 1 if self.observes == "state" else 2  # of one world
        seen = np.asarray(observations, None if self.observes == "state" else np.float32)
        fits = self._shape is None or seen.shape[-rank:] == self._shape
        if seen.ndim not in (rank, rank + 1) or not fits:
            raise ConfigError(self.name, [f"{self._wanted()}, not {seen.shape}"])
        if seen.ndim == rank:
            actions: Actions = self._act(seen[None], deterministic)[0]
            return actions
        return self._act(seen, deterministic)

    def reset(self, worlds: ArrayLike | None = None) -> None:
        """Forget what it remembers of the last episode; to call whenever episodes begin.

        Args:
            worlds: in which worlds, ``(W,)`` bool; ``None``: in all.
        """
        restart(self._acting, None if worlds is None else np.asarray(worlds, bool))

    def _act(self, seen: np.ndarray, deterministic: bool) -> Actions:
        actions = np.asarray(self._acting.act(seen, deterministic=deterministic), np.float32)
        return np.clip(actions, -1.0, 1.0)

    def _act_by_name(self, observations: Mapping[str, ArrayLike], deterministic: bool) -> OfEach:
        """Act for the agents that are there; of others, robots see zeros."""
        if self.observes == "state":
            raise ConfigError(self.name, [f"{self._wanted()}, not a dictionary"])
        rows = {agent: np.asarray(seen, np.float32) for agent, seen in observations.items()}
        if not rows:
            return {}
        most, size = self._shape or (MAX_ROBOTS, next(iter(rows.values())).size)
        index = {f"robot_{robot}": robot for robot in range(most)}
        problems = [f"{agent}: {unknown('agent', agent, index)}" for agent in rows.keys() - index]
        problems += [
            f"{agent}: {self._wanted()}, a robot's ({size},), not {row.shape}"
            for agent, row in rows.items()
            if row.shape != (size,)
        ]
        if problems:
            raise ConfigError(self.name, problems)
        count = max(index[agent] for agent in rows) + 1 if self._shape is None else most
        seen = np.zeros((1, count, size), np.float32)
        for agent, row in rows.items():
            seen[0, index[agent]] = row
        actions = self._act(seen, deterministic)[0]
        return {agent: actions[index[agent]] for agent in rows}

    def _wanted(self) -> str:
        """Return what it acts on, in words."""
        place = "" if self.field is None else f" in {self.field.name}"
        if self.observes == "state":
            size = "size" if self._shape is None else self._shape[0]
            return f"it acts on state(){place}, (W, {size}) for W worlds or ({size},) for one"
        n, size = self._shape or ("n", "obs_size")
        kind = make_config(self.settings).observation
        return (
            f"it acts on observation={kind!r}{place}, (W, {n}, {size}) for W worlds or "
            f"({n}, {size}) for one"
        )


class Selected:
    """A policy that acts on the entries that it was trained with.

    Args:
        policy: the policy.
        entries: their places in what it is shown; -1 for those that are not shown: they are 0.
    """

    def __init__(self, policy: Policy, entries: list[int]) -> None:
        self.observes = policy.observes
        self._policy, self._entries = policy, entries

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """See :class:`Policy`."""
        with_zero = np.concatenate([seen, np.zeros_like(seen[..., :1])], axis=-1)
        return self._policy.act(with_zero[..., self._entries], deterministic=deterministic)

    def reset(self, worlds: np.ndarray | None = None) -> None:
        """See :func:`~.policy.restart`."""
        restart(self._policy, worlds)


def fitted(policy: Policy, engine: BatchEngine) -> Policy:
    """Return a policy that acts on what the engine shows; it is to act in this engine.

    One that acts on tokens (``observation="entities"``) fits fields and teams of any size.

    Of the headings of robots and the flags of those that have failed, a loaded policy that was
    trained without them sees nothing. One that was trained with flags sees 0 where no robot can
    fail.

    Raises:
        ConfigError: naming all that a loaded policy was trained with otherwise: robots, ROIs and,
            if it acts on the robots' own observations, their kind and what they are scaled by.
    """
    policy = policy.policy if isinstance(policy, LoadedPolicy) else policy
    show(policy, engine)
    trained: Origin | None = getattr(policy, "origin", None)
    if trained is None:
        return policy
    anywhere = trained.config.observation == "entities"
    if (engine.sampler is not None or engine.teams_vary) and not anywhere:
        problem = "fields: they vary, and the policy was trained on one; allowed: the same"
        raise ConfigError("policy", [problem])
    ours, theirs = acts_on(*trained), acts_on(engine.sampler or engine.field, engine.config)
    may_differ = {"failures"} if ours["headings"] else {"failures", "headings"}
    problems = [
        f"{name}: the policy was trained with {ours[name]}, here it is {theirs[name]}"
        for name in (
            ("robots", "ROIs", "headings", "failures") if policy.observes == "state" else ours
        )
        if name in theirs and ours[name] != theirs[name] and name not in may_differ
    ]
    if problems:
        place = "random fields" if engine.sampler is not None else engine.field.name
        raise ConfigError(f"policy in {place}", problems)
    if all(ours[name] == theirs[name] for name in may_differ):
        return policy
    return Selected(policy, _known_entries(policy, trained, engine))


def _known_entries(policy: Policy, trained: Origin, engine: BatchEngine) -> list[int]:
    """Return the places of what a policy was trained with in what the engine shows, or -1."""
    n = engine.n_robots
    if policy.observes == "state":
        visited = engine.state_low.size - 1
        kept = [*range(4 * n), *(range(4 * n, 5 * n) if _turns(trained.config, n) else ())]
        if trained.config.failures is not None:
            shown = engine.config.failures is not None
            kept += range(visited - n, visited) if shown else [-1] * n
        return [*kept, visited]
    places = {entry.name: entry.offset for entry in engine.observation_table}
    table = observation_table(trained.config, n, engine.n_rois, engine.arena)
    return [places.get(entry.name, -1) for entry in table]


def _turns(config: NavigationConfig, n: int) -> bool:
    """Return whether a robot of a team of n has a heading."""
    return count_headings(config.of_each("dynamics", n)) > 0


def acts_on(field: Field | FieldSampler, config: NavigationConfig) -> dict[str, Any]:
    """Return by name what the numbers that a policy acts on depend on."""
    if isinstance(field, FieldSampler):
        robots, rois = field.robots[1], field.rois[1]
    else:
        robots, rois = len(field.starts), len(field.rois)
    robots = config.n_robots or robots
    sizes = {
        **{"robots": robots, "ROIs": rois, "arena": tuple(map(float, field.arena))},
        "headings": _turns(config, robots),
        "failures": config.failures is not None,
        "v_clip": config.top_speed,
        "observation": config.observation,
        "assignment": bool(config.assignment),
        "one_hot": config.one_hot,
    }
    if config.observation == "entities":
        for name in ("robots", "ROIs", "arena"):
            del sizes[name]
        sizes["sensing_radius"] = min(config.sensing_radius, math.hypot(*field.arena))
    elif config.observation in WITH_RADIUS:
        sizes["sensing_radius"] = config.sensing_radius
    elif config.observation == "state":
        del sizes["arena"], sizes["v_clip"]
    return sizes
