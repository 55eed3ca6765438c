"""Guesses for fields that are not convex: routes that go round the corners by gates."""

from __future__ import annotations

import numpy as np

from mbn_marl.planning.greedy import free_ways
from mbn_marl.planning.legs import way_legs
from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.relaxation import Disc
from mbn_marl.planning.roadmap import Roadmap, make_roadmap
from mbn_marl.planning.team import Team

GATE = 6.0
"""Radius of a gate, in units: a disc that touches the corner from the free side."""


def make_guide(problem: Problem, horizon: int, deadline: float) -> Team:
    """A team whose legs and gates follow the ways round the corners; its bound is a guess."""
    roadmap = free_ways(problem, problem.starts)
    measured = make_roadmap(roadmap.area, roadmap.places, largest=True)
    legs = way_legs(problem, measured, problem.config.roi_radius, horizon)
    count = len(roadmap.places)
    gates = {
        (a, b): tuple(_gates(roadmap, a, b))
        for a in range(count)
        for b in range(problem.n, count)
        if a != b
    }
    return Team(problem, legs, 0.0, horizon, deadline, gates)


def _gates(roadmap: Roadmap, a: int, b: int) -> list[Disc]:
    """A gate at each corner of the way from place a to place b."""
    way = roadmap.way(a, b)
    gates = []
    for before, corner, after in zip(way[:-2], way[1:-1], way[2:], strict=True):
        x, y = (corner + GATE * _aside(before - corner, after - corner)).tolist()
        gates.append(Disc((x, y), GATE))
    return gates


def _aside(back: Floats, on: Floats) -> Floats:
    """The unit vector from a corner into the open: away from the inner side of the bend."""
    inner = back / np.hypot(*back) + on / np.hypot(*on)
    aside: Floats = -inner if np.hypot(*inner) > 1e-9 else np.array([-back[1], back[0]])
    return np.asarray(aside / np.hypot(*aside))
