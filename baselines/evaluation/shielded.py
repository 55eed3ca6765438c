"""Any policy behind the shield of :mod:`mbn_marl.planning.shield`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from baselines.evaluation.fitting import LoadedPolicy
from baselines.evaluation.policy import Origin, Policy, restart
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError

if TYPE_CHECKING:  # the planner's packages are an extra
    from mbn_marl.planning.shield import Shield


def behind(shield: bool) -> str:
    """Return what follows the name of a policy that acts behind the shield, or nothing."""
    return " + shield" if shield else ""


class Shielded:
    """A policy in whose place the shield acts where robots could not brake after its action.

    The shield sees the engine's true state, whatever the policy observes, and, as greedy, knows
    of numbers that episodes draw only their middles. :func:`~.fitting.fitted` shows it the engine.

    Args:
        policy: the policy, loaded or not.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy.policy if isinstance(policy, LoadedPolicy) else policy
        self.observes: Literal["observations", "state"] = policy.observes
        self.origin: Origin | None = getattr(self.policy, "origin", None)
        self.samples: bool = getattr(self.policy, "samples", True)
        self._watched: BatchEngine | None = None
        self._shields: list[Shield | None] = []

    @property
    def engine(self) -> BatchEngine:
        """The engine that it acts in; a ConfigError if it was not shown one."""
        if self._watched is None:
            raise ConfigError("shield", ["engine: none; needed: policy = fitted(policy, engine)"])
        return self._watched

    def watch(self, engine: BatchEngine) -> None:
        """See :func:`~.policy.show`; a ConfigError says why there is no shield for its robots."""
        self._watched, self._shields = engine, [None] * engine.num_worlds
        self._begin(0)

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """See :class:`Policy`: the actions to take where the engine is now."""
        engine, n = self.engine, self.engine.n_robots
        actions = np.array(self.policy.act(seen, deterministic=deterministic))
        places, speeds = engine.state()[:, : 4 * n].reshape(-1, 2, n, 2).swapaxes(0, 1)
        failed = engine.failed
        for world in np.flatnonzero(engine.running).tolist():
            shield = self._shields[world] or self._begin(world)
            team = world, slice(shield.problem.n)
            actions[team] = shield.act(actions[team], places[team], speeds[team], failed[team])
        return actions

    def reset(self, worlds: np.ndarray | None = None) -> None:
        """See :func:`~.policy.restart`."""
        for world in np.flatnonzero(np.ones(len(self._shields)) if worlds is None else worlds):
            self._shields[world] = None
        restart(self.policy, worlds)

    def _begin(self, world: int) -> Shield:
        """Return the shield of a world's new episode."""
        from mbn_marl.planning.problem import make_problem
        from mbn_marl.planning.shield import Shield

        engine = self.engine
        team = {"n_robots": None if engine.teams_vary else engine.n_robots}
        config = engine.config.model_copy(update={**team, "random_starts": False})
        try:
            problem = make_problem(engine.field_of(world), config, closed_loop=True)
        except ConfigError as error:
            raise ConfigError("shield", error.problems) from None
        shield = self._shields[world] = Shield(problem)
        return shield
