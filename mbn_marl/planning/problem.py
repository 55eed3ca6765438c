"""A planning instance as plain numbers: the field, the robots, the limits."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from mbn_marl.config import DECOYS, KNOWLEDGE, LIMITS, NavigationConfig
from mbn_marl.engine.mdp.disturbances import OF_ROBOTS
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field

Floats = NDArray[np.float64]
Start = tuple[float, float, float, float]
"""Position and velocity at step 0: x, y, vx, vy; units, units/step."""

CALM = 1e-3
"""Winds that differ by less than this, units/step per step, count as equal."""
FLOAT32 = 2.0**-24
"""Relative error of a rounding to float32."""


@dataclass(frozen=True)
class Drive:
    """The changes of velocity that force and wind allow a robot in a step, per axis (x, y)."""

    rise: tuple[float, float]  # the largest increase, units/step
    fall: tuple[float, float]  # the largest decrease; 0 if the wind is stronger than the force
    top: float  # the speed limit v_clip
    tau: float  # time of a step

    def rates(self, axis: int, sign: float) -> tuple[float, float]:
        """Return the largest increase and decrease of the velocity along ``sign`` of an axis."""
        rise, fall = self.rise[axis], self.fall[axis]
        return (rise, fall) if sign > 0 else (fall, rise)


@dataclass(frozen=True, eq=False)
class Problem:
    """An instance: n robots, m ROIs."""

    field: Field
    config: NavigationConfig  # n_robots filled in
    starts: Floats  # (n, 2), units
    velocities: Floats  # (n, 2), at the starts, units/step
    rois: Floats  # (m, 2), units
    mine: NDArray[np.bool_]  # (n, m), whether a robot may visit an ROI
    tops: Floats  # (n,), the speed limits v_clip
    forces: Floats  # (n, 2), the velocity that a full force adds in a step, units/step
    wind: Floats  # (2,), the velocity that the wind adds in a step, units/step
    area: shapely.Polygon  # where robots may be: the field, or less of it
    others: Floats  # (k, H, 2), the next positions of robots in the way, which stay at the last
    clock: Callable[[int], float] = lambda work: time.monotonic()
    """That of all deadlines, after so much more work: 1 for a linear program."""

    @property
    def n(self) -> int:
        return len(self.starts)

    @property
    def m(self) -> int:
        return len(self.rois)

    @cached_property
    def drives(self) -> tuple[Drive, ...]:
        ahead, back = (np.maximum(self.forces + push, 0.0) for push in (self.wind, -self.wind))
        rates = zip(ahead.tolist(), back.tolist(), self.tops.tolist(), strict=True)
        return tuple(Drive((*rise,), (*fall,), top, self.config.tau) for rise, fall, top in rates)

    @cached_property
    def convex(self) -> bool:
        hull = self.area.convex_hull
        return not self.area.interiors and hull.area - self.area.area <= 1e-9 * hull.area

    @cached_property
    def half_planes(self) -> tuple[Floats, Floats]:
        """The convex hull as ``normals @ p <= offsets``: (k, 2) unit vectors and (k,) units."""
        return half_planes(self.area.convex_hull)

    @cached_property
    def walls(self) -> Floats:
        """The edges of the area, (E, 4): the ends of each, units."""
        rings = [np.array(ring.coords) for ring in (self.area.exterior, *self.area.interiors)]
        return np.concatenate([np.hstack([ring[:-1], ring[1:]]) for ring in rings])

    @cached_property
    def can_wait(self) -> bool:
        """Return whether every robot rests and can go on to: its force balances the wind."""
        return bool(np.all(np.abs(self.wind) <= self.forces) and not self.velocities.any())

    def start(self, i: int) -> Start:
        (x, y), (vx, vy) = self.starts[i].tolist(), self.velocities[i].tolist()
        return x, y, vx, vy

    def in_wind(self, wind: Floats, share: float = 1.0) -> Problem:
        """Return it in a wind (2,), units/step per step, with a share of what both can change."""
        return replace(self, forces=share * self.forces, wind=share * wind)

    def moving(self, velocities: ArrayLike) -> Problem:
        """Return the same instance with these velocities (n, 2) at the starts, units/step."""
        try:
            given = np.asarray(velocities, float)
            if given.shape != (self.n, 2):
                raise ValueError(f"shape {given.shape}")
        except (TypeError, ValueError) as error:
            wrong = f"velocities: {error}; allowed: numbers ({self.n}, 2)"
            raise ConfigError("plan", [wrong]) from None
        problems = [
            f"velocities[{i}]: allowed: -{drive.top:g} to {drive.top:g} along each axis"
            for i, drive in enumerate(self.drives)
            if not np.all(np.abs(given[i]) <= drive.top)
        ]
        if problems:
            raise ConfigError("plan", problems)
        return replace(self, velocities=given)

    def others_for(self, steps: int) -> Floats:
        """Return (k, steps, 2): where the robots in the way are after each step."""
        return self.others[:, np.minimum(np.arange(steps), self.others.shape[1] - 1)]

    def only(self, rois: Sequence[int]) -> Problem:
        return replace(self, rois=self.rois[list(rois)], mine=self.mine[:, list(rois)])

    def slack(self, steps: int) -> float:
        """Return how far rounding can move a robot within ``steps`` steps, in units.

        Each step rounds a velocity, its force and wind, and a position a few times; an error of a
        velocity acts in all later steps. The tests of field and discs add less than ten roundings
        of a position. A bound with this allowance also holds for the engine in float32.
        """
        config = self.config
        velocity = 3.0 * (config.top_speed + float(np.abs(self.wind).max())) * FLOAT32
        position = float(self.field.vertices.max()) * FLOAT32
        return (steps + 10) * position + 0.5 * steps * (steps + 1) * velocity * config.tau + 1e-5


def make_problem(field: Field, config: NavigationConfig, *, closed_loop: bool = False) -> Problem:
    """Return the instance of a field and a configuration; its robots rest.

    It is ``closed_loop`` for a controller that sees where the robots are. They may then fail and
    be disturbed, and nobody knows the wind.

    Raises:
        ConfigError: listing every setting for which no plan can be made.
    """
    n = config.n_robots or len(field.starts)
    problems = []
    # A plan is for one who knows all; how many ROIs are empty is no part of a plan.
    team = {name: NavigationConfig.model_fields[name].default for name in (*KNOWLEDGE, *DECOYS)}
    if closed_loop:  # nobody knows what an episode draws
        middles = {name: (ends.low + ends.high) / 2 for name, ends in config.drawn.items()}
        config = config.with_drawn(middles)
    elif config.drawn:
        drawn = ", ".join(config.drawn)
        problems.append(f"{drawn}: drawn; allowed: numbers, a plan is for those that it knows")
    others = sorted(set(config.of_each("dynamics", n)) - {"point_mass"})
    limits = {name: config.of_each(name, n) for name in LIMITS}
    wrong = {
        f"n_robots: {field.name} has {len(field.starts)} starts, not {n}": n > len(field.starts),
        "random_starts: allowed: False; a plan is for given starts": config.random_starts,
        f"dynamics: {others}; allowed: 'point_mass'; no other bound is known": others,
        **{
            f"{name}: expected {n} numbers, one per robot, got {len(each)}": len(each) != n
            for name, each in limits.items()
        },
    }
    if not closed_loop:
        none = "allowed: none; a plan leaves out those in visited="
        wrong |= {f"{name}: {none}": getattr(config, name) for name in DECOYS}
        noise = {name: getattr(config, name) for name in OF_ROBOTS}
        wrong |= {f"{name}: {one}; allowed: 0, no disturbance": one for name, one in noise.items()}
        wrong["failures: allowed: None"] = config.failures is not None
    problems += [problem for problem, applies in wrong.items() if applies]
    if problems:
        raise ConfigError("plan", problems)
    wind = np.zeros(2) if closed_loop else np.array(config.wind_increment())
    rates = [force / mass for force, mass in zip(limits["f_max"], limits["mass"], strict=True)]
    forces = np.array([[rate] * 2 for rate in rates])
    return Problem(
        field=field,
        config=config.model_copy(update={**team, "n_robots": n}),
        starts=np.array(field.starts[:n]),
        velocities=np.zeros((n, 2)),
        rois=np.array(field.rois),
        mine=field.mine[:n],
        tops=np.array(limits["v_clip"], float),
        forces=forces,
        wind=wind,
        area=field.polygon,
        others=np.zeros((0, 1, 2)),
    )


def half_planes(convex: shapely.Polygon) -> tuple[Floats, Floats]:
    ring = np.array(shapely.geometry.polygon.orient(convex).exterior.coords)
    edges = np.diff(ring, axis=0)
    lengths = np.hypot(edges[:, 0], edges[:, 1])
    ring, edges = ring[:-1][lengths > 0], edges[lengths > 0] / lengths[lengths > 0, None]
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
    return normals, np.einsum("ij,ij->i", normals, ring)


def reach(speed: float, rise: float, top: float, tau: float, steps: int) -> float:
    """Return how far an axis can get within ``steps``: ``tau sum_s min(top, speed + rise s)``.

    That is 0 at least: the start counts as reached.
    """
    ramp = min(steps, math.floor((top - speed) / rise)) if rise > 0.0 else steps
    ahead = speed * ramp + rise * ramp * (ramp + 1) / 2.0 + top * (steps - ramp)
    return max(tau * ahead, 0.0)
