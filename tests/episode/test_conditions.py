"""Episodes under conditions: what befell robots is kept in the file, and replays bit for bit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Failures, Uniform
from mbn_marl.episode import EpisodeRecorder, check_episode, load_episode, save_episode
from mbn_marl.errors import EpisodeError
from tests.support.configurations import EVERYTHING

ALL: dict[str, Any] = {
    **{**EVERYTHING, "dynamics": "mixed", "gust": 0.1, "action_delay": 2, "position_noise": 2.0},
    **{"wind": (Uniform(0.1, 0.35), Uniform(0.0, 360.0)), "roi_radius": Uniform(5.0, 15.0)},
    **{"failures": Failures(rate=0.1, most=2), "random_starts": True, "max_steps": 15},
}
PARTS = ("positions", "visits", "terms", "winds", "headings", "failed")


@pytest.mark.slow
def test_what_befalls_robots_is_recorded_kept_and_replayed(tmp_path: Path) -> None:
    engine = BatchEngine("field_03", 3, seed=5, first_world=7, **ALL)
    with EpisodeRecorder(engine, world=1) as recorder:
        engine.reset()
        shots = []
        for _ in range(15):
            shots.append(engine.snapshot(1))
            engine.step(engine.sample_actions())
        shots.append(engine.snapshot(1))
        engine.step(engine.sample_actions())
    first, second = recorder.episodes
    assert (first.seed, first.world, first.number) == (5, 8, 0)
    assert (second.seed, second.world, second.number) == (5, 8, 1)
    path = save_episode(first, tmp_path / "all.json")
    loaded = load_episode(path)
    assert loaded.drawn == first.drawn and loaded.config == first.config
    assert {"wind_speed", "wind_angle", "roi_radius"} < loaded.drawn.keys()
    for name in PARTS:
        np.testing.assert_array_equal(getattr(loaded, name), getattr(first, name), name)
    assert loaded.steps == 15 and sum(shots[14].failed) == 2
    for step, shot in enumerate(shots[:15]):
        found = loaded.snapshot(step)
        assert (found.roi_radius, found.wind) == (shot.roi_radius, shot.wind)
        for name in ("positions", "headings", "failed"):
            assert np.array_equal(getattr(found, name), getattr(shot, name), equal_nan=True), name
    assert np.isnan(loaded.headings[:, 0]).all() and loaded.headings[-1, 1:].any()
    check_episode(loaded)
    check_episode(second)
    bent = loaded.headings.copy()
    bent[4, 1] += 1e-6
    moved = loaded.positions.copy()
    moved[4, 0, 0] = np.nextafter(moved[4, 0, 0], np.float32(1e9))
    for changes, place in (
        ({"headings": bent}, "headings: .*step 4 "),
        ({"positions": moved}, "positions: .*step 4 "),
        ({"winds": loaded.winds + np.eye(16, 2, -4)}, "winds: .*step 4 "),
        ({"failed": np.where(loaded.failed > 0, loaded.failed + 1, 0)}, "failed: "),
        ({"number": 1}, None),
    ):
        with pytest.raises(EpisodeError, match=place):
            check_episode(replace(loaded, **changes))
    content = json.loads(path.read_text())
    headings = {**content["headings"], "shape": [3, 16]}
    for name, value, problems in (
        ("headings", headings, 1),
        ("failed", [1, 99], 2),
        ("drawn", {"roi_radius": 5.0, "mass": 1.0}, 1),
    ):
        path.write_text(json.dumps({**content, name: value}))
        with pytest.raises(EpisodeError) as caught:
            load_episode(path)
        assert [problem.split(":")[0] for problem in caught.value.problems] == [name] * problems
