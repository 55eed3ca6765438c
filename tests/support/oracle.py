"""The MDP a second time: slow, one world at a time, robot by robot.

It shares nothing with the package, so that a mistake would have to be made twice to go unseen.
Geometry is asked of shapely (the engine has its own), distances of ``math.hypot`` (the engine
compares squares). :attr:`Step.margin` tells how close the step came to a tie; a test that compares
two implementations stops where the margin is mere rounding.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import shapely
from numpy.typing import NDArray

from tests.support.disturbances import Disturbances
from tests.support.vehicles import REALS, Robot, Vehicle, clip
from tests.support.wall_senses import WallSenses

TERMS = ("step", "revisit", "wall", "roi", "success", "collision")


class FieldLike(Protocol):
    """The part of a field that the oracle needs: coordinates in arena units."""

    vertices: Any
    rois: Any
    starts: Any
    holes: Any
    arena: tuple[float, float]


@dataclass(frozen=True)
class Profile:
    """The weights r_s, r_m, r_l, r_inf of a reward profile and the rules that use them."""

    rules: str
    small: float = 10.0
    medium: float = 100.0
    large: float = 10_000.0
    infinite: float = 100_000.0


@dataclass
class Step:
    """The events of one step.

    Attributes:
        wall, revisit: one flag a robot. reached: ROIs that each robot visited first.
        all_visited, collided: of the world. met_before: the joint state had been met before.
        margin: least distance, in units, of any decision of the step from its threshold.
        terms: one dict a robot, its individual reward by term.
        team_reward: the centralised reward. rewards: one a robot, after reward sharing.
        terminated, truncated: the ends of an episode.
    """

    wall: list[bool] = field(default_factory=list)
    revisit: list[bool] = field(default_factory=list)
    reached: list[int] = field(default_factory=list)
    all_visited: bool = False
    collided: bool = False
    met_before: bool = False
    margin: float = math.inf
    terms: list[dict[str, float]] = field(default_factory=list)
    team_reward: float = 0.0
    rewards: list[float] = field(default_factory=list)
    terminated: bool = False
    truncated: bool = False


class Oracle:
    """One world of the multi-robot navigation MDP.

    The settings have the names, units and defaults of the engine's. ``reward`` is ``"released"``,
    ``"formal"`` or any object with the attributes of :class:`Profile`; ``dynamics``, ``mass``,
    ``f_max`` and ``v_clip`` are one value or one per robot.
    """

    def __init__(
        self,
        field: FieldLike,
        *,
        n_robots: int | None = None,
        reward: Any = "released",
        reward_sharing: str = "individual",
        wind: tuple[float, float] = (0.0, 0.0),
        max_steps: int = 1000,
        dtype: str = "float64",
        dynamics: str | Sequence[str] = "point_mass",
        f_max: float | Sequence[float] = 0.5,
        v_clip: float | Sequence[float] = 5.0,
        tau: float = 1.0,
        mass: float | Sequence[float] = 1.0,
        turn_max: float = 0.3,
        wheelbase: float = 4.0,
        steer_max: float = 0.5,
        safety_distance: float = 10.0,
        roi_radius: float = 10.0,
        observation: str = "relative",
        one_hot: bool = False,
        sensing_radius: float = 100.0,
        seed: int = 0,
        world: int = 0,
        **disturbances: Any,
    ) -> None:
        real = self.real = REALS[dtype]
        self.n = len(field.starts) if n_robots is None else n_robots
        self.starts = [(float(x), float(y)) for x, y in field.starts]
        self.rois = [(real(x), real(y)) for x, y in field.rois]
        self.width, self.height = (real(side) for side in field.arena)
        self.polygon = shapely.Polygon(field.vertices, field.holes)
        self.boundary = self.polygon.boundary
        shapely.prepare(self.polygon)
        shapely.prepare(self.boundary)
        self.profile = Profile(rules=reward) if isinstance(reward, str) else reward
        self.team_sharing = reward_sharing == "team"
        speed, angle = wind
        wind_x = real(speed * math.cos(math.radians(angle)))
        wind_y = real(speed * math.sin(math.radians(angle)))
        self.tau = real(tau)
        common = (self.tau, wind_x, wind_y, real(turn_max), real(wheelbase), real(steer_max))
        own = (self._each(values) for values in (dynamics, mass, f_max, v_clip))
        self.vehicles = [
            Vehicle(name, real, *map(real, numbers), *common)
            for name, *numbers in zip(*own, strict=True)
        ]
        self.top_speed = max(vehicle.v_clip for vehicle in self.vehicles)
        zero, top = real(0.0), self.top_speed
        self.bounds = [(zero, self.width), (zero, self.height), (-top, top), (-top, top)]
        self.turning = any(vehicle.turns for vehicle in self.vehicles)
        self.safety_distance, self.roi_radius = safety_distance, roi_radius
        self.max_steps = max_steps
        self.observation, self.one_hot = observation, one_hot
        self.sensing_radius = sensing_radius
        self.disturbances = Disturbances(real, seed, world, **disturbances)
        self.reset(episode=0)

    def reset(
        self, positions: Sequence[Sequence[float]] | None = None, episode: int | None = None
    ) -> None:
        """Start the next episode, or number ``episode``, at the field's starts or ``positions``."""
        last = self.disturbances
        last.begin(last.episode + 1 if episode is None else episode)
        zero = self.real(0.0)
        spots = self.starts[: self.n] if positions is None else positions
        self.robots = [
            Robot(vehicle, self.real(x), self.real(y), zero, zero, zero)
            for vehicle, (x, y) in zip(self.vehicles, spots, strict=True)
        ]
        self.visited = [False] * len(self.rois)
        self.stood_on: set[tuple[float, float]] = set()
        self.joint_states = {self.state()}
        self.steps = 0
        self.episode_return = 0.0
        self.success = self.collision = False

    @property
    def visit_code(self) -> int:
        """The visit bits as a number; the first ROI is the most significant bit."""
        return int("".join("1" if seen else "0" for seen in self.visited), 2)

    def state(self) -> tuple[float, ...]:
        """The paper's vector (4n+1,), or with headings before the visit code (5n+1,)."""
        positions = [value for robot in self.robots for value in (robot.x, robot.y)]
        velocities = [value for robot in self.robots for value in (robot.vx, robot.vy)]
        headings = [robot.heading for robot in self.robots] if self.turning else []
        return (*positions, *velocities, *headings, float(self.visit_code))

    def step(self, actions: Sequence[Sequence[float]]) -> Step:
        """Move every robot by ``actions`` (n, 2), numbers that are clipped to [-1, 1]."""
        step = Step()
        taken = self.disturbances.arrived(actions)
        for robot, action in zip(self.robots, taken, strict=True):
            step.wall.append(self._move(robot, action, step))
            spot = (robot.x, robot.y)
            step.revisit.append(spot in self.stood_on)
            self.stood_on.add(spot)
            step.reached.append(self._visit(robot, step))
        self.disturbances.end_step()
        step.all_visited = all(self.visited)
        step.collided = self._any_collision(step)
        state = self.state()
        step.met_before = state in self.joint_states
        self.joint_states.add(state)
        self.steps += 1
        self._end(step)
        self._reward(step)
        return step

    def observe(
        self, i: int, missing: int = 0, shift: tuple[float, float] = (0.0, 0.0)
    ) -> NDArray[np.float32]:
        """The observation of robot i, (size,), or that from a place elsewhere by ``shift``.

        ``missing`` is by how many ROIs the field has fewer than another of a batch: they are seen
        as visited, and where the first one is.
        """
        here = self.robots[i]
        there = replace(here, x=here.x + self.real(shift[0]), y=here.y + self.real(shift[1]))
        me, *others = self._seen_robots(i, there)
        rois = [*zip(self.rois, self.visited, strict=True), *[(self.rois[0], True)] * missing]
        if self.observation == "state":
            seen = [body.seen * body.position for body in (me, *others)]
            seen += [body.seen * body.velocity for body in (me, *others)]
            seen += [body.seen * body.ahead for body in (me, *others)] * self.turning
            seen.append(np.array([self.visit_code]))
        else:
            half = np.array([self.width, self.height]) / 2
            low_x, low_y, high_x, high_y = self.polygon.bounds
            middle = np.array([low_x + high_x, low_y + high_y]) / 2
            lidar = self.observation in ("lidar", "lidar_local")
            reach = min(self.sensing_radius, math.hypot(self.width, self.height))
            centre = middle if lidar else half
            seen = [(me.position - centre) / half, me.velocity / self.top_speed]
            seen += [me.ahead] * self.turning
            for other in others:
                turn = (other.velocity - me.velocity) / (2 * self.top_speed)
                ahead = [other.ahead] * self.turning
                sight = self._sight(other.position - me.position, turn, *ahead)
                if lidar:
                    distance = math.dist(other.position, me.position)
                    sight.append(np.array([max(0.0, 1.0 - distance / reach)]))
                seen += [other.seen * entries for entries in sight]
            for j, (roi, visited) in enumerate(rois):
                place, is_seen = self.disturbances.seen(i, 64 + j, roi, self.bounds)
                offset = np.array(place) - me.position
                direction = [offset / (math.hypot(*offset) + 1.0)] if lidar else []
                seen += [is_seen * entries for entries in self._sight(offset, *direction)]
                seen.append(np.array([visited]))
            if lidar:
                seen.append(self._walls(there, reach))
        if self.one_hot:
            seen.append(np.eye(self.n)[i])
        return np.concatenate(seen).astype(np.float32)

    def _seen_robots(self, i: int, me: Robot) -> list[Robot]:
        """The robots as robot i, which is at ``me``, sees them; itself first."""
        bodies = {i: me, **{j: body for j, body in enumerate(self.robots) if j != i}}
        if not self.disturbances.blurs:
            return [*bodies.values()]
        found = []
        for j, body in bodies.items():
            motion = (body.x, body.y, body.vx, body.vy)
            (x, y, vx, vy), seen = self.disturbances.seen(i, j, motion, self.bounds)
            found.append(replace(body, x=x, y=y, vx=vx, vy=vy, seen=seen))
        return found

    def _sight(self, offset: NDArray[Any], *more: NDArray[Any]) -> list[NDArray[Any]]:
        """Something at an offset, in arenas; blank if too far, which ``local`` flags."""
        entries = [offset / np.array([self.width, self.height]), *more]
        if self.observation not in ("local", "lidar_local"):
            return entries
        near = math.hypot(*offset) <= self.sensing_radius
        flag = [np.array([near])] if self.observation == "local" else []
        return [*flag, *(near * entry for entry in entries)]

    def _walls(self, me: Robot, reach: float) -> list[float]:
        """The entries of ``lidar`` about the walls."""
        senses = WallSenses(self.polygon, float(self.top_speed), reach)
        rest = me.vehicle.place_of_rest(me.position, me.velocity, me.heading)
        return senses.entries(me.position.astype(float), me.velocity.astype(float), rest)

    def _each(self, value: Any) -> list[Any]:
        """A setting's value for each robot."""
        return [value] * self.n if isinstance(value, str | int | float) else list(value)

    def metrics(self) -> dict[str, Any]:
        """Sums over the episode so far, under the engine's names."""
        return {
            "success": self.success,
            "collision": self.collision,
            "rois_visited": sum(self.visited),
            "steps": self.steps,
            "episode_return": self.episode_return,
            "wall_hits": [robot.wall_hits for robot in self.robots],
            "path_length": [robot.path_length for robot in self.robots],
            "impulse": [robot.impulse for robot in self.robots],
            "return_": [robot.return_ for robot in self.robots],
        }

    def _move(self, robot: Robot, action: Sequence[float], step: Step) -> bool:
        """Rules 1 to 3. Returns whether the robot tried to leave the field."""
        real, before = self.real, robot.heading
        velocity, robot.heading, (force_x, force_y) = robot.vehicle.move(
            (robot.vx, robot.vy), before, action, self.disturbances.gust
        )
        robot.vx, robot.vy = velocity
        x = robot.x + robot.vx * self.tau
        y = robot.y + robot.vy * self.tau
        step.margin = min(step.margin, self.boundary.distance(shapely.Point(x, y)))
        outside = not shapely.intersects_xy(self.polygon, x, y)
        if outside:
            robot.vx = robot.vy = real(0.0)
            robot.heading = before
            robot.wall_hits += 1
            x, y = robot.x, robot.y
        x, y = clip(x, real(0.0), self.width), clip(y, real(0.0), self.height)
        robot.path_length += math.hypot(x - robot.x, y - robot.y)
        robot.impulse_x += float(force_x * self.tau)
        robot.impulse_y += float(force_y * self.tau)
        robot.x, robot.y = x, y
        return outside

    def _visit(self, robot: Robot, step: Step) -> int:
        """Rule 5. Returns how many ROIs the robot is the first to reach."""
        count = 0
        for index, (x, y) in enumerate(self.rois):
            if not self.visited[index]:
                distance = math.hypot(robot.x - x, robot.y - y)
                step.margin = min(step.margin, abs(distance - self.roi_radius))
                if distance <= self.roi_radius:
                    self.visited[index] = True
                    count += 1
        return count

    def _any_collision(self, step: Step) -> bool:
        """The predicate of rule 7: some pair is closer than the safety distance."""
        found = False
        for i, one in enumerate(self.robots):
            for other in self.robots[:i]:
                distance = math.hypot(one.x - other.x, one.y - other.y)
                step.margin = min(step.margin, abs(distance - self.safety_distance))
                found = found or distance < self.safety_distance
        return found

    def _end(self, step: Step) -> None:
        """Rules 6 to 8: a collision wins over success, both over the time limit."""
        self.collision = step.collided
        self.success = step.all_visited and not step.collided
        step.terminated = step.all_visited or step.collided
        step.truncated = self.steps >= self.max_steps and not step.terminated

    def _reward(self, step: Step) -> None:
        rule = {"released": released_reward, "formal": formal_reward}[self.profile.rules]
        step.team_reward, step.terms = rule(step, self.profile)
        shares = [math.fsum(terms.values()) for terms in step.terms]
        step.rewards = [step.team_reward] * self.n if self.team_sharing else shares
        self.episode_return += step.team_reward
        for robot, reward in zip(self.robots, step.rewards, strict=True):
            robot.return_ += reward


def released_reward(step: Step, profile: Profile) -> tuple[float, list[dict[str, float]]]:
    """The released code's reward: the team's, and each robot's share by term."""
    n = len(step.wall)
    if step.collided:
        return -profile.infinite, [by_term(collision=-profile.infinite / n) for _ in range(n)]
    team = profile.infinite if step.all_visited else 0.0
    shares = []
    for wall, revisit, reached in zip(step.wall, step.revisit, step.reached, strict=True):
        own = by_term(
            step=0.0 if revisit else -profile.small,
            revisit=-profile.medium if revisit else 0.0,
            wall=-profile.large if wall else 0.0,
            roi=profile.large * reached,
        )
        team += sum(own.values())
        own["success"] = profile.infinite / n if step.all_visited else 0.0
        shares.append(own)
    return team, shares


def formal_reward(step: Step, profile: Profile) -> tuple[float, list[dict[str, float]]]:
    """The paper's section 3, R = R_C + R_I + R_F + R_V: the team's, and each robot's share."""
    n = len(step.wall)
    r_c = -profile.infinite if step.collided else 0.0
    r_i = profile.infinite if step.all_visited else profile.large * sum(step.reached)
    r_f = -profile.large * sum(step.wall) if any(step.wall) else -profile.small
    r_v = -profile.medium if step.met_before else profile.small
    shares = []
    for wall, reached in zip(step.wall, step.reached, strict=True):
        own = by_term(
            wall=-profile.large if wall else 0.0,
            roi=0.0 if step.all_visited else profile.large * reached,
            success=profile.infinite / n if step.all_visited else 0.0,
            collision=r_c / n,
        )
        if not any(step.wall):
            own["step"] -= profile.small / n
        if step.met_before:
            own["revisit"] -= profile.medium / n
        else:
            own["step"] += profile.small / n
        shares.append(own)
    return r_c + r_i + r_f + r_v, shares


def by_term(**values: float) -> dict[str, float]:
    """A reward by term; the terms that are not given are zero."""
    return {name: values.get(name, 0.0) for name in TERMS}
