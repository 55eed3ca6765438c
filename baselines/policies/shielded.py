"""Any policy behind the shield of :mod:`mbn_marl.planning.shield`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from baselines.algorithms import find_algorithm
from baselines.policies.information import information
from baselines.policies.policy import Policy, RandomPolicy, Wrapped
from baselines.runs.folder import RunFolder
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError

if TYPE_CHECKING:  # the planner's packages are an extra
    from mbn_marl.planning.shield import Shield


def behind(shield: bool) -> str:
    return " + shield" if shield else ""


def information_of(policy: Policy, settings: Mapping[str, Any], run: RunFolder | None) -> str:
    """Return what tables call the input of a policy, of a ``run`` if it was trained."""
    if isinstance(policy, Shielded) or policy.observes == "state":
        return "state"
    if isinstance(policy, RandomPolicy):
        return "-"
    form = None if run is None else find_algorithm(run.config["algorithm"]).form
    return information(settings, centralized=form == "centralized")


class Shielded(Wrapped):
    """A policy in whose place the shield acts where robots could not brake after its action."""

    # The shield sees the engine's true state, whatever the policy observes. Of numbers that
    # episodes draw it knows only their middles, as greedy does.
    def __init__(self, policy: Policy) -> None:
        super().__init__(policy)
        self._shields: dict[int, Shield] = {}

    def fit(self, engine: BatchEngine) -> Shielded:
        fitted = Shielded(self.policy.fit(engine))
        _shield_of(engine, 0)
        return fitted

    def act_in(self, world: BatchEngine, observations: Any, *, deterministic: bool = True) -> Any:
        n = world.n_robots
        actions = np.array(self.policy.act_in(world, observations, deterministic=deterministic))
        places, speeds = world.state()[:, : 4 * n].reshape(-1, 2, n, 2).swapaxes(0, 1)
        failed = world.failed
        for one in np.flatnonzero(world.running).tolist():
            if one not in self._shields:
                self._shields[one] = _shield_of(world, one)
            shield = self._shields[one]
            team = one, slice(shield.problem.n)
            actions[team] = shield.act(actions[team], places[team], speeds[team], failed[team])
        return actions

    def reset(self, worlds: np.ndarray | None = None) -> None:
        for one in [*self._shields] if worlds is None else np.flatnonzero(worlds).tolist():
            self._shields.pop(one, None)
        super().reset(worlds)


def _shield_of(engine: BatchEngine, world: int) -> Shield:
    from mbn_marl.planning.problem import make_problem
    from mbn_marl.planning.shield import Shield

    team = {"n_robots": None if engine.teams_vary else engine.n_robots}
    config = engine.config.model_copy(update={**team, "random_starts": False})
    try:
        return Shield(make_problem(engine.field_of(world), config, closed_loop=True))
    except ConfigError as error:
        raise ConfigError("shield", error.problems) from None
