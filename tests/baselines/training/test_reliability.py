"""A full disk loses nothing, a folder has one process at a time, and links are refused."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from baselines.runs.files import RunError, alone, claim_folder
from baselines.training.train import train
from tests.support.runs import interrupted, small_config

# The disk


@contextmanager
def _files_up_to(size: int) -> Iterator[None]:
    """No file can grow beyond ``size`` bytes, as on a disk that is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("size", [0, 300, 3_000])
@pytest.mark.parametrize("name", ["mappo", "ppo"])
def test_a_full_disk_leaves_the_checkpoint_before(name: str, size: int, tmp_path: Path) -> None:
    whole = train(small_config(name), tmp_path / "whole")
    run = interrupted(small_config(name), tmp_path / "run")
    kept = run.checkpoint
    assert kept is not None
    before = {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()}
    with _files_up_to(size), pytest.raises(RunError, match=r"could not be written to \(.*large"):
        train(small_config(name), run.path, resume=True)
    assert run.checkpoint == kept
    assert {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()} == before
    resumed = train(small_config(name), run.path, resume=True)
    assert resumed.evaluation["stochastic"] == whole.evaluation["stochastic"]
    assert not list(run.path.glob(".*"))


# Locks


def test_the_second_process_is_told_of_the_first(tmp_path: Path) -> None:
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
    holder = rf"another mbn train \(process {first.pid} on .* since 20.* UTC\) is running here"
    with pytest.raises(RunError, match=holder), alone(tmp_path, "mbn compare"):
        pass
    first.kill()  # leaves its file, which holds nothing
    first.communicate()
    with alone(tmp_path, "mbn compare"):
        assert json.loads((tmp_path / ".lock").read_text())["pid"] == os.getpid()
    assert not list(tmp_path.iterdir())


def test_a_run_that_was_killed_before_it_began_can_be_started_again(tmp_path: Path) -> None:
    out = tmp_path / "run"
    (out / ".config.json.abc").mkdir(parents=True)
    (out / ".lock").touch()
    assert train(small_config("mappo"), out).finished
    assert not list(out.glob(".*"))


def test_a_folder_with_something_else_in_it_is_not_claimed(tmp_path: Path) -> None:
    (tmp_path / ".lock").touch()
    claim_folder(tmp_path)
    (tmp_path / ".hidden").touch()
    with pytest.raises(RunError, match="already exists"):
        claim_folder(tmp_path)
