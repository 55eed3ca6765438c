"""The numbers that an episode of the oracle draws: ``docs/conditions.md``, "Drawn numbers"."""

import math
from typing import Any

from tests.support.disturbances import uniform
from tests.support.vehicles import cosine, sine

NUMBERS = 7  # The purpose of the stream
SINGLE = (
    *("wind_speed", "wind_angle", "gust", "gust_time", "action_noise", "action_loss"),
    *("position_noise", "velocity_noise", "dropout", "tau", "turn_max", "wheelbase", "steer_max"),
    *("safety_distance", "roi_radius", "failure_rate"),
)  # In the order of their counters
LIMITS = ("mass", "f_max", "v_clip")


def is_range(value: Any) -> bool:
    return hasattr(value, "low")


def highest(values: list[Any]) -> list[float]:
    return [value.high if is_range(value) else value for value in values]


def drawn_settings(settings: dict[str, Any], n: int, key: int) -> dict[str, Any]:
    found = dict(settings)
    n = found.get("n_robots") or n

    def number(value: Any, counter: int) -> Any:
        if not is_range(value):
            return value
        return value.low + (value.high - value.low) * float(uniform(key, counter))

    for counter, name in enumerate(SINGLE):
        if name in found:
            found[name] = number(found[name], counter)
    for row, name in enumerate(LIMITS):
        first, value = len(SINGLE) + row * 64, found.get(name)
        if is_range(value):
            found[name] = number(value, first)
        elif isinstance(value, tuple):
            found[name] = tuple(number(one, first + i) for i, one in enumerate(value))
    if any(map(is_range, found.get("wind", ()))):
        speed, angle = (number(value, k) for k, value in enumerate(found["wind"]))
        found["wind"], found["wind_vector"] = (speed, angle), vector(speed, angle)
    if (failures := found.get("failures")) is not None:
        found["failure_rate"] = number(failures.rate, SINGLE.index("failure_rate"))
        found["fails"] = drawn_failure(failures.between, n, key)
    return found


def vector(speed: float, angle: float) -> tuple[float, float]:
    turn = angle * (math.pi / 180.0)
    turn -= round(turn / (2 * math.pi)) * (2 * math.pi)
    return speed * cosine(turn), speed * sine(turn)


def drawn_failure(steps: tuple[int, int] | None, n: int, key: int) -> dict[int, int]:
    if steps is None:
        return {}
    first, last = steps
    robot = math.floor(float(uniform(key, 1000)) * n)
    return {robot: first + math.floor(float(uniform(key, 1001)) * (last - first + 1))}
