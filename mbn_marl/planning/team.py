"""The proved bound: the least makespan of the team without regard to collisions.

The relaxed problem asks that every ROI be visited by step T, each robot staying in the convex hull
of the field until its last visit. A plan of the real problem solves it, and who solves it by T
solves it by T + 1, so a set of ROIs that a robot cannot visit by T bounds all larger sets too. Where
robots can wait at their starts, a robot may be taken to make its last visit exactly at T.
"""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import highspy
import numpy as np

from mbn_marl.planning import legs
from mbn_marl.planning.legs import NEVER, Ints
from mbn_marl.planning.orders import OutOfTimeError, Search, Visits
from mbn_marl.planning.partition import cheapest_partition, least_makespan
from mbn_marl.planning.problem import Problem
from mbn_marl.planning.relaxation import Disc, Region, Windows, make_solver


USED = 100
"""What it costs to use a robot's set again in another partition."""


@dataclass(frozen=True)
class Route:
    """What one robot is to visit, and when.

    Attributes:
        order: the ROIs, in order.
        visits: when, and by what path.
    """

    order: tuple[int, ...]
    visits: Visits


@dataclass
class Team:
    """Finds the least makespan for which every robot's share has been verified.

    Attributes:
        problem: the instance.
        horizon: the makespans of interest end here; the allowance for rounding grows with it.
        deadline: when to give up, on the clock ``time.monotonic``.
        bound: a proved lower bound of the makespan, rising.
    """

    problem: Problem
    horizon: int
    deadline: float
    bound: int = 0
    highs: highspy.Highs = field(default_factory=make_solver)
    _routes: dict[tuple[int, int], tuple[int, Route]] = field(default_factory=dict)
    _earliest: dict[tuple[int, tuple[int, ...]], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Find the closed-form bounds."""
        most = self.horizon
        self.slack = self.problem.slack(most)
        self.first = legs.first_steps(self.problem, self.slack, most)
        self.between = legs.steps_between(self.problem, self.slack, most)
        self.tail = legs.tails(self.between)
        self.bounds: Ints = legs.set_bounds(self.first, self.tail)
        self.masks = np.arange(self.bounds.shape[1])
        normals, offsets = self.problem.half_planes
        corners = self.problem.field.vertices
        self.region = Region(
            normals,
            offsets + self.slack,
            tuple((corners.min(axis=0) - self.slack).tolist()),
            tuple((corners.max(axis=0) + self.slack).tolist()),
        )

    def raise_bound(self) -> bool:
        """Raise the bound until every robot's share is verified at it: whether it is in sight.

        Raises:
            OutOfTimeError: at the deadline; ``bound`` is valid all the same.
        """
        while self.bound <= self.horizon:
            self.bound = max(self.bound, least_makespan(self.bounds))
            if next(self.solutions(self.bound), None) is not None:
                return True
            self.bound = max(self.bound + 1, least_makespan(self.bounds))
        return False

    def solutions(self, makespan: int) -> Iterator[list[Route]]:
        """Ways to visit everything by ``makespan``, a route for each robot, all different.

        The easiest come first. The bounds rise in passing, so none at all is a proof.
        """
        used: Counter[tuple[int, int]] = Counter()
        seen = set()
        while (masks := self._partition(makespan, used)) is not None:
            if tuple(masks) in seen:
                return
            routes = {}
            for i in sorted(range(len(masks)), key=lambda i: -self.bounds[i, masks[i]]):
                routes[i] = self.route(i, masks[i], makespan)
                if routes[i] is None:
                    break
            else:
                seen.add(tuple(masks))
                used.update(enumerate(masks))
                yield [route for _, route in sorted(routes.items()) if route is not None]

    def _partition(self, makespan: int, used: Counter[tuple[int, int]]) -> list[int] | None:
        """The easiest partition whose bounds all are within ``makespan``.

        Sets that have been verified cost nothing; sets that have been ``used`` cost the more.
        """
        sizes = np.array([mask.bit_count() for mask in self.masks.tolist()])
        costs = np.where(self.bounds <= makespan, 1 + sizes**2, NEVER)
        for (i, mask), (step, _) in self._routes.items():
            if step <= makespan:
                costs[i, mask] = 0
        costs[:, 0] = 0
        for (i, mask), times in used.items():
            costs[i, mask] += USED * times * (1 + sizes[mask])
        return cheapest_partition(costs)

    def route(self, i: int, mask: int, makespan: int) -> Route | None:
        """A way for robot i to visit the set by ``makespan``; ``None`` raises its bound."""
        known = self._routes.get((i, mask))
        if known is not None and known[0] <= makespan:
            return self._later(i, known[1], makespan - known[0])
        if self.bounds[i, mask] > makespan:
            return None
        found = self._extend(i, (), mask, makespan) if mask else Route((), _nothing())
        if found is None:
            supersets = (self.masks & mask) == mask
            self.bounds[i, supersets] = np.maximum(self.bounds[i, supersets], makespan + 1)
        else:
            self._routes[i, mask] = makespan, found
        return found

    def _later(self, i: int, route: Route, steps: int) -> Route:
        """The same route after waiting at the start."""
        if not steps or not self.problem.can_wait or not route.order:
            return route
        visits = route.visits
        path = np.concatenate([np.tile(self.problem.starts[i], (steps, 1)), visits.path])
        shifted = tuple(step + steps for step in visits.steps)
        return Route(route.order, Visits(shifted, visits.inflation, path))

    def _extend(self, i: int, order: tuple[int, ...], rest: int, makespan: int) -> Route | None:
        """Depth first over the orders that begin with ``order`` and go on with the set ``rest``."""
        if time.monotonic() > self.deadline:
            raise OutOfTimeError
        options = []
        for j in range(self.problem.m):
            if rest >> j & 1:
                tail = int(self.tail[rest & ~(1 << j), j])
                options.append((self._reached(i, (*order, j)) + tail, j, tail))
        for total, j, tail in sorted(options):
            if total > makespan:
                break
            longer, left = (*order, j), rest & ~(1 << j)
            discs, windows = self._discs(longer), self._windows(i, longer, makespan - tail)
            search = Search(
                (float(self.problem.starts[i, 0]), float(self.problem.starts[i, 1])),
                self.problem.drives[i],
                self.region,
                self.slack,
                self.highs,
                self.deadline,
            )
            if left == 0:
                if (visits := search.visits(discs, windows)) is not None:
                    return Route(longer, visits)
            elif len(longer) == 1 or search.possible(discs, windows):
                if (route := self._extend(i, longer, left, makespan)) is not None:
                    return route
                continue
            self._earliest[i, longer] = makespan - tail + 1
        return None

    def _reached(self, i: int, order: tuple[int, ...]) -> int:
        """A lower bound of the step at which robot i can visit the last ROI of ``order``."""
        if len(order) == 1:
            least = int(self.first[i, order[0]])
        else:
            least = self._reached(i, order[:-1]) + int(self.between[order[-2], order[-1]])
        return max(least, self._earliest.get((i, order), 0))

    def _discs(self, order: tuple[int, ...]) -> tuple[Disc, ...]:
        radius = self.problem.config.roi_radius
        centres = self.problem.rois[list(order)].tolist()
        return tuple(Disc((x, y), radius) for x, y in centres)

    def _windows(self, i: int, order: tuple[int, ...], last: int) -> Windows:
        """The windows of an order that ends by step ``last``, with all that is known of when."""
        legs = [int(self.between[j, k]) for j, k in itertools.pairwise(order)]
        count = len(order)
        return Windows(
            first=tuple(self._reached(i, order[: k + 1]) for k in range(count)),
            last=(last,) * count,
            least=(int(self.first[i, order[0]]), *legs),
            most=(last,) * count,
        )


def _nothing() -> Visits:
    return Visits((), 0.0, np.zeros((0, 2)))
