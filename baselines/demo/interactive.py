"""Watching a policy in a window, and driving one of its robots."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Set as AbstractSet

import numpy as np

from baselines.demo.resolve import Actor
from baselines.evaluation.evaluate import sampling
from baselines.evaluation.fitting import fitted
from baselines.evaluation.policy import restart
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


@dataclasses.dataclass(frozen=True)
class Show:
    """How episodes are shown."""

    deterministic: bool = True  # take the policy's mean action instead of a sampled one
    seed: int = 0  # of the worlds and of sampled actions
    speed: float = 10.0  # steps a second, above 0
    episodes: int | None = None  # how many; ``None``: until the window is closed
    rest: float = 1.5  # seconds that the end of an episode stays

    def __post_init__(self) -> None:
        """Check the numbers."""
        problems = []
        if not 0.0 < self.speed < math.inf:
            problems.append(f"speed: a finite number above 0, not {self.speed:g}")
        if self.episodes is not None and self.episodes < 1:
            problems.append(f"episodes: at least 1, not {self.episodes}")
        if problems:
            raise ConfigError("window", problems)


def watch(actor: Actor, how: Show) -> list[Episode]:
    """Show episodes in a window, with its keys; return those that were shown.

    Raises:
        ImportError: pygame is not installed.
        DisplayError: there is no display.
    """
    return _run(actor, how, None, _KEYS)


def play(actor: Actor, how: Show, robot: int) -> list[Episode]:
    """Show episodes as :func:`watch` does, while a person drives robot ``robot``.

    Raises:
        ConfigError: there is no such robot.
    """
    robots = actor.settings.get("n_robots") or len(actor.field.starts)
    if not 0 <= robot < robots:
        raise ConfigError("window", [f"robot: 0 to {robots - 1}, not {robot}"])
    return _run(actor, how, robot, f"robot {robot} (ringed): arrows or WASD, {_KEYS}")


def push(held: AbstractSet[str]) -> tuple[float, float]:
    """Return the action of the keys held down, in [-1, 1] along x and y; opposite keys cancel."""
    forces = [DIRECTIONS[key] for key in held if key in DIRECTIONS]
    x, y = np.clip(np.sum(forces, axis=0) if forces else (0.0, 0.0), -1.0, 1.0)
    return float(x), float(y)


def _run(actor: Actor, how: Show, driven: int | None, keys: str) -> list[Episode]:
    caption = f"{actor.field.name} - {actor.name}"
    viewer = Viewer("human", frame_rate=how.speed, caption=caption, own=driven, keys=keys)
    engine = BatchEngine(actor.field, 1, seed=how.seed, autoreset=False, **actor.settings)
    actor = dataclasses.replace(actor, policy=fitted(actor.policy, engine))
    name = actor.name if driven is None else f"a person as robot {driven}, with {actor.name}"
    finished = 0
    with sampling(how.seed), EpisodeRecorder(engine, source=name) as recorder:
        while not viewer.closed and (how.episodes is None or finished < how.episodes):
            finished += _one_episode(engine, viewer, actor, how, driven)
    viewer.close()
    return recorder.episodes


def _one_episode(
    engine: BatchEngine, viewer: Viewer, actor: Actor, how: Show, driven: int | None
) -> bool:
    """Show one episode and rest at its end; return False if it was cut short."""
    policy, observations, paused = actor.policy, engine.reset(), False
    restart(policy)
    viewer.draw(engine.snapshot())
    while engine.running[0]:
        if not paused:
            seen = engine.state() if policy.observes == "state" else observations
            actions = np.array(policy.act(seen, deterministic=how.deterministic), np.float64)
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
