"""Commands name a policy, its field and the weather in one way, and say no in one way."""

from __future__ import annotations

from pathlib import Path

import pytest

from baselines.cli import main
from mbn_marl.episode import load_episode
from tests.baselines.conftest import Refusal

pytestmark = pytest.mark.slow

OWN = """
import numpy as np

class Turns:
    def __init__(self, field):
        self.settings = {"wind": (0.2, 90.0)}

    def act(self, seen, deterministic=True):
        return np.ones((*seen.shape[:2], 2), np.float32)
"""
COMMANDS = {
    "render": ["-o", "a.json", "--steps", "1"],
    "evaluate": ["--episodes", "1", "--record", "records"],
    "deploy": ["--sim", "plane"],
    "export": ["-o", "x.npz"],
    "benchmark": [],
    "watch": [],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_an_unknown_policy_is_answered_with_a_known_one(command: str, refusal: Refusal) -> None:
    fields = [] if command == "benchmark" else ["--field", "field_03"]
    error = refusal([command, "greddy", *fields, *COMMANDS[command]])
    assert "greddy: unknown policy (did you mean greedy?)" in error


def test_episodes_are_of_the_policy_the_field_and_the_wind_that_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "turning.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    source = ["turning:Turns", "--field", "field_05"]
    for asked, wind in (([], (0.2, 90.0)), (["--wind", "0.1", "30"], (0.1, 30.0))):
        for command, path in (("render", "a.json"), ("evaluate", "records/best.json")):
            assert main([command, *source, *asked, *COMMANDS[command], "--force"]) == 0
            episode = load_episode(path)
            assert (episode.field.name, episode.config.wind) == ("field_05", wind)
            assert "turning:Turns" in episode.source and (wind[0] == 0.2 or "30" in episode.source)
    windy = ["--condition", "windy", *COMMANDS["render"], "--force"]
    assert main(["render", "greedy", "--field", "field_03", *windy]) == 0
    assert "windy" in load_episode("a.json").source


def test_a_policy_of_the_zoo_is_taken_to_another_field(
    refusal: Refusal, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere = ["evaluate", "zoo:field_03", "--field"]
    assert main([*elsewhere, "field_04", "--episodes", "1"]) == 0
    assert "zoo:field_03 in field_04" in capsys.readouterr().out
    assert "greedy --field field_03" in refusal(["evaluate", "field_03"])
