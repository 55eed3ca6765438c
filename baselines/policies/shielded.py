"""Any policy behind the shield of :mod:`mbn_marl.planning.shield`."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from baselines.algorithms import find_algorithm
from baselines.policies.information import information
from baselines.policies.policy import Policy, RandomPolicy, Wrapped
from baselines.runs.folder import RunFolder
from mbn_marl.config import make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError

if TYPE_CHECKING:  # the planner's packages are an extra
    from baselines.policies.braking import OwnShield
    from mbn_marl.planning.problem import Problem
    from mbn_marl.planning.shield import Shield


def behind(shield: bool) -> str:
    return " + shield" if shield else ""


def information_of(policy: Policy, settings: Mapping[str, Any], run: RunFolder | None) -> str:
    """Return what tables call the input of a policy, of a ``run`` if it was trained."""
    own = make_config(settings).knowledge == "own"
    if policy.observes == "state" or (isinstance(policy, Shielded) and not own):
        return "state"
    if isinstance(policy, RandomPolicy):
        return "-"
    form = None if run is None else find_algorithm(run.config["algorithm"]).form
    return information(settings, centralized=form == "centralized")


class Shielded(Wrapped):
    """A policy in whose place the shield acts where robots could not brake after its action."""

    # The shield sees the engine's true state, whatever the policy observes, except of robots that
    # act on their own knowledge. Of numbers that episodes draw it knows only their middles.
    def __init__(self, policy: Policy, own: "OwnShield | None" = None) -> None:
        super().__init__(policy)
        self._shields: dict[int, Shield] = {}
        self._own = own

    def fit(self, engine: BatchEngine) -> "Shielded":
        from baselines.policies.braking import OwnShield

        problem = _problem_of(engine, 0)
        own = engine.config.knowledge == "own" and self.observes == "observations"
        return Shielded(self.policy.fit(engine), OwnShield(problem, engine) if own else None)

    def act_in(self, world: BatchEngine, observations: Any, *, deterministic: bool = True) -> Any:
        from mbn_marl.planning.shield import Shield

        n = world.n_robots
        actions = np.array(self.policy.act_in(world, observations, deterministic=deterministic))
        if self._own is not None:
            return self._own.act(actions, observations)
        places, speeds = world.state()[:, : 4 * n].reshape(-1, 2, n, 2).swapaxes(0, 1)
        failed = world.failed
        for one in np.flatnonzero(world.running).tolist():
            if one not in self._shields:
                self._shields[one] = Shield(_problem_of(world, one))
            shield = self._shields[one]
            team = one, slice(shield.problem.n)
            actions[team] = shield.act(actions[team], places[team], speeds[team], failed[team])
        return actions

    def reset(self, worlds: np.ndarray | None = None) -> None:
        for one in [*self._shields] if worlds is None else np.flatnonzero(worlds).tolist():
            self._shields.pop(one, None)
        super().reset(worlds)


def _problem_of(engine: BatchEngine, world: int) -> "Problem":
    from mbn_marl.planning.problem import make_problem

    team = {"n_robots": None if engine.teams_vary else engine.n_robots}
    config = engine.config.model_copy(update={**team, "random_starts": False})
    try:
        return make_problem(engine.field_of(world), config, closed_loop=True)
    except ConfigError as error:
        raise ConfigError("shield", error.problems) from None
