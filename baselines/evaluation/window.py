"""Watching a policy in a window, and driving one of its robots."""

import math
from collections.abc import Set as AbstractSet

import numpy as np

from baselines.evaluation.evaluate import sampling
from baselines.policies.loaded import LoadedPolicy
from mbn_marl.engine import BatchEngine
from mbn_marl.episode import Episode, EpisodeRecorder
from mbn_marl.errors import ConfigError
from mbn_marl.render import Viewer

# The force along x and y of each key.
DIRECTIONS = {
    **dict.fromkeys(("right", "d"), (1.0, 0.0)),
    **dict.fromkeys(("left", "a"), (-1.0, 0.0)),
    **dict.fromkeys(("up", "w"), (0.0, 1.0)),
    **dict.fromkeys(("down", "s"), (0.0, -1.0)),
}
_KEYS = "space: pause, R: restart, Esc: close"


def push(held: AbstractSet[str]) -> tuple[float, float]:
    """Return the action of the keys held down, in [-1, 1] along x and y; opposite keys cancel."""
    forces = [DIRECTIONS[key] for key in held if key in DIRECTIONS]
    x, y = np.clip(np.sum(forces, axis=0) if forces else (0.0, 0.0), -1.0, 1.0)
    return float(x), float(y)


def watch(
    policy: LoadedPolicy,
    *,
    driven: int | None = None,
    deterministic: bool = True,
    seed: int = 0,
    speed: float = 10.0,
    episodes: int | None = None,
    rest: float = 1.5,
) -> list[Episode]:
    """Show episodes in a window and return them; a person may drive the robot ``driven``."""
    engine = BatchEngine(policy.place, 1, seed=seed, autoreset=False, **policy.settings)
    wrong = {
        f"speed: a finite number above 0, not {speed:g}": not 0.0 < speed < math.inf,
        f"episodes: at least 1, not {episodes}": episodes is not None and episodes < 1,
        f"robot: 0 to {engine.n_robots - 1}, not {driven}": driven is not None
        and not 0 <= driven < engine.n_robots,
    }
    if any(wrong.values()):
        raise ConfigError("window", [problem for problem, found in wrong.items() if found])
    person = driven is not None
    fitted, finished = policy.fit(engine), 0
    viewer = Viewer(
        "human",
        frame_rate=speed,
        caption=f"{policy.place.name} - {policy.name}",
        own=driven,
        keys=f"robot {driven} (ringed): arrows or WASD, {_KEYS}" if person else _KEYS,
    )
    source = f"a person as robot {driven}, with {policy.name}" if person else policy.name
    with sampling(seed), EpisodeRecorder(engine, source=source) as recorder:
        while not viewer.closed and finished != episodes:
            observations, paused = engine.reset(), False
            fitted.reset()
            viewer.draw(engine.snapshot())
            while engine.running[0]:
                if not paused:
                    chosen = fitted.act_in(engine, observations, deterministic=deterministic)
                    actions = np.array(chosen, np.float64)
                    if person:
                        actions[0, driven] = push(viewer.held)
                    observations = engine.step(actions)[0]
                viewer.draw(engine.snapshot())
                paused ^= "space" in viewer.pressed
                if viewer.closed or "r" in viewer.pressed:
                    break
            else:
                finished += 1
                for _ in range(round(rest * speed)):
                    viewer.draw(engine.snapshot())
                    if viewer.closed or viewer.pressed:
                        break
    viewer.close()
    return recorder.episodes
