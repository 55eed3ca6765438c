"""The oracle's dynamics: each of ``docs/mdp.md``, in its order of operations."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

REALS: dict[str, Any] = {"float64": float, "float32": np.float32}
TURNING = ("unicycle", "bicycle")  # the dynamics with a heading


@dataclass(frozen=True)
class Vehicle:
    dynamics: str
    real: Any
    mass: Any
    f_max: Any
    v_clip: Any
    tau: Any
    wind_x: Any
    wind_y: Any
    turn_max: Any
    wheelbase: Any
    steer_max: Any

    @property
    def turns(self) -> bool:
        return self.dynamics in TURNING

    def ahead(self, heading: Any) -> tuple[Any, Any]:
        if not self.turns:
            return self.real(0.0), self.real(0.0)
        return self.real(cosine(float(heading))), self.real(sine(float(heading)))

    def move(self, velocity: Any, heading: Any, action: Any, gust: Any) -> tuple[Any, Any, Any]:
        a, b = (clip(self.real(one), self.real(-1.0), self.real(1.0)) for one in action)
        wind = (self.wind_x + gust[0], self.wind_y + gust[1])
        if not self.turns:
            axes = [self._axis(*row) for row in zip(velocity, (a, b), wind, strict=True)]
            return tuple(v for v, _ in axes), heading, tuple(u for _, u in axes)
        old = self.ahead(heading)
        speed, force = dot(velocity, old), a * self.f_max
        if self.dynamics == "unicycle":
            heading = self._turned(heading, b * self.turn_max * self.tau)
            old = self.ahead(heading)
        speed = self._limited(speed + force / self.mass + dot(wind, old))
        if self.dynamics == "bicycle":
            angle = float(b * self.steer_max)
            rate = speed / self.wheelbase * self.real(sine(angle) / cosine(angle))
            heading = self._turned(heading, rate * self.tau)
        new = self.ahead(heading)
        return (speed * new[0], speed * new[1]), heading, (force * old[0], force * old[1])

    def drift(self, kind: str, velocity: Any, heading: Any, gust: Any) -> tuple[Any, Any]:
        wind, most = (self.wind_x + gust[0], self.wind_y + gust[1]), self.f_max / self.mass

        def one(speed: Any, push: Any) -> Any:
            if kind == "coast":
                return self._limited(speed + push)
            return speed - clip(speed, -most, most)

        if kind == "vanish":
            return self.real(0.0), self.real(0.0)
        if self.turns:
            ahead = self.ahead(heading)
            speed = one(dot(velocity, ahead), dot(wind, ahead))
            return speed * ahead[0], speed * ahead[1]
        return one(velocity[0], wind[0]), one(velocity[1], wind[1])

    def place_of_rest(self, spot: Any, velocity: Any, heading: Any) -> tuple[float, float]:
        """The point at which it stops if it brakes from now on, (x, y); infinity if never."""
        brake = float(self.f_max / self.mass)
        wind = (float(self.wind_x), float(self.wind_y))
        moving = tuple(map(float, velocity))
        if not self.turns:
            paths = [self._path(v, brake, w) for v, w in zip(moving, wind, strict=True)]
            return float(spot[0]) + paths[0], float(spot[1]) + paths[1]
        c, s = map(float, self.ahead(heading))
        path = self._path(dot(moving, (c, s)), brake, dot(wind, (c, s)))
        if math.isinf(path):
            return path, path
        return float(spot[0]) + path * c, float(spot[1]) + path * s

    def _axis(self, v: Any, a: Any, wind: Any) -> tuple[Any, Any]:
        if self.dynamics == "point_mass":
            return self._limited(v + a * self.f_max / self.mass + wind), a * self.f_max
        most = self.f_max / self.mass
        change = clip(a * self.v_clip - v, -most, most)
        return self._limited(v + change + wind), self.mass * change

    def _limited(self, speed: Any) -> Any:
        return clip(speed, -self.v_clip, self.v_clip)

    def _turned(self, heading: Any, turn: Any) -> Any:
        half = self.real(math.pi)
        angle = heading + turn
        count = angle / (half + half)
        turns = math.floor(abs(count) + self.real(0.5))
        angle = angle - self.real(math.copysign(turns, count)) * (half + half)
        return angle if -half <= angle < half else -half

    def _path(self, speed: float, brake: float, wind: float) -> float:
        """The distance along a line until it rests, braking step by step; perhaps infinite."""
        slower, path = brake - math.copysign(wind, wind * speed), 0.0
        if speed != 0 and slower <= 0:
            return math.inf
        while speed != 0:
            speed = math.copysign(max(0.0, abs(speed) - slower), speed)
            path += speed * float(self.tau)
        return path


@dataclass
class Robot:
    """One robot and its sums; ``seen`` is False for a robot that does not see this one."""

    vehicle: Vehicle
    x: Any
    y: Any
    vx: Any
    vy: Any
    heading: Any
    impulse_x: float = 0.0
    impulse_y: float = 0.0
    path_length: float = 0.0
    wall_hits: int = 0
    failed: bool = False
    return_: float = 0.0
    seen: bool = True

    @property
    def position(self) -> NDArray[Any]:
        return np.array([self.x, self.y])

    @property
    def velocity(self) -> NDArray[Any]:
        return np.array([self.vx, self.vy])

    @property
    def ahead(self) -> NDArray[Any]:
        return np.array(self.vehicle.ahead(self.heading))

    @property
    def impulse(self) -> float:
        return math.hypot(self.impulse_x, self.impulse_y)


def sine(angle: float) -> float:
    """The documented approximation, for angles in [-pi, pi]."""
    if angle > math.pi / 2:
        angle = math.pi - angle
    elif angle < -math.pi / 2:
        angle = -math.pi - angle
    return _series(angle)


def cosine(angle: float) -> float:
    """The documented approximation, for angles in [-pi, pi]."""
    return _series(math.pi / 2 - abs(angle))


def _series(x: float) -> float:
    """The sine near 0: ``x (1 - x^2 / 3! + ... + x^20 / 21!)``, from the last term inwards."""
    square, total = x * x, 0.0
    for power in range(21, 0, -2):
        sign = 1.0 if power % 4 == 1 else -1.0
        total = total * square + sign / math.factorial(power)
    return clip(x * total, -1.0, 1.0)


def dot(one: Any, other: Any) -> Any:
    return one[0] * other[0] + one[1] * other[1]


def clip(value: Any, low: Any, high: Any) -> Any:
    return min(max(value, low), high)
