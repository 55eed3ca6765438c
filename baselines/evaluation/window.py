"""Watching a policy in a window, and driving one of its robots."""

from __future__ import annotations

import math
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np

from baselines.evaluation.evaluate import sampling
from baselines.policies.loaded import LoadedPolicy
from baselines.policies.policy import Policy
from mbn_marl.engine import BatchEngine
from mbn_marl.episode import Episode, EpisodeRecorder
from mbn_marl.errors import ConfigError
from mbn_marl.render import Viewer

DIRECTIONS = {
    **dict.fromkeys(("right", "d"), (1.0, 0.0)),
    **dict.fromkeys(("left", "a"), (-1.0, 0.0)),
    **dict.fromkeys(("up", "w"), (0.0, 1.0)),
    **dict.fromkeys(("down", "s"), (0.0, -1.0)),
}
"""The force along x and y of each key."""
_KEYS = "space: pause, R: restart, Esc: close"


@dataclass(frozen=True)
class Show:
    """The way in which episodes are shown."""

    deterministic: bool = True  # take the policy's mean action instead of a sampled one
    seed: int = 0  # of the worlds and of sampled actions
    speed: float = 10.0  # steps a second, above 0
    episodes: int | None = None  # how many; ``None``: until the window is closed
    rest: float = 1.5  # seconds that the end of an episode stays

    def __post_init__(self) -> None:
        problems = []
        if not 0.0 < self.speed < math.inf:
            problems.append(f"speed: a finite number above 0, not {self.speed:g}")
        if self.episodes is not None and self.episodes < 1:
            problems.append(f"episodes: at least 1, not {self.episodes}")
        if problems:
            raise ConfigError("window", problems)


def push(held: AbstractSet[str]) -> tuple[float, float]:
    """Return the action of the keys held down, in [-1, 1] along x and y; opposite keys cancel."""
    forces = [DIRECTIONS[key] for key in held if key in DIRECTIONS]
    x, y = np.clip(np.sum(forces, axis=0) if forces else (0.0, 0.0), -1.0, 1.0)
    return float(x), float(y)


def watch(policy: LoadedPolicy, how: Show, driven: int | None = None) -> list[Episode]:
    """Show episodes in a window and return them; a person may drive the robot ``driven``.

    Raises:
        ConfigError: there is no such robot.
        ImportError: pygame is not installed.
        DisplayError: there is no display.
    """
    keys, source = _KEYS, policy.name
    engine = BatchEngine(policy.place, 1, seed=how.seed, autoreset=False, **policy.settings)
    if driven is not None:
        if not 0 <= driven < engine.n_robots:
            raise ConfigError("window", [f"robot: 0 to {engine.n_robots - 1}, not {driven}"])
        keys = f"robot {driven} (ringed): arrows or WASD, {_KEYS}"
        source = f"a person as robot {driven}, with {policy.name}"
    caption = f"{policy.place.name} - {policy.name}"
    fitted, finished = policy.fit(engine), 0
    viewer = Viewer("human", frame_rate=how.speed, caption=caption, own=driven, keys=keys)
    with sampling(how.seed), EpisodeRecorder(engine, source=source) as recorder:
        while not viewer.closed and (how.episodes is None or finished < how.episodes):
            finished += _one_episode(engine, viewer, fitted, how, driven)
    viewer.close()
    return recorder.episodes


def _one_episode(
    engine: BatchEngine, viewer: Viewer, policy: Policy, how: Show, driven: int | None
) -> bool:
    """Show one episode and rest at its end; return False if it was cut short."""
    observations, paused = engine.reset(), False
    policy.reset()
    viewer.draw(engine.snapshot())
    while engine.running[0]:
        if not paused:
            chosen = policy.act_in(engine, observations, deterministic=how.deterministic)
            actions = np.array(chosen, np.float64)
            if driven is not None:
                actions[0, driven] = push(viewer.held)
            observations = engine.step(actions)[0]
        viewer.draw(engine.snapshot())
        paused ^= "space" in viewer.pressed
        if viewer.closed or "r" in viewer.pressed:
            return False
    for _ in range(round(how.rest * how.speed)):
        viewer.draw(engine.snapshot())
        if viewer.closed or viewer.pressed:
            break
    return True
