"""The oracle's knowledge: ``docs/mdp.md``, "Knowledge"."""

import math
from typing import Any

import numpy as np

from tests.support.disturbances import key_of, uniform

DECOYS, TELLING = 9, 10  # The purposes of the streams


def drawn_decoys(decoys: Any, m: int, *place: int) -> set[int]:
    """The empty ones of m ROIs in the episode with a seed, a world and a number."""
    least, most = decoys if isinstance(decoys, tuple) else (decoys, decoys)
    key, empty = key_of(*place, DECOYS), set[int]()
    count = least + math.floor(uniform(key, 24) * np.float32(most - least + 1))
    for j in range(m):
        if uniform(key, j) * np.float32(m - j) < count - len(empty):
            empty.add(j)
    return empty


class Knowledge:
    """The ROIs that each robot of an oracle knows to be done, and those that it has found."""

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
        found = {("found", j) for j in range(len(self.oracle.rois)) if not self.hidden}
        self.words = [{*found} for _ in range(self.oracle.n)]
        self.sent: list[Any] = []
        self.learn()

    def learn(self) -> float:
        """Look, find and tell. Return the least distance of a decision from its threshold."""
        oracle, words, margins = self.oracle, self.words, [math.inf]
        spots = [(robot.x, robot.y) for robot in oracle.robots]
        there = [i for i, robot in enumerate(oracle.robots) if not oracle.gone(robot)]

        def near(a: Any, b: Any, radius: float) -> bool:
            margins.append(abs(math.dist(a, b) - radius))
            return math.dist(a, b) <= radius

        for i in there:
            for j, roi in enumerate(oracle.rois):
                if oracle.visited[j] and near(spots[i], roi, self.look):
                    words[i].add(("done", j))
                if self.hidden and near(spots[i], roi, oracle.sensing_radius):
                    words[i].add(("found", j))
        self.sent.append([{*known} for known in words])
        key = key_of(*oracle.place, oracle.episode, TELLING)
        for i in there if len(self.sent) > self.delay else ():
            for k in there:
                lost = uniform(key, (oracle.steps * 64 + i) * 64 + k) < self.loss
                if i != k and near(spots[i], spots[k], self.comm) and not lost:
                    words[i] |= self.sent[-1 - self.delay][k]
        return min(margins)
