"""Run folders: what they hold, what they refuse, and one process at a time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from baselines.runs.files import RunError, alone, claim_folder, read_json, write_json
from baselines.runs.folder import RunFolder
from baselines.training.config import TrainConfig
from baselines.training.run_logger import Report
from mbn_marl.errors import ConfigError, MbnError
from mbn_marl.field import load_field


def test_a_folder_is_claimed_without_loss(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    for content in ("first", "second"):
        assert claim_folder(folder, force=True) == folder
        (folder / "result").write_text(content)
    with pytest.raises(RunError, match=str(folder)):
        claim_folder(folder)
    assert (folder / "result").read_text() == "second"
    claim_folder(folder, force=True)
    assert not list(folder.iterdir())
    assert (tmp_path / "run.1" / "result").read_text() == "first"
    assert (tmp_path / "run.2" / "result").read_text() == "second"
    for name in (".lock", ".config.json.abc"):  # as a process leaves it that is killed at once
        (folder / name).touch()
    claim_folder(folder)
    (folder / ".hidden").touch()
    with pytest.raises(RunError, match=str(folder)):
        claim_folder(folder)
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="file"):
        claim_folder(tmp_path / "file", force=True)
    inner = folder / "inner"
    inner.mkdir()
    with alone(inner, "mbn train"), pytest.raises(RunError, match="inner"):
        claim_folder(folder, force=True)
    claim_folder(folder, force=True)
    assert (tmp_path / "run.3" / "inner").is_dir()


def test_json_is_written_whole_and_errors_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "value.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError):
        write_json(path, {"a": float("nan")})
    assert read_json(path) == {"a": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["value.json"]
    (tmp_path / "bad.json").write_text("{")
    for name in ("missing.json", "bad.json"):
        with pytest.raises(RunError, match=name):
            read_json(tmp_path / name)


def test_a_second_process_is_refused(tmp_path: Path) -> None:
    code = (
        "import sys, pathlib; from baselines.runs.files import alone\n"
        f"with alone(pathlib.Path({str(tmp_path)!r}), 'mbn train'):\n"
        "    print('on', flush=True)\n"
        "    sys.stdin.read()"
    )
    first = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert first.stdout is not None and first.stdout.readline() == "on\n"
    with (
        pytest.raises(RunError, match=rf"another mbn train \(process {first.pid} on .* since 20"),
        alone(tmp_path, "mbn compare"),
    ):
        pass
    first.kill()  # leaves its file, which holds nothing
    first.communicate()
    with alone(tmp_path, "mbn compare"):
        assert json.loads((tmp_path / ".lock").read_text())["pid"] == os.getpid()
    assert not list(tmp_path.iterdir())


def test_a_run_records_field_command_versions_and_progress(tmp_path: Path) -> None:
    field = load_field("field_07")
    run = RunFolder.create(tmp_path / "run", {"algorithm": "ppo"}, field, "mbn train it")
    assert run.field == field
    assert (run.path / "command.txt").read_text() == "mbn train it\n"
    assert read_json(run.path / "versions.json")["packages"]["torch"]
    run.append_progress({"env_steps": 8.0, "loss": 0.25})
    run.append_progress({"env_steps": 16.0, "loss": float("nan")})
    with pytest.raises(ValueError):
        run.append_progress({"env_steps": 24.0})
    assert run.progress.read_text().split() == ["env_steps,loss", "8,0.25", "16,nan"]
    with pytest.raises(RunError, match=str(tmp_path)):
        RunFolder.open(tmp_path)


def test_wrong_requests_are_refused_by_place() -> None:
    with pytest.raises(ConfigError) as caught:
        TrainConfig("ppo", "field_03", seed=-1, steps=0)
    assert [line.split(":")[0] for line in caught.value.problems] == ["seed", "steps"]
    for algorithm, field, place in (("sac", "field_03", "sac"), ("ppo", "field_99", "field_99")):
        with pytest.raises(MbnError, match=place):
            TrainConfig(algorithm, field)


def test_the_speed_of_a_slow_learner_is_shown() -> None:
    speeds = (42.4, 9_960.0, 123_456.0)
    words = [Report("run", 1, False, speed, None, None).speed for speed in speeds]
    assert words == ["  42/s", "9,960/s", "123k/s"]
