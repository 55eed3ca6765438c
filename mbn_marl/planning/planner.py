"""``plan``: the proved optimum of a field, or the best interval within a time limit."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from numbers import Integral, Real
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbn_marl.config import Settings, make_config
from mbn_marl.engine import FieldLike
from mbn_marl.engine.snapshot import FloatArray
from mbn_marl.errors import ConfigError, MbnError
from mbn_marl.field import Field, load_field
from mbn_marl.planning.greedy import Greedy
from mbn_marl.planning.legs import NEVER, TooManySetsError, possible_sets, proved_legs
from mbn_marl.planning.motion import coordinate
from mbn_marl.planning.orders import OutOfTimeError, UndecidedError
from mbn_marl.planning.partition import FEW_ROIS, least_makespan
from mbn_marl.planning.problem import Floats, Problem, make_problem
from mbn_marl.planning.replay import Playback, Player
from mbn_marl.planning.team import Team, make_guide
from mbn_marl.planning.waiting import PARTITIONS, wait

GREEDY_SHARE, BOUND_SHARE = 0.5, 0.8
"""Shares of the time limit after which the greedy plan and the bound are abandoned."""
STUCK = 200
"""Steps without a visit after which the greedy plan is abandoned too."""
WORK_LIMIT = 3000
"""Of plans for robots of several kinds, in linear programs: collisions keep them from the bound."""


class UnsolvableError(MbnError):
    """It is proved that no team visits every ROI within an episode without leaving the field."""


@dataclass(frozen=True, eq=False)
class Plan:
    """The best plan found for n robots, and a proved bound.

    Makespans are those of clean plans, in which no robot ever pushes outside the field.

    Attributes:
        field: the field.
        makespan: T, the steps of the best plan found; ``None`` if none was found.
        makespan_lower_bound: the proved least number of steps of any clean plan.
        actions: (T, n, 2) float32 in [-1, 1], verified in the engine; (0, n, 2) without a plan.
        return_: the team's return with these actions, in reward units; ``None`` without a plan.
        assignment: the ROIs that each robot visits, in order.
        visit_steps: the steps at which ROIs are visited, rising.
        trail: (T + 1, n, 2), the positions from the starts on, units.
        seconds: the time taken, in seconds, without compiling.
    """

    field: Field
    makespan: int | None
    makespan_lower_bound: int
    actions: NDArray[np.float32]
    return_: float | None
    assignment: tuple[tuple[int, ...], ...]
    visit_steps: tuple[int, ...]
    trail: Floats
    seconds: float

    @property
    def optimal(self) -> bool:
        return self.makespan == self.makespan_lower_bound

    def to_json(self) -> dict[str, Any]:
        """Return all but the arrays as JSON values; ROIs and robots are numbered from 0."""
        return {
            "field": self.field.to_dict(),
            "makespan": self.makespan,
            "makespan_lower_bound": self.makespan_lower_bound,
            "optimal": self.optimal,
            "return": self.return_,
            "assignment": [list(rois) for rois in self.assignment],
            "visit_steps": list(self.visit_steps),
            "seconds": self.seconds,
        }


def plan(
    field: FieldLike,
    *,
    velocities: ArrayLike | None = None,
    visited: Sequence[int] = (),
    time_limit: float = 60.0,
    work_limit: int | None = None,
    **settings: Unpack[Settings],
) -> Plan:
    """Plan for a team at the field's starts.

    Args:
        field: a catalogue name, a file, or a :class:`Field`.
        velocities: (n, 2), of the robots at the starts, units/step; ``None``: they rest.
        visited: the ROIs that have been visited before, from 0 on; not all.
        time_limit: seconds after which the best interval so far is returned, not counting the
            engine's compilation for a new configuration. Shortest paths and first bounds are
            always computed; with many ROIs and edges they take longer than a short limit.
        work_limit: if given, a limit of the work instead, in linear programs, so that the result
            does not depend on the machine's speed.
        **settings: the fields of :class:`mbn_marl.config.NavigationConfig`.

    Raises:
        UnsolvableError: it is proved that no clean plan visits every ROI within an episode.
        ConfigError: settings, velocities, visited ROIs or limits are not valid; all are listed.
        FieldError: the field is not valid.
    """
    field = load_field(field)
    limits = {"time_limit": time_limit, "work_limit": 1 if work_limit is None else work_limit}
    problems = [
        f"{name}: {limit!r}; allowed: a number above 0"
        for name, limit in limits.items()
        if not isinstance(limit, Real) or not limit > 0
    ]
    every = range(len(field.rois))
    given = list(visited) if isinstance(visited, Iterable) else [visited, *every]
    whole = all(isinstance(j, Integral) and not isinstance(j, bool) and j in every for j in given)
    if not whole or len(set(given)) == len(every):
        problems.append(f"visited: allowed: some of 0 to {every[-1]}, not all")
    try:
        problem = make_problem(field, make_config(settings))
        problem = problem if velocities is None else problem.moving(velocities)
    except ConfigError as error:
        problems += error.problems
    if problems:
        raise ConfigError("plan", problems)
    if work_limit is not None:
        problem, time_limit = replace(problem, clock=Work().add), work_limit
    left = sorted(set(every) - set(given))
    player, part = Player(problem, given), problem.only(left)
    all_rois = (1 << part.m) - 1  # compiled before the clock starts
    least_makespan(np.array([all_rois]), np.ones((1, 1), np.int64), all_rois)
    began, clock = time.monotonic(), problem.clock(0)
    refuse_unsolvable(problem, left)
    best = plan_greedily(problem, player, clock + GREEDY_SHARE * time_limit)
    try:
        team = prove(part, clock + BOUND_SHARE * time_limit)
    except TooManySetsError:
        team = prove(_hardest(part), clock + BOUND_SHARE * time_limit)
    else:
        for guide in _guides(part, team, clock + time_limit):
            for search in (_search,) if problem.convex else (wait, _search):
                most = problem.config.max_steps if best is None else len(best.actions) - 1
                best = search(part, player, guide, team.bound, most, guide.deadline) or best
    nothing = np.zeros((0, problem.n, 2), np.float32)
    return Plan(
        field=problem.field,
        makespan=len(best.actions) if best else None,
        makespan_lower_bound=team.bound,
        actions=best.actions if best else nothing,
        return_=best.return_ if best else None,
        assignment=best.assignment if best else ((),) * problem.n,
        visit_steps=best.visit_steps if best else (),
        trail=best.trail if best else problem.starts[None],
        seconds=time.monotonic() - began,
    )


class Work:
    """A clock that shows the work so far, in linear programs."""

    done = 0

    def add(self, more: int) -> float:
        self.done += more
        return self.done


def _hardest(problem: Problem) -> Problem:
    """Return the instance with few of its ROIs, far apart: a bound for some is one for all."""
    apart = np.hypot(*(problem.rois[:, None] - problem.rois[None]).transpose(2, 0, 1))
    near = np.hypot(*(problem.rois[:, None] - problem.starts[None]).transpose(2, 0, 1)).min(axis=1)
    chosen = [int(near.argmax())]
    while len(chosen) < FEW_ROIS:
        near = np.minimum(near, apart[chosen[-1]])
        chosen.append(int(near.argmax()))
    return problem.only(chosen)


def refuse_unsolvable(problem: Problem, left: Sequence[int]) -> None:
    """Raise an UnsolvableError if an ROI that is ``left`` is too far for an episode."""
    limit = problem.config.max_steps
    legs = proved_legs(problem, problem.slack(limit), limit)
    far = legs.first.min(axis=0) > limit
    if far[left].any():
        places = ", ".join(f"rois[{j}]" for j in left if far[j])
        raise UnsolvableError(
            f"{problem.field.name}: no robot can reach {places} by step {limit}, the end of an "
            "episode (max_steps), even on the shortest path"
        )


def prove(problem: Problem, deadline: float) -> Team:
    """Return the team with its bound raised as far as the deadline allows.

    Raises:
        UnsolvableError: the bound is above the length of an episode.
        TooManySetsError: many ROIs may be visited in many ways.
    """
    limit = problem.config.max_steps
    least, horizon = 0, _first_horizon(problem, limit)
    team: Team | None = None
    while least <= limit:
        horizon = min(horizon, limit)
        slack = problem.slack(horizon)  # for rounding, grows with the horizon
        legs = proved_legs(problem, slack, horizon)
        try:
            team = Team(problem, legs, slack, horizon, deadline, bound=least)
            if team.raise_bound():
                return team
        except (TooManySetsError, OutOfTimeError):
            if team is None:
                raise
            return team
        least, horizon = horizon + 1, _beyond(problem, horizon)
    raise UnsolvableError(
        f"{problem.field.name}: the robots cannot visit all ROIs by step {limit}, the end of an "
        "episode (max_steps), without pushing outside the field"
    )


def _first_horizon(problem: Problem, limit: int) -> int:
    legs = proved_legs(problem, problem.slack(limit), limit)
    least = int(legs.first.min(axis=0).max())
    while least <= limit:
        sets = possible_sets(legs, least)
        found = least_makespan(sets.masks, sets.bounds, (1 << problem.m) - 1)
        if found < NEVER:
            return _beyond(problem, found)
        least = _beyond(problem, least)
    return limit


def _beyond(problem: Problem, steps: int) -> int:
    """Return a later horizon; of many ROIs, a step more allows many more sets."""
    return 2 * steps + 20 if problem.m <= FEW_ROIS else steps + steps // 4 + 3


def _guides(problem: Problem, team: Team, deadline: float) -> list[Team]:
    """Return the teams to follow; a guide, where the field is not convex, for half of the time."""
    team.deadline, guides = deadline, [team]
    with suppress(TooManySetsError):
        if not problem.convex:
            half = 0.5 * (problem.clock(0) + deadline)
            guides.insert(0, make_guide(problem, team.horizon, half))
    return guides


def _search(
    problem: Problem, player: Player, guide: Team, bound: int, most: int, deadline: float
) -> Playback | None:
    for steps in range(bound, most + 1):
        if problem.clock(0) > deadline:
            break
        try:
            for routes in itertools.islice(guide.solutions(steps), PARTITIONS):
                playback = coordinate(problem, player.verify, steps, routes, deadline)
                if playback is not None:
                    return playback
                if problem.clock(0) > deadline:
                    return None
        except UndecidedError:
            continue
        except OutOfTimeError:
            return None
    return None


def plan_greedily(problem: Problem, player: Player, deadline: float) -> Playback | None:
    """Return the greedy controller's episode if it is clean and complete by the deadline."""
    greedy, counts = Greedy(problem), list[int]()

    def act(
        positions: FloatArray, velocities: FloatArray, visited: NDArray[np.bool_]
    ) -> NDArray[np.float32] | None:
        counts.append(int(visited.sum()))
        stuck = len(counts) > STUCK and counts[-1] == counts[-STUCK]
        if stuck or problem.clock(0) > deadline:
            return None
        return greedy.act(positions, velocities, visited)

    playback = player.play(act)
    return playback if playback.clean else None
