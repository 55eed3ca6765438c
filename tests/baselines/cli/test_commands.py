"""The command line: what it prints, what it writes, and how it says no."""

from __future__ import annotations

import csv
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from baselines.cli.main import main, read_command
from tests.baselines.conftest import Refusal

CATALOGUE = Path(__file__).parents[3] / "envs_catalog"
TINY = ("--steps", "1", "--evaluate-every", "4096", "--episodes", "2")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of one update."""
    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(["train", "ippo", "field_03", *TINY, "--seed", "7", "--out", str(out)]) == 0
    return out


def test_fields_lists_the_catalogue(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fields"]) == 0
    lines = capsys.readouterr().out.splitlines()
    row = next(line for line in lines if "field_03" in line)
    assert row.split() == ["field_03", "3", "6", "0", "4", "10,800", "17", "159,490"]
    assert sum("field_" in line for line in lines) == 10


def test_train_records_the_run(run: Path) -> None:
    config = json.loads((run / "config.json").read_text())
    assert (config["algorithm"], config["field"], config["seed"]) == ("ippo", "field_03", 7)
    assert config["environment"]["max_steps"] == 1000
    assert config["hyperparameters"]["critic"] == "independent"
    command = (run / "command.txt").read_text()
    assert command == f"mbn train ippo field_03 {' '.join(TINY)} --seed 7 --out {run}\n"
    with (run / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    # One rollout: 128 worlds, 64 decisions, each at first of four steps.
    assert [row["env_steps"] for row in rows] == ["32768"]
    final = json.loads((run / "evaluation.json").read_text())
    assert len(final["stochastic"]["per_episode"]["returns"]) == 2
    assert (run / "policy" / "policy.safetensors").is_file()


def test_train_does_not_overwrite(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (run / "evaluation.json").read_text()
    assert main(["train", "ippo", "field_03", *TINY, "--out", str(run)]) == 2
    assert "--force" in capsys.readouterr().err
    assert (run / "evaluation.json").read_text() == before


def test_evaluate_repeats_the_recorded_evaluation(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "result.json"
    assert main(["evaluate", str(run), "--episodes", "2", "--json", str(out)]) == 0
    result = json.loads(out.read_text())
    recorded = json.loads((run / "evaluation.json").read_text())
    assert result["stochastic"] == recorded["stochastic"]
    assert result["deterministic"] == recorded["deterministic"]
    assert main(["evaluate", str(run), "--episodes", "1", "--json", str(out)]) == 2
    assert json.loads(out.read_text()) == result, "nothing is written over"


def test_render_writes_what_the_name_asks_for(run: Path, tmp_path: Path) -> None:
    gif, png = tmp_path / "episode.gif", tmp_path / "paths.png"
    assert main(["render", str(run), "-o", str(gif), "--steps", "3"]) == 0
    assert gif.read_bytes()[:6] == b"GIF89a"
    assert main(["render", "field_07", "-o", str(png), "--steps", "3"]) == 0
    assert png.read_bytes()[:4] == b"\x89PNG"


def test_compare_writes_table_and_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "comparison"
    chosen = ("--algos", "ppo", "mappo", "--fields", "field_03", "--seeds", "0", "1")
    assert main(["compare", *chosen, *TINY, "--processes", "2", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "ppo" in printed and "mappo" in printed
    rows = json.loads((out / "comparison.json").read_text())["rows"]
    assert [(row["algorithm"], row["seeds"]) for row in rows] == [("ppo", 2), ("mappo", 2)]
    finals = [
        json.loads((out / f"ppo-N-field_03-seed{seed}" / "evaluation.json").read_text())
        for seed in (0, 1)
    ]
    mean = sum(final["stochastic"]["return_mean"] for final in finals) / 2
    assert rows[0]["return_mean"] == pytest.approx(mean)
    with (out / "table.csv").open(newline="") as file:
        assert [row["algorithm"] for row in csv.DictReader(file)] == ["ppo", "mappo"]
    assert {path.name for path in out.iterdir() if path.is_file()} == {
        "aggregates.png",
        "command.txt",
        "comparison.json",
        "comparison.md",
        "config.json",
        "episode_field_03.gif",
        "improvement.png",
        "learning_curves_field_03.png",
        "profiles.png",
        "table.csv",
        "trajectories_field_03.png",
        "versions.json",
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["train", "sac", "field_03"],
            "sac: unknown algorithm; known: a2c, ppo, trpo, ars, crossq, tqc, mappo, ippo",
        ),
        (["train", "ppo", "field_00"], "known: field_01"),
        (["train", "ppo", "field_03", "--steps", "0"], "steps: must be at least 1"),
        (["compare", "--algos", "ppo", "ppo"], "algorithms: ppo is given twice"),
        (["compare", "--fields", "field_03", str(CATALOGUE / "field_03.yaml")], "the same name"),
        (["compare", "--seeds", "0", "-1"], "seed: must be at least 0"),
        (["compare", "--processes", "0"], "processes: at least 1"),
        (["compare", "--algos", "ppo:D"], "setting: Input should be 'A', 'B' or 'N' (got 'D')"),
        (["compare", "--force", "--resume"], "force and resume: allowed is one of them"),
        (["compare", "--resume", "--out", "none"], "none is not the folder of a comparison"),
        (["train", "ippo", "field_03", "--set", "gamma"], "gamma: must be NAME=VALUE"),
        (["evaluate", "greedy"], "mbn evaluate greedy --field field_03"),
        (["evaluate", "nowhere"], "nowhere is not a run folder"),
        (["render", "field_03", "-o", "picture.bmp"], ".png"),
        (["replay", "none.json", "-o", "a.html"], "error: none.json: No such file or directory"),
    ],
)
def test_wrong_input_is_one_clear_message(
    arguments: list[str], message: str, tmp_path: Path, refusal: Refusal
) -> None:
    assert message in refusal(arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "places"),
    [
        (
            ["train", "pppo", "feld_03", "--seed", "-1", "--label", "a/b"],
            ["seed: ", "label: ", "pppo: ", "feld_03: "],
        ),
        (
            ["compare", "--algos", "pppo", "tqqc", "--fields", "feld_03", "--seeds", "0", "0"],
            ["seeds: ", "pppo: ", "tqqc: ", "feld_03: "],
        ),
        (
            ["train", "ippo", "field_03", "--set", "gama=1", "clip=x", "environment.max_step=5"],
            ["gama: ", "clip: ", "max_step: unknown name (did you mean max_steps?)"],
        ),
        (["train", "ippo", "field_03", "--set", "gamma", "=3"], ["gamma: must", "=3: must"]),
        (["train", "ppo", "field_03", "--set", "model=3"], ["model: "]),
        (["train", "ppo", "field_03", "--set", "model=null"], ["model: "]),
        (["train", "ppo", "field_03", "--set", "model.policy=3"], ["model.policy: "]),
        (
            ["train", "ippo", "field_03", "--set", "task=3", "algorithm=4"],
            ["task: ", "algorithm: "],
        ),
        (["train", "ppo", "field_03", "--set", "environment=3"], ["environment: "]),
    ],
)
def test_all_problems_are_named_at_once(
    arguments: list[str],
    places: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n  - ") == len(places)
    assert all(place in error for place in places), error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("setting", "seed", "steps"), [("A", 33, 5_000_000), ("N", 0, 655_360)])
def test_a_setting_has_its_own_seed_and_budget(setting: str, seed: int, steps: int) -> None:
    command = read_command(["train", "ppo", "field_03", "--setting", setting])
    assert (command.config.seed, command.config.steps) == (seed, steps)
    asked = read_command(["train", "ppo", "field_03", "--setting", setting, "--steps", "1e3"])
    assert (asked.config.seed, asked.config.steps) == (seed, 1000)
    assert read_command(shlex.split(asked.config.command)[1:]) == asked


def _wait_for(condition: Callable[[], bool], seconds: float = 120.0) -> bool:
    """Whether ``condition`` came true in time."""
    deadline = time.monotonic() + seconds
    while not (met := condition()) and time.monotonic() < deadline:
        time.sleep(0.1)
    return met


def _group_exists(group: int) -> bool:
    """Whether any process of the group is alive."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_stopped_comparison_leaves_no_process_behind(tmp_path: Path) -> None:
    out = tmp_path / "comparison"
    chosen = ("compare", "--algos", "ppo", "--processes", "2", "--out", str(out))
    endless = ("--steps", "100000000", "--evaluate-every", "100000000")
    process = subprocess.Popen(
        [sys.executable, "-m", "mbn_marl", *chosen, *endless],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )
    try:
        progress = out / "ppo-N-field_03-seed0" / "progress.csv"
        assert _wait_for(progress.exists)
        process.send_signal(signal.SIGTERM)
        _, error = process.communicate(timeout=60)
        assert process.returncode == 130
        assert "Traceback" not in error
        assert _wait_for(lambda: not _group_exists(process.pid))
    finally:
        process.kill()
