"""``mbn replay``, ``render``, ``evaluate --record`` and ``fields``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from baselines.cli import main
from mbn_marl import load_field
from mbn_marl.config import make_config
from mbn_marl.episode import load_episode, play, save_episode
from mbn_marl.field import generate
from tests.baselines.conftest import Refusal

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("episodes") / "learned.json"
    assert main(["render", "zoo:field_03", "-o", str(path)]) == 0
    return path


def test_replay_writes_a_page_and_nothing_over_another(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = save_episode(
        play(load_field("field_03"), make_config({}), np.zeros((3, 3, 2)), source="waiting"),
        tmp_path / "waiting.json",
    )
    out = tmp_path / "page.html"
    episode = load_episode(recorded)
    assert (episode.outcome, episode.source, episode.seed) == ("success", "zoo:field_03", 0)
    assert episode.field == load_field("field_03") and episode.rois_visited == 6
    assert main(["replay", str(recorded), str(other), "-o", str(out)]) == 0
    assert "zoo:field_03: success" in capsys.readouterr().out
    text = out.read_text()
    assert f"waiting ({other})" in text
    assert "://" not in text.replace("http://www.w3.org/2000/svg", "")
    assert main(["replay", str(other), "-o", str(out)]) == 2
    assert "page.html" in capsys.readouterr().err
    assert out.read_text() == text
    assert main(["replay", str(other), "-o", str(out), "--force"]) == 0
    assert (tmp_path / "page.html.1").read_text() == text


def test_render_shows_a_recorded_episode(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, start in (("a.gif", b"GIF89a"), ("a.pdf", b"%PDF"), ("a.svg", b"<?xml")):
        assert main(["render", str(recorded), "-o", str(tmp_path / name)]) == 0
        assert (tmp_path / name).read_bytes().startswith(start)
    assert main(["render", str(recorded), "-o", str(tmp_path / "a.gif")]) == 2
    assert "a.gif" in capsys.readouterr().err
    assert main(["render", str(recorded), "--steps", "3", "-o", str(tmp_path / "b.gif")]) == 2
    foreign = tmp_path / "foreign.json"
    foreign.write_text('{"type": "other"}')
    assert main(["render", str(foreign), "-o", str(tmp_path / "b.gif")]) == 2
    assert "foreign.json" in capsys.readouterr().err
    assert not (tmp_path / "b.gif").exists()


def test_evaluate_records_its_best_median_and_worst(tmp_path: Path) -> None:
    source = ["random", "--field", "field_07"]
    out, results = tmp_path / "episodes", tmp_path / "results.json"
    command = ["evaluate", *source, "--episodes", "5", "--seed", "3", "--record", str(out)]
    assert main([*command, "--json", str(results)]) == 0
    returns = sorted(json.loads(results.read_text())["stochastic"]["per_episode"]["returns"])
    found = [load_episode(out / f"{name}.json") for name in ("worst", "median", "best")]
    assert [one.team_return for one in found] == [returns[0], returns[2], returns[4]]
    assert [one.source for one in found] == [
        f"random in field_07, {name}" for name in ("worst", "median", "best")
    ]
    assert main(command) == 2, "the folder is there already"


def test_fields_are_listed_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "fields.pdf"
    assert main(["fields", "field_03", "field_05", "--figure", str(out)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["field_03", "3", "6", "0", "4", "10,800", "17", "159,490"] in lines
    assert out.read_bytes().startswith(b"%PDF")
    assert main(["fields", "--figure", str(out)]) == 2
    assert sum("field_" in line for line in capsys.readouterr().out.splitlines()) == 10


def test_random_fields_are_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "fields"
    words = ["fields", "--generate", "farm", "concave", "--seed", "7", "--count", "2"]
    assert main([*words, "--robots", "4", "--size", "150", "160", "-o", str(out)]) == 0
    assert "4 written to" in capsys.readouterr().out
    made = [load_field(path) for path in sorted(out.iterdir())]
    assert [field.name for field in made] == ["concave-7", "concave-8", "farm-7", "farm-8"]
    assert made[3] == generate("farm", 8, robots=4, size=(150, 160))
    assert main([*words, "-o", str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    assert load_field(out / "farm-8.yaml") == made[3], "nothing is written over"


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
