"""Estimates of the wind, the braking test, and a shield that puts any actions to it.

A robot takes an action only if it could then brake to rest inside the field and apart from the
others, if they brake too. Every step shows what the wind does.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.engine.snapshot import FloatArray
from mbn_marl.planning.problem import CALM, Floats, Problem

Flags = NDArray[np.bool_]

FORESEEN = 60
"""Steps in which a robot that never rests is foreseen."""
TINY = 1e-200
"""Below any change of velocity; units/step per step."""
DISTURBED = 0.1
"""Pushes on robots that differ by more than this, units/step per step, are not the wind's."""
GUST_MEMORY = 10
"""Steps without wind that the mean of pushes in gusts begins with."""
GUST_SHARE = 0.6
"""Share of the force to count on in gusts; the rest is for holding out against them."""
TURNS = (60.0, -60.0, 120.0, -120.0)
"""Directions to try in turn, in degrees from the wanted one."""
ESCAPES = np.array([(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0) if x or y])
"""Directions in which a robot leaves the way of one that has failed and does not stop."""
MARGIN = 1e-3
"""The shield's distance from walls, units: more than float32 rounds a position by."""


@dataclass(frozen=True, eq=False)
class Weather:
    """The pushes on the team so far, estimated from its changes of velocity."""

    push: Floats  # (2,), in the last step, units/step per step
    gusty: bool = False  # whether it has changed
    seen: Flags = field(default_factory=lambda: np.zeros(2, bool))  # (2,), axes that have shown it
    count: int = 0
    total: Floats = field(default_factory=lambda: np.zeros(2))  # (2,), the sum of all pushes

    def after(
        self, problem: Problem, before: Floats, actions: Floats, now: Floats, works: Flags
    ) -> Weather:
        """Return the weather after a step with ``actions`` from velocities ``before`` to ``now``.

        All are (n, 2); ``works`` (n,) leaves out robots that have failed. Robots at rest or at the
        speed limit show nothing: a wall may have stopped them.
        """
        tops = np.array([[drive.top] for drive in problem.drives])
        # A limit may be less in float32 than in float64.
        slower = np.abs(now) < tops * (1.0 - 1e-6)
        shown = works[:, None] & slower & now.any(axis=1, keepdims=True)
        found = now - before - actions * problem.forces
        push, seen = self.push.copy(), self.seen.copy()
        for axis in (0, 1):
            pushes = found[shown[:, axis], axis]
            if len(pushes) and np.ptp(pushes) < DISTURBED:
                push[axis], seen[axis] = np.median(pushes), True
        changed = np.abs(push - self.push) >= CALM
        push = np.where(changed, push, self.push)
        gusty = self.gusty or bool((changed & self.seen).any())
        return Weather(push, gusty, seen, self.count + 1, self.total + push)

    def problem(self, problem: Problem, share: float = GUST_SHARE) -> Problem:
        """Return the instance to plan for: in gusts with their mean, and a share of the force."""
        if not self.gusty:
            return problem.in_wind(self.push)
        mean = self.total / (self.count + GUST_MEMORY)
        return problem.in_wind(mean, share)


def ways_of_failed(
    problem: Problem, places: Floats, speeds: Floats, works: Flags, push: Floats
) -> dict[int, Floats]:
    """Return by robot (k, 2) where those that have failed, but not vanished, will be, units.

    The positions go on until all of them rest; there are FORESEEN of robots that coast. ``push``
    is the wind's, units/step per step.
    """
    kind = problem.config.failures.kind if problem.config.failures else "brake"
    failed = ~works & (kind != "vanish")
    steps = FORESEEN
    if kind == "brake":
        steps = steps_to_rest(speeds[failed], problem.forces[failed], problem.config.max_steps)
    numbers = np.flatnonzero(failed).tolist()
    return {i: _way(problem, i, kind, places[i], speeds[i], push, steps) for i in numbers}


def steps_to_rest(velocities: Floats, slower: Floats, most: int) -> int:
    """Return steps after which all velocities, which fall by ``slower`` a step, are 0."""
    needed = np.abs(velocities) / np.maximum(slower, TINY)
    return math.floor(min(float(needed.max(initial=0.0)), most)) + 2


def _way(
    problem: Problem, i: int, kind: str, place: Floats, speed: Floats, push: Floats, steps: int
) -> Floats:
    force, top = problem.forces[i], problem.drives[i].top
    way = np.empty((steps, 2))
    for k in range(steps):
        braked = speed - np.clip(speed, -force, force)
        speed = np.clip(speed + push, -top, top) if kind == "coast" else braked
        ahead = place + speed * problem.config.tau
        if shapely.intersects_xy(problem.area, *ahead):
            place = ahead
        else:
            speed = np.zeros(2)
        way[k] = place
    return way


class Cautious:
    """Base of controllers whose robots can always brake, for one team and episode.

    ``weather`` is what the team knows of the wind; by default the instance's.
    """

    def __init__(self, problem: Problem, weather: Weather | None = None) -> None:
        self.instance = self.problem = problem
        self.weather = weather or Weather(problem.wind)
        self.before: tuple[Floats, Floats] | None = None  # velocities and actions of the last step
        shapely.prepare(problem.area)

    def _look(
        self, positions: FloatArray, velocities: FloatArray, failed: Flags | None
    ) -> tuple[Floats, Floats, Flags, dict[int, Floats]]:
        """Learn from the last step about the wind; return the state, and who works (n,).

        The third are paths (k, 2) of all robots that have not vanished; those that can, brake.
        """
        places, speeds = np.asarray(positions, float), np.asarray(velocities, float)
        works = np.ones(self.problem.n, bool) if failed is None else ~failed
        if self.before is not None:
            self.weather = self.weather.after(self.instance, *self.before, speeds, works)
            self.problem = self.weather.problem(self.instance)
        ways = ways_of_failed(self.instance, places, speeds, works, self.weather.push)
        for i in np.flatnonzero(works).tolist():
            ways[i] = self._coast(i, places[i], speeds[i])
        return places, speeds, works, ways

    def _toward(self, i: int, speed: Floats, wishes: Iterable[Floats]) -> Iterator[Floats]:
        """Yield the possible changes of robot i's velocity that are nearest to the wishes."""
        force, wind = self.problem.forces[i], self.problem.wind
        return (np.clip(wanted - speed, wind - force, wind + force) for wanted in wishes)

    def _action(self, i: int, change: Floats) -> Floats:
        """Return robot i's action (2,) for a change of its velocity in the present wind."""
        force: Floats = (change - self.weather.push) / self.instance.forces[i]
        return np.clip(force, -1.0, 1.0)

    def _coast(self, i: int, position: Floats, velocity: Floats) -> Floats:
        """Return (k, 2): robot i's positions while it brakes, to rest or the episode's end.

        A robot that the wind pushes on with more than its force has ``FORESEEN`` positions.
        """
        top, config = self.problem.drives[i].top, self.problem.config
        force, wind = self.problem.forces[i], self.problem.wind
        place, speed = position.tolist(), velocity.tolist()
        limits = list(zip((wind - force).tolist(), (wind + force).tolist(), strict=True))
        slower = force - np.abs(wind)  # by as much at least in each step
        pushed = (slower < 0.0).any()
        path = []
        for _ in range(FORESEEN if pushed else steps_to_rest(velocity, slower, config.max_steps)):
            for axis, (least, most) in enumerate(limits):
                change = min(max(-speed[axis], least), most)
                speed[axis] = min(max(speed[axis] + change, -top), top)
                place[axis] += speed[axis] * config.tau
            path.append(tuple(place))
            if not (pushed or any(speed)):
                break
        return np.array(path)

    def _choose(
        self,
        i: int,
        place: Floats,
        speed: Floats,
        changes: Iterable[Floats],
        plans: Mapping[int, Floats],
    ) -> tuple[Floats, Floats]:
        """Return the change of robot i's velocity, and its way if it brakes after that.

        It is the first of the ``changes`` after which it can brake clear of walls and of the
        others' ``plans``; if a failed robot leaves none, the one that keeps the farthest away.
        """
        top = self.problem.drives[i].top
        others = [plan for j, plan in plans.items() if j != i]
        escapes = self._toward(i, speed, (np.zeros(2), *(0.5 * top * ESCAPES)))
        stop = next(self._toward(i, speed, [np.zeros(2)]))
        best, widest = (stop, self._coast(i, place, speed)), -1.0
        for change in chain(changes, escapes):
            velocity = np.clip(speed + change, -top, top)
            position = place + velocity * self.problem.config.tau
            path = np.concatenate([position[None], self._coast(i, position, velocity)])
            room = self._room(path, others)
            if room > widest:
                best, widest = (change, path), room
            if room >= self.problem.config.safety_distance * 1.01:
                break
        return best

    def _room(self, path: Floats, others: list[Floats]) -> float:
        """Return how close a path comes to the other paths, in units; -1 if it leaves the field."""
        if not np.all(shapely.intersects_xy(self.problem.area, path[:, 0], path[:, 1])):
            return -1.0
        room = np.inf
        for other in others:
            steps = np.arange(max(len(path), len(other)))
            mine = path[np.minimum(steps, len(path) - 1)]
            apart = mine - other[np.minimum(steps, len(other) - 1)]
            room = min(room, float(np.min(np.hypot(apart[:, 0], apart[:, 1]))))
        return room


class Shield(Cautious):
    """Replaces actions after which a robot of one team could no longer brake in time.

    Robots keep within the field and apart as long as forces can stop them and the wind does not
    change. The ``starts`` of the problem do not matter.
    """

    def __init__(self, problem: Problem) -> None:
        inner = problem.area.buffer(-MARGIN, join_style="mitre")
        super().__init__(replace(problem, area=inner))

    def act(
        self,
        actions: FloatArray,
        positions: FloatArray,
        velocities: FloatArray,
        failed: Flags | None = None,
    ) -> FloatArray:
        """Return the actions (n, 2) to take; those that pass the test are as they were.

        In place of one that does not, a robot goes more slowly, turns, brakes or escapes. Robots
        decide in index order: the others' ways are what they have decided, or to brake.

        ``actions`` are finite; values outside [-1, 1] count as clipped. The rest as for
        :meth:`Greedy.act`.
        """
        places, speeds, works, plans = self._look(positions, velocities, failed)
        taken = np.array(actions)
        for i in np.flatnonzero(works).tolist():
            force = np.clip(actions[i], -1.0, 1.0) * self.instance.forces[i]
            own = force + self.weather.push
            others = self._toward(i, speeds[i], around(speeds[i] + own))
            change, plans[i] = self._choose(i, places[i], speeds[i], chain([own], others), plans)
            if change is not own:
                taken[i] = self._action(i, change)
        self.before = speeds, np.clip(taken, -1.0, 1.0).astype(float)
        return taken


def around(wanted: Floats) -> list[Floats]:
    """Return a velocity (2,), units/step, and slower and turned ones to try in its place."""
    x, y = wanted
    turns = [(math.cos(math.radians(angle)), math.sin(math.radians(angle))) for angle in TURNS]
    turned = [0.5 * np.array([c * x - s * y, s * x + c * y]) for c, s in turns]
    return [wanted, 0.5 * wanted, 0.25 * wanted, *turned]
