"""One episode to look at: its snapshots, and the file that shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from baselines.policies import Policy
from mbn_marl.engine import BatchEngine, Snapshot
from mbn_marl.field import Field
from mbn_marl.render import Viewer, write_gif


def record_episode(
    policy: Policy,
    field: Field,
    settings: Mapping[str, Any],
    *,
    deterministic: bool = True,
    seed: int = 0,
    limit: int | None = None,
) -> list[Snapshot]:
    """Snapshots of an episode: after the reset and after every step.

    Args:
        policy: what acts.
        field: where.
        settings: settings of the environment.
        deterministic: take the mean action instead of a sampled one.
        seed: of the world and of the sampled actions.
        limit: stop after so many steps; ``None`` for the whole episode.
    """
    engine = BatchEngine(field, 1, seed=seed, autoreset="disabled", threads=1, **settings)
    observations = engine.reset()
    snapshots = [engine.snapshot()]
    ended = False
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        while not ended and (limit is None or len(snapshots) <= limit):
            seen = engine.state() if policy.observes == "state" else observations
            actions = policy.act(seen, deterministic=deterministic)
            observations, _, terminated, truncated = engine.step(actions)
            snapshots.append(engine.snapshot())
            ended = bool(terminated[0] or truncated[0])
    return snapshots


def write_animation(snapshots: Sequence[Snapshot], path: Path) -> None:
    """Write the episode as a GIF that rests on its last frame.

    Raises:
        MbnError: ``path`` does not end in ``.gif``.
    """
    viewer = Viewer("rgb_array")
    frames = [viewer.draw(snapshot) for snapshot in snapshots]
    pictures = [frame for frame in frames if frame is not None]
    write_gif([*pictures, *pictures[-1:] * 20], path)


def show(snapshots: Sequence[Snapshot]) -> None:
    """Play the episode in a window, until it ends or the window is closed."""
    viewer = Viewer("human")
    for snapshot in snapshots:
        viewer.draw(snapshot)
        if viewer.closed:
            break
    viewer.close()


def write_trajectories(last: Snapshot, path: Path, title: str | None = None) -> None:
    """Write the paths up to the snapshot ``last`` as a figure (png, pdf or svg).

    Raises:
        MbnError: for another format.
    """
    from mbn_marl.render import figures

    figure = figures.trajectory_figure(
        last.field,
        last.trail,
        visited=last.visited,
        collision=last.collision,
        wind=last.wind,
        roi_radius=last.roi_radius,
        title=title,
    )
    figures.save(figure, path)
