"""A policy that is ready to act in a program, with the environment that it wants."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from baselines.policies.policy import Policy, Wrapped
from mbn_marl.config import MAX_ROBOTS, make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field


def needs_field(source: str) -> ConfigError:
    forms = f"--field field_03, or load_policy({source!r}, 'field_03')"
    return ConfigError("policy", [f"field: {source} has none; name one, such as {forms}"])


class LoadedPolicy(Wrapped):
    """A policy that is ready to act, which :func:`baselines.load_policy` makes.

    Attributes:
        settings: the keyword arguments of the environment that it wants, as in
            ``parallel_env(policy.field, **policy.settings)``.
        field: the :class:`~mbn_marl.Field` that it was trained in or made for; ``None``: any.
        observes: ``"observations"``, the robots' own, or ``"state"``, that of the environment.
        policy: the policy itself, without the checks.
    """

    def __init__(
        self, name: str, policy: Policy, settings: Mapping[str, Any], field: Field | None
    ) -> None:
        super().__init__(policy)
        self.name, self.settings, self.field = name, dict(settings), field

    def __repr__(self) -> str:
        return f"LoadedPolicy({self.name!r}, field={self.field and self.field.name!r})"

    @property
    def place(self) -> Field:
        if self.field is None:
            raise needs_field(self.name)
        return self.field

    def fit(self, engine: BatchEngine) -> Policy:
        return self.policy.fit(engine)

    def reset(self, worlds: np.ndarray | None = None) -> None:
        self.fitted[0].reset(worlds)  # which may have a memory for each robot

    @cached_property
    def fitted(self) -> tuple[Policy, tuple[int, ...] | None]:
        """The policy as it acts in its field, and the shape of what one world shows there."""
        if self.field is None:
            return self.policy, None
        engine = BatchEngine(self.field, 1, threads=1, **self.settings)
        sizes = engine.n_robots, engine.obs_size
        shape = engine.state_low.shape if self.observes == "state" else sizes
        return self.policy.fit(engine), shape

    def act(self, seen: ArrayLike | Mapping[str, ArrayLike], deterministic: bool = True) -> Any:
        """Choose actions in [-1, 1], mean ones or sampled by torch.

        They are ``(W, n, 2)`` for observations ``(W, n, obs_size)`` of W worlds, ``(n, 2)`` for
        ``(n, obs_size)``, or a dictionary for PettingZoo's. A policy that ``observes`` the state
        takes ``(W, size)`` or ``(size,)``, with size 4n+1 for n point masses.

        Raises:
            ConfigError: the observations are not those of an environment with ``settings``.
        """
        if isinstance(seen, Mapping):
            return self._act_by_name(seen, deterministic)
        on_state = self.observes == "state"
        return self._act(np.asarray(seen, None if on_state else np.float32), deterministic)

    def act_in(self, world: Any, observations: Any, *, deterministic: bool = True) -> Any:
        """Act as :meth:`act`, in an engine or an environment that has shown ``observations``."""
        by_name = isinstance(observations, Mapping)
        if self.observes != "state":
            if by_name:
                return self._act_by_name(observations, deterministic, len(world.possible_agents))
            return self.act(observations, deterministic)
        actions = self._act(np.asarray(world.state()), deterministic, world)
        if not by_name:
            return actions
        return {agent: actions[int(agent.removeprefix("robot_"))] for agent in observations}

    def _act(self, seen: NDArray[Any], deterministic: bool, world: Any = None) -> Any:
        fitted, shape = self.fitted
        rank = 1 if self.observes == "state" else 2  # of one world
        alone, fits = seen.ndim == rank, shape is None or seen.shape[-rank:] == shape
        if seen.ndim not in (rank, rank + 1) or not fits:
            raise ConfigError(self.name, [f"{self._wanted()}, not {seen.shape}"])
        rows = seen[None] if alone else seen
        if world is None:
            actions = fitted.act(rows, deterministic=deterministic)
        else:
            actions = fitted.act_in(world, rows, deterministic=deterministic)
        clipped: NDArray[np.float32] = np.clip(np.asarray(actions, np.float32), -1.0, 1.0)
        return clipped[0] if alone else clipped

    def _act_by_name(
        self, observations: Mapping[str, ArrayLike], deterministic: bool, team: int | None = None
    ) -> dict[str, NDArray[np.float32]]:
        if self.observes == "state":
            raise ConfigError(self.name, [f"{self._wanted()}, not a dictionary"])
        rows = {agent: np.asarray(seen, np.float32) for agent, seen in observations.items()}
        if not rows:
            return {}
        most, size = self.fitted[1] or (MAX_ROBOTS, next(iter(rows.values())).size)
        index = {f"robot_{robot}": robot for robot in range(most)}
        wanted = f"{self._wanted()}, robot_0 to robot_{most - 1} ({size},) each"
        if problems := [
            f"{agent}: {wanted}, not {row.shape}"
            for agent, row in rows.items()
            if agent not in index or row.shape != (size,)
        ]:
            raise ConfigError(self.name, problems)
        count = most if self.field else team or max(index[agent] for agent in rows) + 1
        seen = np.zeros((count, size), np.float32)
        for agent, row in rows.items():
            seen[index[agent]] = row
        actions = self.act(seen, deterministic)
        return {agent: actions[index[agent]] for agent in rows}

    def _wanted(self) -> str:
        place = "" if self.field is None else f" in {self.field.name}"
        if self.observes == "state":
            (size,) = self.fitted[1] or ("size",)
            return f"it acts on state(){place}, (W, {size}) for W worlds or ({size},) for one"
        n, size = self.fitted[1] or ("n", "obs_size")
        kind = f"observation={make_config(self.settings).observation!r}{place}"
        return f"it acts on {kind}, (W, {n}, {size}) for W worlds or ({n}, {size}) for one"
