"""Guesses for fields that are not convex: routes that pass gates at the corners."""

from __future__ import annotations

import numpy as np

from mbn_marl.planning.greedy import clear_roadmap
from mbn_marl.planning.legs import roadmap_legs
from mbn_marl.planning.problem import Floats, Problem
from mbn_marl.planning.relaxation import Disc
from mbn_marl.planning.roadmap import Roadmap, make_roadmap
from mbn_marl.planning.team import Team

GATE = 6.0
"""Radius of a gate, a disc that touches a corner from the free side, in units."""


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
    """Return a gate at each corner of the shortest path from place a to place b."""
    path = roadmap.path(a, b)
    gates = []
    for before, corner, after in zip(path[:-2], path[1:-1], path[2:], strict=True):
        x, y = (corner + GATE * _aside(before - corner, after - corner)).tolist()
        gates.append(Disc((x, y), GATE))
    return gates


def _aside(back: Floats, ahead: Floats) -> Floats:
    """Return the unit vector from a corner away from the inner side of the bend."""
    inner = back / np.hypot(*back) + ahead / np.hypot(*ahead)
    aside: Floats = -inner if np.hypot(*inner) > 1e-9 else np.array([-back[1], back[0]])
    return np.asarray(aside / np.hypot(*aside))
