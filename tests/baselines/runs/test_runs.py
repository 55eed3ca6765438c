"""Run folders: what they hold, what they refuse, and one process at a time."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from baselines.runs.files import RunError, alone, claim_folder, read_json, write_json
from baselines.runs.folder import RunFolder
from baselines.training.run_logger import Report
from baselines.training.train import train
from mbn_marl.field import load_field
from tests.support.runs import small_config


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


@pytest.mark.parametrize("code", ["ENOSYS", "ENOLCK", "EOPNOTSUPP"])
def test_a_drive_without_locks_is_used(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flock(*_: Any) -> None:
        raise OSError(getattr(errno, code), code)

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.warns(UserWarning, match="lock"), alone(tmp_path, "mbn train"):
        pass
    assert not list(tmp_path.iterdir())


def test_a_name_that_is_not_text_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="UTF-8"):
        claim_folder(tmp_path / os.fsdecode(b"a\xff"))
    with pytest.raises(RunError, match="UTF-8"):
        train(small_config("ppo"), tmp_path / "run", command=os.fsdecode(b"mbn \xff"))
    assert not list(tmp_path.iterdir())


def test_only_numbers_are_checkpoints(tmp_path: Path) -> None:
    for name in ("000000000100", "12abc", "000000000200.bak", "²"):
        (tmp_path / "checkpoints" / name).mkdir(parents=True)
    (tmp_path / "checkpoints" / "300").touch()
    run = RunFolder(tmp_path)
    assert run.saved_steps == 100
    (tmp_path / "config.json").touch()
    with run.new_checkpoint(400):
        pass
    left = {path.name for path in (tmp_path / "checkpoints").iterdir()}
    assert left == {"000000000400", "12abc", "000000000200.bak", "²", "300"}


def test_a_run_killed_before_its_first_file_begins(tmp_path: Path) -> None:
    for name in (".lock", ".config.json.abc"):
        (tmp_path / name).touch()
    assert train(small_config("ppo"), tmp_path, resume=True).finished


def test_a_run_whose_folder_is_deleted_ends(tmp_path: Path) -> None:
    out = tmp_path / "run"

    def delete(report: Report) -> None:
        assert not report.finished
        shutil.rmtree(out)

    with pytest.raises(RunError, match=str(out)):
        train(small_config("mappo"), out, listener=delete)
    assert not (out / "evaluation.json").exists()


def test_a_run_records_field_command_versions_and_progress(tmp_path: Path) -> None:
    field = load_field("field_07")
    run = RunFolder.create(tmp_path / "run", {"algorithm": "ppo"}, field, "mbn train it")
    assert run.field == field
    assert (run.path / "command.txt").read_text() == "mbn train it\n"
    assert read_json(run.path / "versions.json")["packages"]["torch"]
    run.append_progress({"env_steps": 8.0, "loss": 0.25})
    run.append_progress({"env_steps": 16.0, "loss": float("nan")})
    assert run.progress.read_text().split() == ["env_steps,loss", "8,0.25", "16,nan"]
    with pytest.raises(RunError, match=str(tmp_path)):
        RunFolder.open(tmp_path)
