"""Episodes under conditions: what they drew is kept in the file, and they replay bit for bit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mbn_marl import BatchEngine, Uniform
from mbn_marl.episode import EpisodeRecorder, check_episode, load_episode, save_episode
from mbn_marl.errors import EpisodeError


def test_drawn_numbers_are_recorded_kept_and_replayed(tmp_path: Path) -> None:
    engine = BatchEngine(
        *("field_03", 3), seed=5, condition="windy", roi_radius=Uniform(5.0, 15.0), max_steps=9
    )
    with EpisodeRecorder(engine, world=1) as recorder:
        engine.reset()
        shots = []
        for _ in range(9):
            shots.append(engine.snapshot(1))
            engine.step(engine.sample_actions())
    episode = load_episode(save_episode(recorder.episodes[0], tmp_path / "windy.json"))
    assert episode.drawn == recorder.episodes[0].drawn
    assert [*episode.drawn] == ["wind_speed", "wind_angle", "roi_radius"]
    for step, shot in enumerate(shots):
        assert episode.snapshot(step).roi_radius == shot.roi_radius
        assert episode.snapshot(step).wind == pytest.approx(shot.wind, abs=1e-7)
    check_episode(episode)
    content = json.loads((tmp_path / "windy.json").read_text())
    assert content["wind"] == [episode.drawn["wind_speed"], episode.drawn["wind_angle"]]
    content["drawn"] = {"roi_radius": 5.0, "mass": 1.0}
    (tmp_path / "windy.json").write_text(json.dumps(content))
    with pytest.raises(EpisodeError, match=r"drawn: \['mass', 'roi_radius'\]; allowed: \['roi_"):
        load_episode(tmp_path / "windy.json")


def test_storms_replay() -> None:
    engine = BatchEngine("field_03", 2, seed=3, condition="storm", max_steps=70)
    with EpisodeRecorder(engine, world=1) as recorder:
        engine.reset()
        while not any(episode.failed.any() for episode in recorder.episodes):
            engine.step(np.zeros((2, 3, 2)))
    assert np.count_nonzero(recorder.episodes[-1].failed) == 1
    assert recorder.episodes[-1].winds is not None
    for episode in recorder.episodes:
        check_episode(episode)
