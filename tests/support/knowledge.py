"""The oracle's knowledge: ``docs/mdp.md``, "Knowledge"."""

from __future__ import annotations

import math
from typing import Any

from tests.support.disturbances import key_of, uniform

DECOYS, TELLING = 9, 10  # The purposes of the streams


def drawn_decoys(decoys: Any, m: int, *place: int) -> set[int]:
    """The empty ones of m ROIs in the episode with a seed, a world and a number."""
    least, most = decoys if isinstance(decoys, tuple) else (decoys, decoys)
    key, empty = key_of(*place, DECOYS), set[int]()
    count = least + math.floor(float(uniform(key, 24)) * (most - least + 1))
    for j in range(m):
        if float(uniform(key, j)) * (m - j) < count - len(empty):
            empty.add(j)
    return empty


class Knowledge:
    """The sets of ROIs that each robot of an oracle knows to be done, and has found."""

    def __init__(
        self,
        oracle: Any,
        *,
        comm_radius: float = 100.0,
        look_radius: float | None = None,
        hidden_rois: bool = False,
        comm_delay: int = 0,
        comm_loss: float = 0.0,
    ) -> None:
        self.oracle, self.comm, self.hidden = oracle, comm_radius, hidden_rois
        self.look = oracle.roi_radius if look_radius is None else look_radius
        self.delay, self.loss = comm_delay, oracle.real(comm_loss)
        self.notice = max(comm_radius, oracle.sensing_radius)

    def begin(self) -> None:
        robots, rois = range(self.oracle.n), range(len(self.oracle.rois))
        self.done: list[set[int]] = [set() for _ in robots]
        self.found: list[set[int]] = [set() if self.hidden else {*rois} for _ in robots]
        self.sent: list[Any] = []
        self.learn()

    def learn(self) -> float:
        """Look, find and tell. Return the least distance of a decision from its threshold."""
        oracle, margins = self.oracle, [math.inf]
        there = [i for i, robot in enumerate(oracle.robots) if not oracle.gone(robot)]

        def near(a: Any, b: Any, radius: float) -> bool:
            distance = math.dist(a, b)
            margins.append(abs(distance - radius))
            return distance <= radius

        spots = [(robot.x, robot.y) for robot in oracle.robots]
        for i in there:
            for j, roi in enumerate(oracle.rois):
                if oracle.visited[j] and near(spots[i], roi, self.look):
                    self.done[i].add(j)
                if self.hidden and near(spots[i], roi, oracle.sensing_radius):
                    self.found[i].add(j)
        self.sent.append(
            [({*done}, {*found}) for done, found in zip(self.done, self.found, strict=True)]
        )
        if len(self.sent) > self.delay:
            words = self.sent[-1 - self.delay]
            key = key_of(*oracle.place, oracle.episode, TELLING)
            for i in there:
                for k in there:
                    lost = uniform(key, (oracle.steps * 64 + i) * 64 + k) < self.loss
                    if i != k and near(spots[i], spots[k], self.comm) and not lost:
                        self.done[i] |= words[k][0]
                        self.found[i] |= words[k][1]
        return min(margins)
