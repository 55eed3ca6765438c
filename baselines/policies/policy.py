"""Policies, and their fit to an environment: the same entries that they were trained with."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from copy import copy, deepcopy
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from mbn_marl.config import WITHOUT_RADIUS, NavigationConfig
from mbn_marl.engine import BatchEngine
from mbn_marl.engine.mdp.dynamics import count_headings
from mbn_marl.engine.mdp.observations import observation_table
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, FieldSampler

if TYPE_CHECKING:
    import torch

Observes = Literal["observations", "state"]
# Actions, and the memory after them.
Step = tuple["torch.Tensor", "torch.Tensor | None"]


class Origin(NamedTuple):
    """The field or fields and the configuration that a policy was trained in."""

    field: Field | FieldSampler
    config: NavigationConfig


class Policy:
    """A policy for a batch of worlds.

    Attributes:
        observes: ``"observations"``, the robots' own, (worlds, n, obs_size), or ``"state"``, the
            paper's vector, (worlds, 4n+1).
        origin: where it was trained, if it was.
    """

    observes: Observes = "observations"
    origin: Origin | None = None

    def act(self, seen: Any, *, deterministic: bool) -> Any:
        """Actions (worlds, n, 2), not clipped; sampled by torch unless ``deterministic``."""
        raise NotImplementedError

    def act_in(self, world: Any, observations: Any, *, deterministic: bool = True) -> Any:
        """Act on the ``state()`` of an engine or environment, or on its ``observations``."""
        seen = np.atleast_2d(world.state()) if self.observes == "state" else observations
        return self.act(seen, deterministic=deterministic)

    def reset(self, worlds: np.ndarray | None = None) -> None:
        """Forget past episodes, since new ones begin in ``worlds``, (worlds,) bool, or in all."""

    def draws(self, *, deterministic: bool) -> bool:
        """Return whether actions depend on random numbers."""
        return not deterministic

    def fit(self, engine: BatchEngine) -> Policy:
        """Return the policy on the entries that it was trained with, to act in this engine.

        Headings of robots and flags of failures are hidden from it if it was trained without them;
        flags that are not shown are 0. Tokens (``entities``) fit fields and teams of any size.
        With ``knowledge="own"``, it acts for each robot :class:`Alone`.

        Raises:
            ConfigError: naming all that it was trained with otherwise, and that it sees.
        """
        fitted = self._matched(engine)
        own = engine.config.knowledge == "own" and self.observes == "observations"
        return Alone(fitted, engine.n_robots) if own else fitted

    def of_robot(self, robot: int, robots: int) -> Policy:
        """Return that of one of the robots for rows (worlds, 1, size), with a memory to itself."""
        return deepcopy(self)

    def _matched(self, engine: BatchEngine) -> Policy:
        if self.origin is None:
            return self
        varies = engine.sampler is not None or engine.teams_vary
        if varies and self.origin.config.observation != "entities":
            problem = "fields: they vary, and the policy was trained on one; allowed: the same"
            raise ConfigError("policy", [problem])
        ours, theirs = acts_on(*self.origin), acts_on(engine.sampler or engine.field, engine.config)
        may_differ = {"failures"} if ours["headings"] else {"failures", "headings"}
        compared = ("robots", "ROIs", "headings") if self.observes == "state" else ours
        if problems := [
            f"{name}: the policy was trained with {ours[name]}, here it is {theirs[name]}"
            for name in compared
            if name in theirs and ours[name] != theirs[name] and name not in may_differ
        ]:
            place = "random fields" if engine.sampler is not None else engine.field.name
            raise ConfigError(f"policy in {place}", problems)
        if all(ours[name] == theirs[name] for name in may_differ):
            return self
        return Selected(self, _places(self.observes, self.origin.config, engine))


class TrainedPolicy(Policy, ABC):
    """A policy with a network, that can be kept."""

    network: Any  # a torch.nn.Module

    def of_robot(self, robot: int, robots: int) -> Policy:
        return self  # most networks have no memory

    def blank(self, seen: torch.Tensor) -> torch.Tensor | None:
        """Return the memory before the first step, (worlds, ...); ``None`` for a policy without."""
        return None

    @abstractmethod
    def step(self, seen: torch.Tensor, past: torch.Tensor | None) -> Step:
        """Mean actions (worlds, n, 2), not clipped, as ``torch.export`` can follow them."""

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Write the policy's files into ``folder``, each one atomically."""


class RandomPolicy(Policy):
    """Uniform actions in [-1, 1], the same ones from the seed after each reset of all worlds."""

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self.reset()

    def reset(self, worlds: np.ndarray | None = None) -> None:
        if worlds is None:
            self._random = np.random.default_rng(self._seed)

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        return self._random.uniform(-1.0, 1.0, size=(*seen.shape[:2], 2)).astype(np.float32)

    def draws(self, *, deterministic: bool) -> bool:
        return True

    def fit(self, engine: BatchEngine) -> Policy:
        return self  # it sees nothing; copies would move all robots alike


class Wrapped(Policy):
    def __init__(self, policy: Policy) -> None:
        self.policy, self.observes = policy, policy.observes

    def reset(self, worlds: np.ndarray | None = None) -> None:
        self.policy.reset(worlds)

    def draws(self, *, deterministic: bool) -> bool:
        return self.policy.draws(deterministic=deterministic)

    def of_robot(self, robot: int, robots: int) -> Policy:
        one = copy(self)
        one.policy = self.policy.of_robot(robot, robots)
        return one


class Alone(Wrapped):
    """A policy with a copy for each robot, which sees this robot's row and has its memory alone."""

    def __init__(self, policy: Policy, robots: int) -> None:
        super().__init__(policy)
        self._copies = [policy.of_robot(robot, robots) for robot in range(robots)]
        self._orders = np.random.default_rng(0)

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        actions = np.empty((*seen.shape[:2], 2), np.float32)
        for i in self._orders.permutation(len(self._copies)):
            row = seen[:, i : i + 1].copy()  # a view would lead to the others' rows
            actions[:, i : i + 1] = self._copies[i].act(row, deterministic=deterministic)
        return actions

    def reset(self, worlds: np.ndarray | None = None) -> None:
        for one in self._copies:
            one.reset(worlds)


class Selected(Wrapped):
    """A policy that acts on some entries of what is shown, by their places; -1 is a 0."""

    def __init__(self, policy: Policy, places: list[int]) -> None:
        super().__init__(policy)
        self._places = places

    def act(self, seen: np.ndarray, *, deterministic: bool) -> Any:
        with_zero = np.concatenate([seen, np.zeros_like(seen[..., :1])], axis=-1)
        return self.policy.act(with_zero[..., self._places], deterministic=deterministic)


def _places(observes: Observes, trained: NavigationConfig, engine: BatchEngine) -> list[int]:
    """Return the places of what a policy was trained with in what the engine shows, or -1."""
    n = engine.n_robots
    if observes == "state":
        visited = engine.state_low.size - 1
        places = [*range(5 * n if _turns(trained, n) else 4 * n)]
        if trained.failures is not None:
            shown = engine.config.failures is not None
            places += range(visited - n, visited) if shown else [-1] * n
        return [*places, visited]
    offsets = {entry.name: entry.offset for entry in engine.observation_table}
    sizes = n, engine.n_rois, engine.arena
    table = observation_table(trained, *sizes, kinds=engine.has_kinds)
    return [offsets.get(entry.name, -1) for entry in table]


def _turns(config: NavigationConfig, n: int) -> bool:
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
        "kinds": config.observation != "entities" and bool(getattr(field, "roi_kinds", ())),
        "v_clip": config.top_speed,
        "observation": config.observation,
        "assignment": bool(config.assignment),
        "one_hot": config.one_hot,
    }
    if config.observation == "entities":
        for name in ("robots", "ROIs", "arena"):
            del sizes[name]
        sizes["sensing_radius"] = min(config.sensing_radius, math.hypot(*field.arena))
    elif config.observation == "state":
        del sizes["arena"], sizes["v_clip"]
    elif config.observation not in WITHOUT_RADIUS:
        sizes["sensing_radius"] = config.sensing_radius
    return sizes
