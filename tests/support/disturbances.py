"""The oracle's random numbers and disturbances: ``docs/specification.md``, ``conditions.md``."""

import math
from typing import Any

import numpy as np

GOLDEN, WORD = 0x9E3779B97F4A7C15, 2**64
FAILURES, GUSTS, SENDING, SIGHT = 3, 4, 5, 6


def mixed(number: int) -> int:
    """The mixer of SplitMix64, in whole numbers."""
    number %= WORD
    number = (number ^ (number >> 30)) * 0xBF58476D1CE4E5B9 % WORD
    number = (number ^ (number >> 27)) * 0x94D049BB133111EB % WORD
    return number ^ (number >> 31)


def key_of(*numbers: int) -> int:
    """The key of an episode from seed, world and episode, or of a stream with its purpose too."""
    key = 0
    for number in numbers:
        key = mixed(key + number + GOLDEN)
    return key


def uniform(key: int, counter: int) -> np.float32:
    return np.float32((mixed(key + counter * GOLDEN) >> 40) / 2**24)


def normal(key: int, counter: int) -> np.float32:
    digits = f"{mixed(key + counter * GOLDEN):064b}"
    ones, low, next_ = digits[:40].count("1"), int(digits[52:], 2), int(digits[40:52], 2)
    t = np.float32(ones - 21 + (low + next_ + 1) / 4096)
    return t * (np.float32(0.31164049) + np.float32(6.6003307e-5) * (t * t))


def exponential(x: float) -> float:
    """The documented approximation for x up to 0."""
    part = max(x, -40.0) / 32.0
    total = 0.0
    for power in range(22, -1, -1):
        total = total * part + 1.0 / math.factorial(power)
    for _ in range(5):
        total *= total
    return total


class Disturbances:
    def __init__(
        self,
        real: Any,
        seed: int,
        world: int,
        *,
        gust: float = 0.0,
        gust_time: float = 10.0,
        action_noise: float = 0.0,
        action_loss: float = 0.0,
        action_delay: int = 0,
        position_noise: float = 0.0,
        velocity_noise: float = 0.0,
        dropout: float = 0.0,
    ) -> None:
        self.real, self.place = real, (seed, world)
        self.sds = [real(position_noise)] * 2 + [real(velocity_noise)] * 2
        self.dropout = real(dropout)
        self.blurs = bool(position_noise or velocity_noise or dropout)
        self.loss, self.noise, self.delay = real(action_loss), real(action_noise), action_delay
        kept = exponential(-1.0 / gust_time)
        self.sigma, self.kept = real(gust), real(kept)
        self.added = real(gust * math.sqrt(1.0 - kept * kept))

    def begin(self, episode: int) -> None:
        self.episode, self.steps = episode, 0
        self.sent: list[Any] = []
        self.gust = (self.real(0.0), self.real(0.0))
        if self.sigma:
            self.gust = tuple(self.sigma * self._normal(GUSTS, axis) for axis in range(2))

    def arrived(self, actions: Any) -> Any:
        if not (self.noise or self.loss or self.delay):
            return actions
        nothing = [(self.real(0.0), self.real(0.0))] * len(actions)
        key = key_of(*self.place, self.episode, SENDING)
        counters = [4 * (64 * self.steps + i) for i in range(len(actions))]
        last = self.sent[-1] if self.sent else nothing
        sent = []
        for action, before, counter in zip(actions, last, counters, strict=True):
            given = tuple(self._limited(self.real(one)) for one in action)
            sent.append(before if uniform(key, counter) < self.loss else given)
        self.sent.append(sent)
        late = self.sent[-1 - self.delay] if len(self.sent) > self.delay else nothing
        return [
            tuple(
                self._limited(one + self.noise * self.real(normal(key, counter + axis)))
                for axis, one in enumerate(action, start=1)
            )
            for action, counter in zip(late, counters, strict=True)
        ]

    def seen(self, i: int, thing: int, numbers: Any, bounds: Any) -> tuple[list[Any], bool]:
        """A thing's motion as robot i sees it, and if it does; robot j is thing j, ROI j 64 + j."""
        if not self.blurs:
            return list(numbers), True
        key = key_of(*self.place, self.episode, SIGHT)
        counter = 8 * (128 * (64 * self.steps + i) + thing)
        rows = zip(numbers, self.sds, bounds, strict=False)
        found = [
            min(max(number + sd * self.real(normal(key, counter + k)), low), high)
            for k, (number, sd, (low, high)) in enumerate(rows, start=1)
        ]
        return found, thing == i or not uniform(key, counter) < self.dropout

    def end_step(self) -> None:
        self.steps += 1
        if self.sigma:
            counter = 2 * self.steps
            self.gust = tuple(
                self.kept * self.gust[axis] + self.added * self._normal(GUSTS, counter + axis)
                for axis in range(2)
            )

    def _limited(self, number: Any) -> Any:
        return min(max(number, self.real(-1.0)), self.real(1.0))

    def _normal(self, purpose: int, counter: int) -> Any:
        return self.real(normal(key_of(*self.place, self.episode, purpose), counter))
