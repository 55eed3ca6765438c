"""The proved bound: the least makespan of the team without regard to collisions.

The relaxed problem asks that every ROI be visited by step T, each robot staying in the convex hull
of the field until its last visit. A plan of the real problem solves it, and who solves it by T
solves it by T + 1, so a set of ROIs that a robot cannot visit by T bounds all larger sets too.
Where robots can wait at their starts, a robot may be taken to make its last visit exactly at T.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import highspy
import numpy as np

from mbn_marl.planning.legs import NEVER, Ints, Legs, set_bounds, tails
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

    @property
    def sure(self) -> bool:
        """Whether no disc has to be inflated; otherwise only rounding might allow the route."""
        return self.visits.inflation <= 0.0


NO_GATES: Mapping[tuple[int, int], tuple[Disc, ...]] = {}


@dataclass
class Team:
    """Finds the least makespan for which every robot's share has been verified.

    Attributes:
        problem: the instance.
        legs: least steps of single legs.
        slack: discs and hull may be missed by this much, in units: what rounding can do.
        horizon: makespans of interest end here.
        deadline: when to give up, on the clock ``time.monotonic``.
        gates: discs to pass on the way from one place to another; places are the starts, then the
            ROIs. Gates guide the search round corners; with them the bound is none.
        bound: a lower bound of the makespan, rising.
    """

    problem: Problem
    legs: Legs
    slack: float
    horizon: int
    deadline: float
    gates: Mapping[tuple[int, int], tuple[Disc, ...]] = field(default_factory=lambda: NO_GATES)
    bound: int = 0
    highs: highspy.Highs = field(default_factory=make_solver)
    _routes: dict[tuple[int, int], tuple[int, Route]] = field(default_factory=dict)
    _earliest: dict[tuple[int, tuple[int, ...]], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Find the closed-form bounds."""
        self.tail = tails(self.legs.between)
        self.bounds: Ints = set_bounds(self.legs.first, self.tail)
        self.masks = np.arange(self.bounds.shape[1])
        normals, offsets = self.problem.half_planes
        low_x, low_y, high_x, high_y = self.problem.field.polygon.bounds
        self.region = Region(
            normals,
            offsets + self.slack,
            (low_x - self.slack, low_y - self.slack),
            (high_x + self.slack, high_y + self.slack),
        )

    def raise_bound(self) -> bool:
        """Raise the bound until every robot's share is verified at it: whether it is in sight.

        Raises:
            OutOfTimeError: at the deadline; ``bound`` is valid all the same.
        """
        while self.bound <= self.horizon:
            self.bound = max(self.bound, least_makespan(self.bounds))
            if self.bound > self.horizon:
                break
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
        for (i, mask), (step, route) in self._routes.items():
            if step <= makespan and route.sure:
                costs[i, mask] = 0
        costs[:, 0] = 0
        for (i, mask), times in used.items():
            costs[i, mask] += USED * times * (1 + sizes[mask])
        return cheapest_partition(costs)

    def route(self, i: int, mask: int, makespan: int) -> Route | None:
        """A way for robot i to visit the set by ``makespan``; ``None`` raises its bound."""
        known = self._routes.get((i, mask))
        if known is not None and known[0] <= makespan:
            later = makespan - known[0]
            if not later or known[1].sure:
                return self._later(i, known[1], later)
        if self.bounds[i, mask] > min(makespan, self.horizon):
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
            stops = self._stops(i, longer, makespan - tail, ends=left == 0)
            search = Search(
                (float(self.problem.starts[i, 0]), float(self.problem.starts[i, 1])),
                self.problem.drives[i],
                self.region,
                self.slack,
                self.highs,
                self.deadline,
            )
            if left == 0:
                if (visits := search.visits(stops.discs, stops.windows)) is not None:
                    return Route(longer, stops.of_rois(visits))
            elif len(longer) == 1 or search.possible(stops.discs, stops.windows):
                if (route := self._extend(i, longer, left, makespan)) is not None:
                    return route
                continue
            self._earliest[i, longer] = makespan - tail + 1
        return None

    def _reached(self, i: int, order: tuple[int, ...]) -> int:
        """A lower bound of the step at which robot i can visit the last ROI of ``order``."""
        if len(order) == 1:
            least = int(self.legs.first[i, order[0]])
        else:
            least = self._reached(i, order[:-1]) + int(self.legs.between[order[-2], order[-1]])
        return max(least, self._earliest.get((i, order), 0))

    def _stops(self, i: int, order: tuple[int, ...], last: int, ends: bool) -> _Stops:
        """The stops of an order that is made by step ``last``, with all that is known of when.

        If the route ``ends`` there and robots can wait, it ends at that very step.
        """
        n, radius = self.problem.n, self.problem.config.roi_radius
        discs: list[Disc] = []
        first: list[int] = []
        least: list[int] = []
        rois = []
        reached, place = 0, i
        for k, j in enumerate(order):
            gates = self.gates.get((place, n + j), ())
            leg = int(self.legs.between[order[k - 1], j] if k else self.legs.first[i, j])
            discs += gates
            first += [reached] * len(gates)
            least += [0] * len(gates)
            reached, place = self._reached(i, order[: k + 1]), n + j
            rois.append(len(discs))
            x, y = self.problem.rois[j].tolist()
            discs.append(Disc((x, y), radius))
            first.append(reached)
            least.append(0 if gates else leg)
        if ends and self.problem.can_wait:
            first[-1] = last
        count = len(discs)
        windows = Windows(tuple(first), (last,) * count, tuple(least), (last,) * count)
        return _Stops(tuple(discs), windows, tuple(rois))


@dataclass(frozen=True)
class _Stops:
    """Stops of a route; ``rois`` are the places of the ROIs among them."""

    discs: tuple[Disc, ...]
    windows: Windows
    rois: tuple[int, ...]

    def of_rois(self, visits: Visits) -> Visits:
        """The visits of the ROIs alone."""
        return replace(visits, steps=tuple(visits.steps[k] for k in self.rois))


def _nothing() -> Visits:
    return Visits((), 0.0, np.zeros((0, 2)))
