"""Evaluation of a trained policy in wind."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from baselines.cli import main
from baselines.evaluation import wind as wind_module
from baselines.evaluation.evaluate import is_one_episode
from baselines.evaluation.intervals import Interval, share_interval
from baselines.evaluation.wind import evaluate_in_wind, parse_speeds
from baselines.policies.classical import make_classical
from baselines.policies.policy import Policy, RandomPolicy
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field
from tests.support.runs import TinyRuns

SQUARE = Field(
    vertices=[(0, 0), (200, 0), (200, 200), (0, 200)],
    rois=[(130, 100)],
    starts=[(100, 100), (20, 100)],
)


class Still(Policy):
    observes = "state"

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        return np.zeros((len(seen), 2, 2), np.float32)


class Blind(Still):
    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        if not deterministic:
            return torch.rand((len(seen), 2, 2)).numpy()
        return np.full((len(seen), 2, 2), 0.3 / len(seen), np.float32)


def test_speeds() -> None:
    for text, speeds in (
        ("0", [0.0]),
        ("0, 0.25,1", [0.0, 0.25, 1.0]),
        ("0,0.1,..,0.5", [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]),
        ("0.4,0.3,..,0.1,0", [0.4, 0.3, 0.2, 0.1, 0.0]),
    ):
        assert parse_speeds(text) == speeds
    for text, place in (
        *(("", "''"), ("0,fast", "'fast'"), ("-0.1", "'-0.1'"), ("0,inf", "'inf'")),
        *(("nan", "'nan'"), ("0,..,0.5", "..,0.5;"), ("0,0.1,..", "'..'")),
        *(("0,0.2,..,0.5", "..,0.5;"), ("0,0,..,0.5", "..,0.5;"), ("0,0.1,..,0", "..,0;")),
        *(("0,1,..,5000", "..,5000;"), ("0,0.1,..,inf", "..,inf;")),
        *((",".join(["0"] * 101), "100 speeds"), ("0,1,..,100", "..,100;")),
    ):
        with pytest.raises(ConfigError) as caught:
            parse_speeds(text)
        assert place in str(caught.value), text


@pytest.mark.slow
def test_wind_carries_the_robots() -> None:
    # Along x each step adds the speed v to the velocity: after t steps v t (t + 1) / 2. The ROI's
    # edge is 20 units away: v = 0.5 gets there at t = 9 (22.5), v = 1 at t = 6 (21).
    rows, drawn = evaluate_in_wind(Still(), SQUARE, {}, [0.5, 1.0], 0.0, episodes=2, seed=1)
    assert [row["wind_speed"] for row in rows] == [0.5, 0.5, 1.0, 1.0]
    assert [row["deterministic"] for row in rows] == [False, True, False, True]
    assert [row["makespan"] for row in rows] == [9.0, 9.0, 6.0, 6.0]
    assert {row["wind_angle"] for row in rows} == {0.0}
    assert {name: episode.steps for name, episode in drawn.items()} == {"wind 0.5": 9, "wind 1": 6}


@pytest.mark.slow
@pytest.mark.parametrize("random_starts", [False, True])
def test_the_episode_that_is_drawn_was_evaluated(random_starts: bool) -> None:
    settings = {"random_starts": random_starts, "max_steps": 30}
    rows, drawn = evaluate_in_wind(Blind(), SQUARE, settings, [0.1, 0.2], 90.0, episodes=3, seed=4)
    for row, episode in zip(rows[1::2], drawn.values(), strict=True):
        assert episode.team_return == row["per_episode"]["returns"][0]
        assert episode.snapshot(1).wind == pytest.approx((0.0, row["wind_speed"]))


@pytest.mark.slow
def test_a_deterministic_episode_is_run_once_and_has_no_interval() -> None:
    rows, _ = evaluate_in_wind(Blind(), SQUARE, {"max_steps": 9}, [0.1], 90.0, episodes=5, seed=4)
    sampled, mean = rows
    assert (sampled["episodes"], mean["episodes"]) == (5, 1)
    assert mean["return_interval"] is None
    assert sampled["success_interval"]["high"] == pytest.approx(0.4345, abs=2e-4)
    failing, random = {"failures": {"at": {0: 3}}}, {"failures": {"at": {0: 3}, "rate": 0.1}}
    greedy = make_classical("greedy", SQUARE, {})
    for policy, settings, deterministic, one in (
        (Blind(), {}, True, True),
        (Blind(), {}, False, False),
        (Blind(), {"random_starts": True}, True, False),
        (Blind(), failing, True, True),
        (Blind(), random, True, False),
        (RandomPolicy(), {}, True, False),
        (greedy, {}, False, True),
    ):
        assert is_one_episode(policy, settings, deterministic=deterministic) is one


def test_share_interval_is_wilsons() -> None:
    # z = 1.96: centre (8 + z^2 / 2) / (10 + z^2) = 0.7168, half width 0.2267
    interval = share_interval([True] * 8 + [False] * 2)
    assert interval.mean == 0.8
    assert interval.low == pytest.approx(0.4902, abs=2e-4)
    assert interval.high == pytest.approx(0.9433, abs=2e-4)
    assert share_interval([True]) == Interval(1.0, pytest.approx(0.2065, abs=2e-4), 1.0)


@pytest.mark.slow
def test_evaluate_in_wind_from_the_command_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tiny_runs: TinyRuns,
) -> None:
    run = tmp_path / "run"
    shutil.copytree(tiny_runs.finished("ppo").path, run)
    wind = ["--wind-speeds", "0,0.2,..,0.4", "--wind-angle", "30", "--episodes", "2"]
    assert main(["evaluate", str(run), *wind]) == 0
    printed = capsys.readouterr().out
    assert "wind at 30 degrees" in printed and "makespan" in printed
    result = json.loads((run / "wind.json").read_text())
    assert [row["wind_speed"] for row in result["results"]] == [0.0, 0.0, 0.2, 0.2, 0.4, 0.4]
    assert [row["episodes"] for row in result["results"]] == [2] * 6
    assert (run / "wind.png").read_bytes()[:4] == b"\x89PNG"
    again = ["evaluate", str(run), "--wind-speeds", "0.1", "--episodes", "1"]

    def fail(*_: Any, **__: Any) -> None:
        raise OSError("no space is left")

    def refused(*words: str) -> str:
        assert main(["evaluate", str(run), *words]) == 2
        return capsys.readouterr().err

    monkeypatch.setattr(wind_module, "write_panels", fail)
    before = (run / "wind.json").read_text()
    assert "figure: " in refused("--figure", "x.png")
    assert "wind.json" in refused(*again[2:])
    assert (run / "wind.json").read_text() == before
    assert "no space is left" in refused(*again[2:], "--force")
    assert (run / "wind.json").read_text() != before, "what was evaluated is not lost"
    assert (run / "wind.json.1").read_text() == before
