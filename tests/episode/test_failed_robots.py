"""Failures in episodes: recorded as they came about, kept in the file, replayed bit for bit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, load_field
from mbn_marl.config import Failures, make_config
from mbn_marl.episode import EpisodeRecorder, check_episode, load_episode, play, save_episode
from mbn_marl.errors import EpisodeError


def test_failures_by_chance_are_recorded_kept_and_replayed(tmp_path: Path) -> None:
    failing: dict[str, Any] = {"failures": Failures(rate=0.1, most=2), "max_steps": 15}
    engine = BatchEngine("field_03", 3, seed=5, **failing)
    with EpisodeRecorder(engine, world=1) as recorder:
        engine.reset()
        flags = [engine.snapshot(1).failed.tolist()]
        for _ in range(14):
            engine.step(engine.sample_actions())
            flags.append(engine.snapshot(1).failed.tolist())
        engine.step(engine.sample_actions())  # the world restarts
    first, *_ = recorder.episodes
    path = save_episode(first, tmp_path / "failing.json")
    episode = load_episode(path)
    assert sum(flags[-1]) == 2 and episode.config.failures == failing["failures"]
    assert [episode.snapshot(step).failed.tolist() for step in range(15)] == flags
    check_episode(episode)
    late = np.where(episode.failed > 0, episode.failed + 1, 0)
    with pytest.raises(EpisodeError, match=r"failed: .*; replayed in the engine"):
        check_episode(replace(episode, failed=late))
    with pytest.raises(EpisodeError, match="it does not replay"):
        check_episode(replace(episode, number=1))
    content = json.loads(path.read_text())
    content["failed"] = [1, 99]
    path.write_text(json.dumps(content))
    with pytest.raises(EpisodeError) as caught:
        load_episode(path)
    assert caught.value.problems == [
        "failed: 2; allowed: 3, one for each robot",
        "failed: allowed: null, or a step from 1 to 15",
    ]


def test_a_failure_needs_a_configuration_with_failures() -> None:
    actions = np.full((3, 3, 2), 0.5)
    episode = play(load_field("field_03"), make_config({}), actions)
    assert not episode.failed.any()
    with pytest.raises(EpisodeError, match="failed"):
        check_episode(replace(episode, failed=np.array([0, 2, 0], np.int32)))
