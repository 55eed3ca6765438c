"""A second, slow implementation of the MDP: one world, robot by robot."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.config import KNOWLEDGE
from tests.support.disturbances import FAILURES, Disturbances, key_of, uniform
from tests.support.draws import NUMBERS, drawn_settings, highest, is_range
from tests.support.knowledge import Knowledge, drawn_decoys
from tests.support.scores import Profile, Step, formal_reward, released_reward
from tests.support.tokens import Atlas, Plan, entities
from tests.support.vehicles import REALS, Robot, Vehicle, clip

SLACK = 1e-3  # a robot this near a wall, in units, may be behind it by rounding
RESIDUE = 1e-9  # rounding leaves a slower speed, in units/step, of a robot that has braked


class Oracle:
    """One world of the MDP; settings have the names, units and defaults of the engine's."""

    def __init__(self, field: Any, *, seed: int = 0, world: int = 0, **settings: Any) -> None:
        self.field, self.place, self.settings = field, (seed, world), settings
        self.episode = -1
        self.reset()

    def _configure(
        self,
        field: Any,
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
        assignment: bool | str = False,
        one_hot: bool = False,
        sensing_radius: float = 100.0,
        failures: Any = None,
        failure_rate: float = 0.0,
        fails: dict[int, int] | None = None,
        wind_vector: tuple[float, float] | None = None,
        knowledge: str = "team",
        decoys: int | tuple[int, int] = 0,
        empty_rois: tuple[int, ...] = (),
        **more: Any,
    ) -> None:
        real = self.real = REALS[dtype]
        self.n = len(field.starts) if n_robots is None else n_robots
        self.rois = [(real(x), real(y)) for x, y in field.rois]
        self.width, self.height = (real(side) for side in field.arena)
        self.polygon = shapely.Polygon(field.vertices, field.holes)
        self.boundary = self.polygon.boundary
        shapely.prepare(self.polygon)
        shapely.prepare(self.boundary)
        self.profile = Profile(rules=reward) if isinstance(reward, str) else reward
        self.team_sharing = reward_sharing == "team"
        speed, angle = wind
        east, north = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        wind_x, wind_y = map(real, wind_vector or (speed * east, speed * north))
        self.tau = real(tau)
        common = (self.tau, wind_x, wind_y, real(turn_max), real(wheelbase), real(steer_max))
        own = (self._each(values) for values in (dynamics, mass, f_max, v_clip))
        self.vehicles = [
            Vehicle(name, real, *map(real, numbers), *common)
            for name, *numbers in zip(*own, strict=True)
        ]
        self.top_speed = real(max(highest(self._each(self.settings.get("v_clip", 5.0)))))
        zero, top = real(0.0), self.top_speed
        self.bounds = [(zero, self.width), (zero, self.height), (-top, top), (-top, top)]
        self.turning = any(vehicle.turns for vehicle in self.vehicles)
        self.safety_distance, self.roi_radius = safety_distance, roi_radius
        self.max_steps = max_steps
        self.observation, self.assignment, self.one_hot = observation, assignment, one_hot
        self.atlas = Atlas(self.polygon, self.rois) if assignment else None
        self.token = 9 + 2 * bool(assignment)
        self.sensing_radius = sensing_radius
        self.failures, self.failure_rate, self.fails = failures, failure_rate, fails or {}
        telling = {name: more.pop(name) for name in KNOWLEDGE[1:] if name in more}
        self.knowledge = Knowledge(self, **telling) if knowledge == "own" else None
        drawn = drawn_decoys(decoys, len(self.rois), *self.place, self.episode)
        self.empty = drawn | {*empty_rois}
        self.disturbances = Disturbances(real, *self.place, **more)

    def reset(self, episode: int | None = None) -> None:
        self.episode = self.episode + 1 if episode is None else episode
        key = key_of(*self.place, self.episode, NUMBERS)
        self._configure(self.field, **drawn_settings(self.settings, len(self.field.starts), key))
        self.disturbances.begin(self.episode)
        zero = self.real(0.0)
        self.robots = [
            Robot(vehicle, self.real(x), self.real(y), zero, zero, zero)
            for vehicle, (x, y) in zip(self.vehicles, self.field.starts, strict=False)
        ]
        self.visited = [j in self.empty for j in range(len(self.rois))]
        self.stood_on: set[tuple[float, float]] = set()
        self.joint_states = {self._joint_state()}
        self.steps = 0
        self.episode_return = 0.0
        self.success = self.collision = False
        fresh = self.assignment == "fresh"
        self.plan = Plan(self.atlas, len(self.robots), fresh=fresh) if self.atlas else None
        self._assign()
        if self.knowledge:
            self.knowledge.begin()

    @property
    def visit_code(self) -> int:
        """The visit bits as a number; the first ROI is the most significant bit."""
        bits = (seen and j not in self.empty for j, seen in enumerate(self.visited))
        return int("".join("1" if bit else "0" for bit in bits), 2)

    def is_done(self, i: int, j: int) -> bool:
        """Return whether robot i knows that ROI j is visited or empty."""
        return ("done", j) in self.knowledge.words[i] if self.knowledge else self.visited[j]

    def is_mine(self, i: int, j: int) -> bool:
        kind = self.field.roi_kinds[j] if self.field.roi_kinds else None
        return kind is None or kind == self.field.start_kinds[i]

    def mine(self, i: int, j: int) -> list[bool]:
        """The entries that say whether ROI j is for robot i."""
        there = j < len(self.rois)
        return [there and self.is_mine(i, j)] if self.field.roi_kinds else []

    def is_left(self, i: int, j: int) -> bool:
        found = not self.knowledge or ("found", j) in self.knowledge.words[i]
        return found and not self.is_done(i, j)

    def notices(self, me: Robot, other: Robot) -> bool:
        radius = self.knowledge.notice if self.knowledge else math.inf
        return math.dist(me.position, other.position) <= radius

    def state(self) -> tuple[float, ...]:
        """The paper's vector (4n+1,); headings and failures come before the visit code."""
        *motion, code = self._joint_state()
        failed = [float(robot.failed) for robot in self.robots] if self.failures else []
        return (*motion, *failed, code)

    def _joint_state(self) -> tuple[float, ...]:
        positions = [value for robot in self.robots for value in (robot.x, robot.y)]
        velocities = [value for robot in self.robots for value in (robot.vx, robot.vy)]
        headings = [robot.heading for robot in self.robots] if self.turning else []
        return (*positions, *velocities, *headings, float(self.visit_code))

    def step(self, actions: Sequence[Sequence[float]]) -> Step:
        step = Step()
        self._fail()
        taken = self.disturbances.arrived(actions)
        for i, (robot, action) in enumerate(zip(self.robots, taken, strict=True)):
            step.works.append(not robot.failed)
            step.wall.append(self._move(robot, action, step) and not robot.failed)
            spot = (robot.x, robot.y)
            step.revisit.append(spot in self.stood_on)
            self.stood_on.add(spot)
            step.reached.append(self._visit(i, robot, step))
        self.disturbances.end_step()
        step.all_visited = all(self.visited)
        step.collided = self._any_collision(step)
        state = self._joint_state()
        step.met_before = state in self.joint_states
        self.joint_states.add(state)
        self.steps += 1
        if self.knowledge:
            step.margin = min(step.margin, self.knowledge.learn())
        self._end(step)
        self._reward(step)
        self._assign()
        return step

    def _assign(self) -> None:
        if self.plan:
            works = [not robot.failed for robot in self.robots]
            left = [j for j, visited in enumerate(self.visited) if not visited]
            spots = [(robot.x, robot.y) for robot in self.robots]
            top = float(self.top_speed)
            speeds = [complex(robot.vx, robot.vy) / top for robot in self.robots]
            rois = range(len(self.rois))
            mine = [{j for j in rois if self.is_mine(i, j)} for i in range(self.n)]
            self.plan.update(spots, works, left, speeds, mine)

    def observe(
        self, i: int, missing: int = 0, shift: tuple[float, float] = (0.0, 0.0)
    ) -> NDArray[np.float32]:
        """The observation of robot i, (size,), perhaps from elsewhere by ``shift``.

        ROIs that the field is ``missing`` are seen as visited, and where the first one is.
        """
        here = self.robots[i]
        there = replace(here, x=here.x + self.real(shift[0]), y=here.y + self.real(shift[1]))
        me, *others = self._seen_robots(i, there)
        rois = [(roi, not self.is_left(i, j)) for j, roi in enumerate(self.rois)]
        rois += [(self.rois[0], True)] * missing
        if self.observation == "state":
            seen = [body.seen * body.position for body in (me, *others)]
            seen += [body.seen * body.velocity for body in (me, *others)]
            seen += [body.seen * body.ahead for body in (me, *others)] * self.turning
            seen += [self._flag(body) for body in (me, *others)]
            seen.append(np.array([self.visit_code]))
        elif self.observation == "entities":
            seen = [*entities(self, i, there, me, others), np.zeros(missing * self.token)]
        else:
            half = np.array([self.width, self.height]) / 2
            low_x, low_y, high_x, high_y = self.polygon.bounds
            middle = np.array([low_x + high_x, low_y + high_y]) / 2
            lidar = self.observation in ("lidar", "lidar_local")
            reach = min(self.sensing_radius, math.hypot(self.width, self.height))
            centre = middle if lidar else half
            seen = [(me.position - centre) / half, me.velocity / self.top_speed]
            seen += [*[me.ahead] * self.turning, self._flag(me)]
            for other in others:
                turn = (other.velocity - me.velocity) / (2 * self.top_speed)
                ahead = [other.ahead] * self.turning
                notice = self.knowledge.notice if self.knowledge else self.sensing_radius
                sight = self._sight(other.position - me.position, notice, turn, *ahead)
                if lidar:
                    distance = math.dist(other.position, me.position)
                    sight.append(np.array([max(0.0, 1.0 - distance / reach)]))
                seen += [(other.seen and not self.gone(other)) * entries for entries in sight]
                seen.append(self.notices(me, other) * self._flag(other))
            for j, (roi, visited) in enumerate(rois):
                place, is_seen = self.disturbances.seen(i, 64 + j, roi, self.bounds)
                offset = np.array(place) - me.position
                direction = [offset / (math.hypot(*offset) + 1.0)] if lidar else []
                sight = self._sight(offset, self.sensing_radius, *direction)
                seen += [is_seen * entries for entries in sight]
                seen.append(np.array([visited, *self.mine(i, j)]))
            if lidar:
                seen.append(self._walls(there, reach))
        if self.one_hot:
            seen.append(np.eye(self.n)[i])
        return np.concatenate(seen).astype(np.float32)

    def _seen_robots(self, i: int, me: Robot) -> list[Robot]:
        bodies = {i: me, **{j: body for j, body in enumerate(self.robots) if j != i}}
        if not self.disturbances.blurs:
            return [*bodies.values()]
        found = []
        for j, body in bodies.items():
            motion = (body.x, body.y, body.vx, body.vy)
            (x, y, vx, vy), seen = self.disturbances.seen(i, j, motion, self.bounds)
            found.append(replace(body, x=x, y=y, vx=vx, vy=vy, seen=seen))
        return found

    def _flag(self, robot: Robot) -> NDArray[Any]:
        return np.array([robot.failed] if self.failures else [], float)

    def gone(self, robot: Robot) -> bool:
        return robot.failed and self.failures.kind == "vanish"

    def _sight(
        self, offset: NDArray[Any], radius: float, *more: NDArray[Any]
    ) -> list[NDArray[Any]]:
        entries = [offset / np.array([self.width, self.height]), *more]
        if self.observation not in ("local", "lidar_local"):
            return entries
        near = math.hypot(*offset) <= radius
        flag = [np.array([near])] if self.observation == "local" else []
        return [*flag, *(near * entry for entry in entries)]

    def _walls(self, me: Robot, reach: float) -> list[float]:
        """The last eleven entries of ``lidar``: rays, time to the wall, brake, distance."""
        spot, velocity = me.position.astype(float), me.velocity.astype(float)
        angles = [math.radians(45 * k) for k in range(8)]
        rays = [self._free(spot, math.cos(a), math.sin(a), reach) for a in angles]
        speed, time = math.hypot(*velocity), 1.0
        if speed > RESIDUE:
            far = reach * speed / float(self.top_speed)  # as long as the reach at the speed limit
            time = self._free(spot, velocity[0] / speed, velocity[1] / speed, far)
        rest = me.vehicle.place_of_rest(me.position, me.velocity, me.heading)
        inside = bool(shapely.intersects_xy(self.polygon, *rest))
        distance = self.boundary.distance(shapely.Point(spot))
        return [*rays, time, float(inside), min(1.0, distance / reach)]

    def _free(self, spot: NDArray[Any], x: float, y: float, reach: float) -> float:
        """The part of ``reach`` that a robot can go along (x, y) before it leaves the field."""
        start, end = shapely.Point(spot), (spot[0] + reach * x, spot[1] + reach * y)
        ways = self.polygon.intersection(shapely.LineString([start, end]))
        own = [way for way in shapely.get_parts(ways) if way.distance(start) < SLACK]
        return max((way.length for way in own), default=0.0) / reach

    def _each(self, value: Any) -> list[Any]:
        one = isinstance(value, str | int | float) or is_range(value)
        return [value] * self.n if one else list(value)

    def metrics(self) -> dict[str, Any]:
        return {
            "success": self.success,
            "collision": self.collision,
            "rois_visited": sum(self.visited) - len(self.empty),
            "steps": self.steps,
            "episode_return": self.episode_return,
            "wall_hits": [robot.wall_hits for robot in self.robots],
            "path_length": [robot.path_length for robot in self.robots],
            "impulse": [robot.impulse for robot in self.robots],
            "failed": [robot.failed for robot in self.robots],
            "return_": [robot.return_ for robot in self.robots],
        }

    def _fail(self) -> None:
        if self.failures is None:
            return
        most = self.n - 1 if self.failures.most is None else self.failures.most
        rate = np.float32(self.failure_rate)
        key = key_of(*self.disturbances.place, self.disturbances.episode, FAILURES)
        for i, robot in enumerate(self.robots):
            count = sum(other.failed for other in self.robots)
            number = uniform(key, self.steps * 64 + i)
            due = self.steps + 1 in (self.failures.at.get(i), self.fails.get(i))
            if due or (count < most and number < rate):
                robot.failed = True

    def _move(self, robot: Robot, action: Sequence[float], step: Step) -> bool:
        """Rules 1 to 3. Returns whether the robot tried to leave the field."""
        real, before = self.real, robot.heading
        gust = self.disturbances.gust
        if robot.failed:
            velocity = robot.vehicle.drift(self.failures.kind, (robot.vx, robot.vy), before, gust)
            force_x = force_y = real(0.0)
        else:
            velocity, robot.heading, (force_x, force_y) = robot.vehicle.move(
                (robot.vx, robot.vy), before, action, gust
            )
        robot.vx, robot.vy = velocity
        x = robot.x + robot.vx * self.tau
        y = robot.y + robot.vy * self.tau
        step.margin = min(step.margin, self.boundary.distance(shapely.Point(x, y)))
        outside = not shapely.intersects_xy(self.polygon, x, y)
        if outside:
            robot.vx = robot.vy = real(0.0)
            robot.heading = before
            robot.wall_hits += not robot.failed
            x, y = robot.x, robot.y
        x, y = clip(x, real(0.0), self.width), clip(y, real(0.0), self.height)
        robot.path_length += math.hypot(x - robot.x, y - robot.y)
        robot.impulse_x += float(force_x * self.tau)
        robot.impulse_y += float(force_y * self.tau)
        robot.x, robot.y = x, y
        return outside

    def _visit(self, i: int, robot: Robot, step: Step) -> int:
        """Rule 5. Returns how many ROIs the robot is credited with reaching first."""
        count = 0
        if self.gone(robot):
            return count
        for index, (x, y) in enumerate(self.rois):
            if not self.visited[index] and self.is_mine(i, index):
                distance = math.hypot(robot.x - x, robot.y - y)
                step.margin = min(step.margin, abs(distance - self.roi_radius))
                if distance <= self.roi_radius:
                    self.visited[index] = True
                    count += not robot.failed
        return count

    def _any_collision(self, step: Step) -> bool:
        """The predicate of rule 7: some pair is closer than the safety distance."""
        found = False
        there = [robot for robot in self.robots if not self.gone(robot)]
        for i, one in enumerate(there):
            for other in there[:i]:
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
