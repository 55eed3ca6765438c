"""Damaged checkpoints and policies are named, and files that others made run no code."""

from __future__ import annotations

import io
import os
import pickle
import shutil
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from baselines.cli import main
from baselines.policies.load import load_trained
from baselines.runs.checksums import check
from baselines.runs.files import RunError, read_arrays, seal, write_arrays
from baselines.runs.folder import RunFolder
from baselines.training.train import train
from mbn_marl.errors import DamageError, MbnError
from tests.support.runs import TinyRuns, small_config


def _flip(path: Path) -> None:
    """Change a bit in the middle of a file."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mappo", "ppo"])
def test_every_file_of_a_policy_and_a_checkpoint_is_checked(
    name: str, tmp_path: Path, tiny_runs: TinyRuns
) -> None:
    copy = tmp_path / "finished"
    shutil.copytree(tiny_runs.finished(name).path, copy)
    run = RunFolder.open(copy)
    for path in run.policy.iterdir():
        if path.name != "learner.safetensors":  # which runs that begin with this one read
            whole = path.read_bytes()
            _flip(path)
            with pytest.raises(DamageError, match=path.name):
                load_trained(run)
            path.write_bytes(whole)
    load_trained(run)
    stopped: Any = tiny_runs.stopped(name, tmp_path / "stopped")
    read = "**/*" if name == "ppo" else "*"  # mappo's policy is in the learner's file
    for path in filter(Path.is_file, stopped.checkpoint.glob(read)):
        whole = path.read_bytes()
        _flip(path)
        with pytest.raises(DamageError):
            train(small_config(name), stopped.path, resume=True)
        path.write_bytes(whole)
    stopped.progress.write_text("env_steps\n")  # it ends before the checkpoint
    with pytest.raises(RunError, match=r"progress\.csv"):
        train(small_config(name), stopped.path, resume=True)


def test_a_damaged_list_is_named(tmp_path: Path) -> None:
    by_hand = tmp_path / "by_hand"
    by_hand.write_text("a")
    check(by_hand)
    seal(tmp_path)
    (tmp_path / "later").write_text("a")
    check(tmp_path / "later")
    for content in ("", "[]", '{"a": {}}', '{"sha256": []}', "[" * 100_000):
        (tmp_path / "checksums.json").write_text(content)
        with pytest.raises(DamageError, match=r"checksums\.json"):
            check(by_hand)


class Evil:
    """Unpickling it makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.path,)


@pytest.mark.slow
def test_no_pickle_is_loaded(tmp_path: Path, tiny_runs: TinyRuns) -> None:
    trap, path = tmp_path / "pwned", tmp_path / "arrays.npz"
    evil = pickle.dumps(Evil(trap))
    np.savez(path, allow_pickle=True, a=np.array([Evil(trap)], object))
    with pytest.raises(RunError, match=r"arrays\.npz"):
        read_arrays(path)
    path.write_bytes(evil)
    with pytest.raises(RunError, match=r"arrays\.npz"):
        read_arrays(path)
    for name in ("mappo", "ppo"):
        run = tiny_runs.stopped(name, tmp_path / name)
        files = [path.relative_to(run.path) for path in run.path.rglob("*.*") if path.is_file()]
        assert {".safetensors", ".npz", ".json", ".yaml", ".csv"} <= {f.suffix for f in files}
        for file in files:
            shutil.rmtree(run.path)
            tiny_runs.stopped(name, run.path)
            for listed in run.path.rglob("checksums.json"):
                listed.unlink()
            (run.path / file).write_bytes(evil)
            main(["evaluate", str(run.path), "--episodes", "1"])
            with suppress(MbnError):
                train(small_config(name), run.path, resume=True)
    assert not trap.exists()


def test_an_archive_that_leads_out_is_refused(tmp_path: Path) -> None:
    path, array = tmp_path / "arrays.npz", io.BytesIO()
    np.save(array, np.zeros(1))
    for name in ("../data", "/tmp/data", "a/../../b", "..\\data", "C:data", "a.npy"):
        write_arrays(path, {"b": np.zeros(3)})
        assert [*read_arrays(path)] == ["b"]
        member = zipfile.ZipInfo(name)
        if name == "a.npy":
            member.external_attr = 0o120777 << 16  # a link
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(member, array.getvalue())
        with pytest.raises(RunError, match=r"arrays\.npz"):
            read_arrays(path)


def test_a_link_in_a_run_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").touch()
    for place in ("progress.csv", "policy/policy.json", "tensorboard/events"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).symlink_to(tmp_path / "mine")
        with pytest.raises(RunError, match=place):
            RunFolder.open(tmp_path)
        (tmp_path / place).unlink()
    RunFolder.open(tmp_path)
