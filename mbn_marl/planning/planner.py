"""``plan``: the proved optimum of a field, or the best interval that the time allowed."""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import Settings, make_config
from mbn_marl.engine import FieldLike
from mbn_marl.errors import ConfigError, MbnError
from mbn_marl.field import Field, load_field
from mbn_marl.planning.coordination import Verified, coordinate
from mbn_marl.planning.orders import OutOfTimeError
from mbn_marl.planning.partition import least_makespan
from mbn_marl.planning.problem import Floats, Problem, make_problem
from mbn_marl.planning.replay import Stage
from mbn_marl.planning.team import Team

BOUND_SHARE = 0.8
"""Of the time limit, for raising the bound."""
PARTITIONS = 6
"""Ways to share the ROIs out that are tried at one makespan."""


class UnsolvableError(MbnError):
    """No team can visit every ROI within an episode; the message says which, and why."""


@dataclass(frozen=True, eq=False)
class Plan:
    """What is known of the best that n robots can do in a field with m ROIs.

    Makespans are those of clean plans, in which no robot ever pushes outside the field.

    Attributes:
        field: where.
        makespan: T, the steps of the best plan found; ``None`` if none was found.
        makespan_lower_bound: no clean plan has fewer steps: proved.
        actions: (T, n, 2) float32 in [-1, 1], verified in the engine; (0, n, 2) without a plan.
        return_: the team's return with these actions, as replayed; ``None`` without a plan.
        assignment: for each robot the ROIs that it visits, in order.
        trail: (T + 1, n, 2): the replayed positions, the starts first.
        seconds: how long it took.
    """

    field: Field
    makespan: int | None
    makespan_lower_bound: int
    actions: NDArray[np.float32]
    return_: float | None
    assignment: tuple[tuple[int, ...], ...]
    trail: Floats
    seconds: float

    @property
    def optimal(self) -> bool:
        """Whether the plan is proved to be a shortest one."""
        return self.makespan == self.makespan_lower_bound


def plan(field: FieldLike, *, time_limit: float = 60.0, **settings: Unpack[Settings]) -> Plan:
    """Plan for a team that rests at the field's starts.

    Args:
        field: a catalogue name, a file, or a :class:`Field`.
        time_limit: seconds after which the best interval so far is returned.
        **settings: see :class:`mbn_marl.config.NavigationConfig`: ``n_robots``, ``wind``, ...

    Raises:
        UnsolvableError: it is proved that no team can visit every ROI within an episode.
        ConfigError: a setting or the time limit is not valid.
        FieldError: the field is not.
    """
    if not time_limit > 0.0:
        raise ConfigError("plan", [f"time_limit: expected more than 0 seconds, got {time_limit}"])
    began = time.monotonic()
    problem = make_problem(load_field(field), make_config(settings))
    stage = Stage(problem)
    team = make_team(problem, began + BOUND_SHARE * time_limit)
    try:
        known = team.raise_bound()
    except OutOfTimeError:
        known = False
    best = None
    team.deadline = began + time_limit
    if known:
        best = _shortest(problem, stage, team, began + time_limit)
    return Plan(
        field=problem.field,
        makespan=best and best.replay.steps,
        makespan_lower_bound=team.bound,
        actions=np.zeros((0, problem.n, 2), np.float32) if best is None else best.actions,
        return_=best and best.replay.return_,
        assignment=(),
        trail=np.zeros((0, problem.n, 2)) if best is None else best.replay.trail,
        seconds=time.monotonic() - began,
    )


def make_team(problem: Problem, deadline: float) -> Team:
    """The team with a horizon that its bounds will hardly exceed, so that rounding stays small."""
    team = Team(problem, problem.config.max_steps, deadline)
    horizon = 2 * least_makespan(team.bounds) + 20
    return Team(problem, min(horizon, problem.config.max_steps), deadline)


def _shortest(problem: Problem, stage: Stage, team: Team, deadline: float) -> Verified | None:
    """The first verified plan, from the bound on."""
    for steps in range(team.bound, team.horizon + 1):
        for routes in itertools.islice(team.solutions(steps), PARTITIONS):
            visits = [
                list(zip(route.visits.steps, route.order, strict=True)) for route in routes
            ]
            places = [[problem.half_planes]] * problem.n
            verified = coordinate(problem, stage, steps, visits, places, deadline)
            if verified is not None:
                return verified
            if time.monotonic() > deadline:
                return None
    return None
