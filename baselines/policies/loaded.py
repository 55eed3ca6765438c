"""A policy that is ready to act in a program, with the environment that it wants."""

from __future__ import annotations

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
    """Return the error of a policy that has no field."""
    return ConfigError("policy", [f"field: {source} has none; name one, such as --field field_03"])


class LoadedPolicy(Wrapped):
    """A policy that is ready to act, with the environment that it wants.

    :func:`baselines.load_policy` makes it.

    Attributes:
        name: where it comes from, and in which field it is, if that was asked for.
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

    @property
    def place(self) -> Field:
        """Its field; a ConfigError if it has none."""
        if self.field is None:
            raise needs_field(self.name)
        return self.field

    def fit(self, engine: BatchEngine) -> Policy:
        return self.policy.fit(engine)

    @cached_property
    def fitted(self) -> tuple[Policy, tuple[int, ...] | None]:
        """The policy as it acts in its field, and the shape of what one world shows there.

        Raises:
            ConfigError: naming all that the policy was trained with otherwise, or what is wrong
                with the settings.
        """
        if self.field is None:
            return self.policy, None
        engine = BatchEngine(self.field, 1, threads=1, **self.settings)
        sizes = engine.n_robots, engine.obs_size
        shape = engine.state_low.shape if self.observes == "state" else sizes
        return self.policy.fit(engine), shape

    def act(self, seen: ArrayLike | Mapping[str, ArrayLike], deterministic: bool = True) -> Any:
        """Choose actions, float32 in [-1, 1], shares of the full force.

        They are ``(W, n, 2)`` for W worlds, ``(n, 2)`` for one; for PettingZoo's dictionary, one
        with an action ``(2,)`` for each of its agents.

        Args:
            seen: what the environment shows, in its units: ``(W, n, obs_size)``,
                ``(n, obs_size)``, or a dictionary with ``(obs_size,)`` for each agent. A policy
                that ``observes`` the state takes ``engine.state()``, ``(W, size)``, or
                ``env.state()``, ``(size,)``, with size 4n+1 for n point masses.
            deterministic: take the mean actions; else sample them, from torch's generator.

        Raises:
            ConfigError: the observations are not those of an environment with ``settings``; the
                message says what they are, and what came.
        """
        if isinstance(seen, Mapping):
            return self._act_by_name(seen, deterministic)
        (fitted, shape), on_state = self.fitted, self.observes == "state"
        rank = 1 if on_state else 2  # of one world
        array = np.asarray(seen, None if on_state else np.float32)
        alone, fits = array.ndim == rank, shape is None or array.shape[-rank:] == shape
        if array.ndim not in (rank, rank + 1) or not fits:
            raise ConfigError(self.name, [f"{self._wanted()}, not {array.shape}"])
        actions = fitted.act(array[None] if alone else array, deterministic=deterministic)
        clipped: NDArray[np.float32] = np.clip(np.asarray(actions, np.float32), -1.0, 1.0)
        return clipped[0] if alone else clipped

    def act_in(self, world: Any, observations: Any, *, deterministic: bool = True) -> Any:
        """Act in an engine or an environment that has shown ``observations``.

        It gives every policy what it observes. Actions are as from :meth:`act`, a dictionary for
        PettingZoo's observations.
        """
        if self.observes == "state" and isinstance(observations, Mapping):
            actions = self.act(world.state(), deterministic)
            return {agent: actions[int(agent.removeprefix("robot_"))] for agent in observations}
        return super().act_in(world, observations, deterministic=deterministic)

    def reset(self, worlds: ArrayLike | None = None) -> None:
        """Forget what it remembers of the last episode; to call whenever episodes begin.

        Args:
            worlds: in which worlds, ``(W,)`` bool; ``None``: in all.
        """
        super().reset(None if worlds is None else np.asarray(worlds, bool))

    def _act_by_name(
        self, observations: Mapping[str, ArrayLike], deterministic: bool
    ) -> dict[str, NDArray[np.float32]]:
        """Act for the agents that are there; of others, robots see zeros."""
        if self.observes == "state":
            raise ConfigError(self.name, [f"{self._wanted()}, not a dictionary"])
        rows = {agent: np.asarray(seen, np.float32) for agent, seen in observations.items()}
        if not rows:
            return {}
        most, size = self.fitted[1] or (MAX_ROBOTS, next(iter(rows.values())).size)
        index = {f"robot_{robot}": robot for robot in range(most)}
        wanted = f"{self._wanted()}, robot_0 to robot_{most - 1} ({size},) each"
        problems = [
            f"{agent}: {wanted}, not {row.shape}"
            for agent, row in rows.items()
            if agent not in index or row.shape != (size,)
        ]
        if problems:
            raise ConfigError(self.name, problems)
        count = most if self.field else max(index[agent] for agent in rows) + 1
        seen = np.zeros((count, size), np.float32)
        for agent, row in rows.items():
            seen[index[agent]] = row
        actions = self.act(seen, deterministic)
        return {agent: actions[index[agent]] for agent in rows}

    def _wanted(self) -> str:
        """Return what it acts on, in words."""
        place = "" if self.field is None else f" in {self.field.name}"
        if self.observes == "state":
            (size,) = self.fitted[1] or ("size",)
            return f"it acts on state(){place}, (W, {size}) for W worlds or ({size},) for one"
        n, size = self.fitted[1] or ("n", "obs_size")
        kind = f"observation={make_config(self.settings).observation!r}{place}"
        return f"it acts on {kind}, (W, {n}, {size}) for W worlds or ({n}, {size}) for one"
