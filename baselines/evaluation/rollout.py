"""One episode of a policy, and the files that show an episode."""

from collections.abc import Iterator, Mapping
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.evaluation.evaluate import roll_out
from baselines.policies.policy import Policy
from mbn_marl.engine import BatchEngine
from mbn_marl.episode import Episode, EpisodeRecorder, save_episode
from mbn_marl.field import Field
from mbn_marl.render import Viewer, figures, write_gif, write_mp4

ANIMATIONS = {".gif": write_gif, ".mp4": write_mp4}
FORMATS = (*ANIMATIONS, *figures.FORMATS, ".json")
# Pixels.
ANIMATION_SIZE = (400, 400)
# Frames that an animation rests on its end.
REST = 20


def record_episode(
    policy: Policy,
    field: Field,
    settings: Mapping[str, Any],
    *,
    deterministic: bool = True,
    seed: int = 0,
    limit: int | None = None,
    source: str = "",
) -> Episode:
    engine = BatchEngine(field, 1, seed=seed, autoreset="disabled", threads=1, **settings)
    with EpisodeRecorder(engine, source=source) as recorder:
        steps = roll_out(engine, policy, deterministic=deterministic, seed=seed)
        for number, (ended,) in enumerate(steps, start=1):
            if ended or number == limit:
                break
    return recorder.episodes[0]


def write_episode(episode: Episode, path: Path, title: str | None = None) -> None:
    ending = path.suffix.lower()
    if ending == ".json":
        save_episode(episode, path)
    elif ending in ANIMATIONS:
        ANIMATIONS[ending](_frames(episode), path)
    else:
        figures.save(figures.trajectory_figure(episode.snapshot(episode.steps), title), path)


def _frames(episode: Episode) -> Iterator[NDArray[np.uint8]]:
    viewer = Viewer("rgb_array", ANIMATION_SIZE)
    last = repeat(episode.snapshot(episode.steps), REST)
    for snapshot in chain(episode.snapshots(), last):
        frame = viewer.draw(snapshot)
        assert frame is not None  # in this mode there always is one
        yield frame
