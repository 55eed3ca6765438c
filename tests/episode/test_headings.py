"""Headings in episodes: recorded, kept in the file, replayed bit for bit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mbn_marl import BatchEngine
from mbn_marl.episode import EpisodeRecorder, check_episode, load_episode, save_episode
from mbn_marl.errors import EpisodeError


def test_headings_are_recorded_kept_and_replayed(tmp_path: Path) -> None:
    mixed = {"dynamics": ("point_mass", "unicycle", "bicycle"), "wind": (0.2, 30.0)}
    engine = BatchEngine("field_03", 2, seed=5, **mixed)
    with EpisodeRecorder(engine, world=1) as recorder:
        engine.reset()
        for _ in range(15):
            engine.step(engine.sample_actions())
    seen = engine.snapshot(1).headings
    path = save_episode(recorder.episodes[0], tmp_path / "turning.json")
    episode = load_episode(path)
    assert episode.headings.shape == (16, 3) and np.isnan(episode.headings[:, 0]).all()
    assert np.array_equal(episode.headings[-1], seen, equal_nan=True) and seen[1:].all()
    assert np.array_equal(episode.snapshot(15).headings, seen, equal_nan=True)
    check_episode(episode)
    bent = episode.headings.copy()
    bent[4, 1] += 1e-6
    with pytest.raises(EpisodeError, match=r"headings: .*step 4 "):
        check_episode(replace(episode, headings=bent))
    content = json.loads(path.read_text())
    content["headings"]["shape"] = [3, 16]
    path.write_text(json.dumps(content))
    with pytest.raises(EpisodeError, match=r"headings: shape \(3, 16\); allowed: \(16, 3\)"):
        load_episode(path)
