"""The proved bound: the least makespan of the team if collisions are ignored.

The relaxed problem is to visit every ROI by step T, with each robot in the convex hull of the field
until its last visit, and out of the obstacles as far as the search decides it. Every plan of the
real problem solves it, and a solution by T is one by T + 1, so a set of ROIs that a robot cannot
visit by T bounds all larger sets too. If robots can wait at their starts, a robot's last visit
can be assumed to be exactly at T.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import highspy
import numpy as np
import shapely

from mbn_marl.planning.greedy import clear_roadmap
from mbn_marl.planning.legs import NEVER, Legs, possible_sets, roadmap_legs
from mbn_marl.planning.linear_program import make_solver
from mbn_marl.planning.orders import OutOfTimeError, Search, Visits
from mbn_marl.planning.partition import cheapest_partition, least_makespan
from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.relaxation import Disc, Relaxation, StepWindows, make_region
from mbn_marl.planning.roadmap import Roadmap, make_roadmap

GATE = 6.0
"""Radius of a gate, a disc that touches a corner from the free side, in units."""
USED = 100
"""Cost of using a robot's set again in another partition."""


@dataclass(frozen=True)
class Route:
    """The visits of one robot."""

    order: tuple[int, ...]  # the ROIs
    visits: Visits

    @property
    def sure(self) -> bool:
        """Return whether no disc is inflated; otherwise only rounding may allow the route."""
        return self.visits.inflation <= 0.0


@dataclass
class Team:
    """Searches the least makespan at which every robot's share of the ROIs is possible.

    ``gates`` are discs to pass between two places (starts, then ROIs): the bound is then a guess.
    """

    problem: Problem
    legs: Legs
    slack: float  # allowance of discs and hull for rounding, in units
    horizon: int  # the largest makespan of interest, steps
    deadline: float  # on the problem's clock
    gates: Mapping[tuple[int, int], tuple[Disc, ...]] = field(default_factory=dict)
    bound: int = 0  # a lower bound of the makespan, which rises, steps
    highs: highspy.Highs = field(default_factory=make_solver)
    _routes: dict[tuple[int, int], tuple[int, Route]] = field(default_factory=dict)
    _earliest: dict[tuple[int, tuple[int, ...]], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.sets = possible_sets(self.legs, self.horizon)
        self.place = {mask: k for k, mask in enumerate(self.sets.masks.tolist())}
        hull, area = self.problem.area.convex_hull, self.problem.area
        # what the hull has besides the field, in triangles
        pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(hull.difference(area)))
        self.region = make_region(hull, self.slack)
        self.obstacles = tuple(make_region(piece, -self.slack) for piece in pieces)

    def raise_bound(self) -> bool:
        """Raise the bound until a solution has it; return whether there is one up to the horizon.

        Raises OutOfTimeError at the deadline; ``bound`` is still valid.
        """
        while self.bound <= self.horizon:
            self.bound = max(self.bound, self.least_makespan())
            if self.bound > self.horizon:
                break
            if next(self.solutions(self.bound), None) is not None:
                return True
            self.bound = max(self.bound + 1, self.least_makespan())
        return False

    def least_makespan(self) -> int:
        whole = (1 << self.problem.m) - 1
        return least_makespan(self.sets.masks, self.sets.bounds, whole)

    def solutions(self, makespan: int) -> Iterator[list[Route]]:
        """Yield different solutions with at most ``makespan`` steps, a route for each robot.

        The easiest come first. If there are none, this is proved: the bounds have risen.
        """
        used: Counter[tuple[int, int]] = Counter()
        seen = set()
        while (masks := self._partition(makespan, used)) is not None:
            if tuple(masks) in seen:
                return
            routes = {}
            for i in sorted(range(len(masks)), key=lambda i: -self.least(i, masks[i])):
                routes[i] = self.route(i, masks[i], makespan)
                if routes[i] is None:
                    break
            else:
                seen.add(tuple(masks))
                used.update(enumerate(masks))
                yield [route for _, route in sorted(routes.items()) if route is not None]

    def _partition(self, makespan: int, used: Counter[tuple[int, int]]) -> list[int] | None:
        """Return the easiest partition whose bounds are all within ``makespan``.

        Verified sets cost nothing; sets that were ``used`` before cost more.
        """
        masks = self.sets.masks
        sizes = np.array([mask.bit_count() for mask in masks.tolist()])
        costs = np.where(self.sets.bounds <= makespan, 1 + sizes**2, NEVER)
        for (i, mask), (step, route) in self._routes.items():
            if step <= makespan and route.sure:
                costs[i, self.place[mask]] = 0
        costs[:, 0] = 0
        for (i, mask), times in used.items():
            costs[i, self.place[mask]] += USED * times * (1 + mask.bit_count())
        return cheapest_partition(masks, costs, (1 << self.problem.m) - 1)

    def least(self, i: int, mask: int) -> int:
        return int(self.sets.bounds[i, self.place[mask]])

    def route(self, i: int, mask: int, makespan: int) -> Route | None:
        """Return a route of robot i through the set by ``makespan``; ``None`` raises its bound."""
        nowhere = Route((), Visits((), 0.0, np.zeros((0, 2))))
        step, known = self._routes.get((i, mask), (makespan + 1, nowhere))
        if step == makespan or (step < makespan and known.sure):
            return self._later(i, known, makespan - step)
        if self.least(i, mask) > makespan:
            return None
        found = self._extend(i, (), mask, makespan) if mask else nowhere
        if found is None:
            larger, bounds = (self.sets.masks & mask) == mask, self.sets.bounds
            bounds[i, larger] = np.maximum(bounds[i, larger], makespan + 1)
        else:
            self._routes[i, mask] = makespan, found
        return found

    def _later(self, i: int, route: Route, steps: int) -> Route:
        if not steps or not self.problem.can_wait or not route.order:
            return route
        visits = route.visits
        path = np.concatenate([np.tile(self.problem.starts[i], (steps, 1)), visits.path])
        shifted = tuple(step + steps for step in visits.steps)
        return Route(route.order, replace(visits, steps=shifted, path=path))

    def _extend(self, i: int, order: tuple[int, ...], rest: int, makespan: int) -> Route | None:
        """Search depth first the orders that begin with ``order`` and continue with ``rest``."""
        if self.problem.clock(1) > self.deadline:
            raise OutOfTimeError
        options = []
        for j in range(self.problem.m):
            if rest >> j & 1:
                tail = int(self.sets.tails[rest & ~(1 << j)][j])
                options.append((self._reached(i, (*order, j)) + tail, j, tail))
        for total, j, tail in sorted(options):
            if total > makespan:
                break
            longer, left = (*order, j), rest & ~(1 << j)
            discs, windows, rois = self._stops(i, longer, makespan - tail, ends=left == 0)
            start, drive = self.problem.start(i), self.problem.drives[i]
            relaxation = Relaxation(start, drive, self.region, discs)
            limits = self.highs, self.deadline, self.problem.clock
            search = Search(relaxation, self.obstacles, self.slack, *limits)
            if left == 0:
                if (visits := search.visits(windows)) is not None:
                    steps = tuple(visits.steps[k] for k in rois)
                    return Route(longer, replace(visits, steps=steps))
            elif len(longer) == 1 or search.possible(windows):
                if (route := self._extend(i, longer, left, makespan)) is not None:
                    return route
                continue
            self._earliest[i, longer] = makespan - tail + 1
        return None

    def _reached(self, i: int, order: tuple[int, ...]) -> int:
        if len(order) == 1:
            least = int(self.legs.first[i, order[0]])
        else:
            least = self._reached(i, order[:-1]) + int(self.legs.between[order[-2], order[-1]])
        return max(least, self._earliest.get((i, order), 0))

    def _stops(
        self, i: int, order: tuple[int, ...], last: int, ends: bool
    ) -> tuple[tuple[Disc, ...], StepWindows, list[int]]:
        """Return the stops of an order that is complete by step ``last``: discs and windows.

        The indices of the ROIs among them come third. If the route ``ends`` there and robots can
        wait, it ends at exactly that step.
        """
        n, radius = self.problem.n, self.problem.config.roi_radius
        stops: list[tuple[Disc, int, int]] = []  # with the first step, and the fewest of the leg
        rois: list[int] = []
        reached, place = 0, i
        for k, j in enumerate(order):
            gates = self.gates.get((place, n + j), ())
            leg = int(self.legs.between[order[k - 1], j] if k else self.legs.first[i, j])
            stops += [(gate, reached, 0) for gate in gates]
            reached, place = self._reached(i, order[: k + 1]), n + j
            rois.append(len(stops))
            x, y = self.problem.rois[j].tolist()
            stops.append((Disc((x, y), radius), reached, 0 if gates else leg))
        discs, first, least = zip(*stops, strict=True)
        if ends and self.problem.can_wait:
            first = (*first[:-1], last)
        latest = (last,) * len(stops)
        return discs, StepWindows(first, latest, least, latest), rois


def make_guide(problem: Problem, horizon: int, deadline: float) -> Team:
    """Return a team whose legs and gates follow the shortest paths; its bound is a guess."""
    roadmap = clear_roadmap(problem, problem.starts)
    measured = make_roadmap(roadmap.area, roadmap.places, largest=True)
    legs = roadmap_legs(problem, measured, problem.config.roi_radius, horizon)
    count = len(roadmap.places)
    gates = {
        (a, b): tuple(_gates(roadmap, a, b))
        for a in range(count)
        for b in range(problem.n, count)
        if a != b
    }
    return Team(problem, legs, 0.0, horizon, deadline, gates)


def _gates(roadmap: Roadmap, a: int, b: int) -> list[Disc]:
    path = roadmap.path(a, b)
    gates = []
    for before, corner, after in zip(path[:-2], path[1:-1], path[2:], strict=True):
        x, y = (corner + GATE * _aside(before - corner, after - corner)).tolist()
        gates.append(Disc((x, y), GATE))
    return gates


def _aside(back: Floats, ahead: Floats) -> Floats:
    inner = back / np.hypot(*back) + ahead / np.hypot(*ahead)
    aside: Floats = -inner if np.hypot(*inner) > 1e-9 else np.array([-back[1], back[0]])
    return np.asarray(aside / np.hypot(*aside))
