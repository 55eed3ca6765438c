"""Damaged checkpoints and policies are named, and what others made runs no code."""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from baselines.cli import main
from baselines.evaluation.policy import load_trained
from baselines.runs.checksums import check
from baselines.runs.files import RunError, read_arrays, seal, write_arrays
from baselines.runs.folder import RunFolder
from baselines.training.train import train
from mbn_marl.errors import DamageError, MbnError
from tests.support.runs import interrupted, small_config


def _flip(path: Path) -> None:
    """Change a bit in the middle of a file."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.fixture(scope="module", params=["mappo", "ppo"])
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    out = tmp_path_factory.mktemp(request.param) / "run"
    return train(small_config(request.param), out)


@pytest.fixture(scope="module", params=["mappo", "ppo"])
def stopped(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    out = tmp_path_factory.mktemp(request.param) / "run"
    return interrupted(small_config(request.param), out)


def test_every_file_of_a_policy_is_checked(finished: RunFolder, tmp_path: Path) -> None:
    read = [path for path in finished.policy.iterdir() if path.name != "learner.safetensors"]
    assert len(read) == 3  # the learner's file is read by runs that begin with this one
    for path in read:
        copy = tmp_path / path.name
        shutil.copytree(finished.path, copy)
        load_trained(RunFolder.open(copy))
        _flip(copy / "policy" / path.name)
        with pytest.raises(DamageError, match=path.name.replace(".", r"\.")):
            load_trained(RunFolder.open(copy))


def test_every_file_of_a_checkpoint_is_checked(stopped: RunFolder, tmp_path: Path) -> None:
    assert stopped.checkpoint is not None
    config = small_config(stopped.config["algorithm"])
    read = "**/*" if config.algorithm == "ppo" else "*"  # mappo's policy is in the learner's file
    files = [path for path in stopped.checkpoint.glob(read) if path.is_file()]
    for number, path in enumerate(files):
        copy = tmp_path / str(number)
        shutil.copytree(stopped.path, copy)
        _flip(copy / path.relative_to(stopped.path))
        with pytest.raises(DamageError):
            train(config, copy, resume=True)
        shutil.copy(path, copy / path.relative_to(stopped.path))
        if number == 0:
            assert train(config, copy, resume=True).finished


def test_a_table_of_progress_that_ends_before_its_checkpoint_is_named(
    stopped: RunFolder, tmp_path: Path
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(stopped.path, copy)
    (copy / "progress.csv").write_text("env_steps\n")
    with pytest.raises(RunError, match=r"progress\.csv"):
        train(small_config(stopped.config["algorithm"]), copy, resume=True)


def test_what_is_not_listed_is_not_checked(tmp_path: Path) -> None:
    by_hand = tmp_path / "by_hand"
    by_hand.write_text("a")
    check(by_hand)
    (tmp_path / ".hidden").write_text("a")
    seal(tmp_path)
    assert [*json.loads((tmp_path / "checksums.json").read_text())["sha256"]] == ["by_hand"]
    (tmp_path / "later").write_text("a")
    check(tmp_path / "later")
    by_hand.write_text("b")
    with pytest.raises(DamageError, match=r"by_hand is damaged.*remove its line"):
        check(by_hand)
    for content in ("", "[]", '{"a": {}}', '{"sha256": []}', "[" * 100_000):
        (tmp_path / "checksums.json").write_text(content)
        with pytest.raises(DamageError, match=r"checksums\.json"):
            check(by_hand)


# What someone else made


class Evil:
    """Unpickling it makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.path,)


@pytest.fixture
def evil(tmp_path: Path) -> Iterator[bytes]:
    """A pickle that must not be loaded."""
    yield pickle.dumps(Evil(tmp_path / "pwned"))
    assert not (tmp_path / "pwned").exists()


def test_no_pickle_is_loaded_from_arrays_and_weights(evil: bytes, tmp_path: Path) -> None:
    path = tmp_path / "arrays.npz"
    np.savez(path, allow_pickle=True, a=np.array([Evil(tmp_path / "pwned")], object))
    with pytest.raises(RunError, match=r"arrays\.npz cannot be read"):
        read_arrays(path)
    path.write_bytes(evil)
    with pytest.raises(RunError, match=r"arrays\.npz"):
        read_arrays(path)


@pytest.mark.parametrize("algorithm", ["mappo", "ppo"])
def test_no_pickle_is_loaded_from_a_run(algorithm: str, evil: bytes, tmp_path: Path) -> None:
    config = small_config(algorithm)
    run, whole = interrupted(config, tmp_path / "run"), tmp_path / "whole"
    for path in run.path.rglob("checksums.json"):
        path.unlink()
    shutil.copytree(run.path, whole)
    files = [path for path in run.path.rglob("*.*") if path.is_file()]
    assert {".safetensors", ".npz", ".json", ".yaml", ".csv", ".txt"} <= {f.suffix for f in files}
    for path in files:
        path.write_bytes(evil)
        main(["evaluate", str(run.path), "--episodes", "1"])
        with suppress(MbnError):
            train(config, run.path, resume=True)
        shutil.rmtree(run.path)
        shutil.copytree(whole, run.path)


@pytest.mark.parametrize("name", ["../data", "/tmp/data", "a/../../b", "..\\data", "C:data"])
def test_an_archive_that_leads_out_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / "arrays.npz"
    write_arrays(path, {"a": np.zeros(3)})
    assert [*read_arrays(path)] == ["a"]
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(zipfile.ZipInfo(name), _npy())
    with pytest.raises(RunError, match="leads out of the archive"):
        read_arrays(path)


def test_a_link_in_an_archive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "arrays.npz"
    member = zipfile.ZipInfo("a.npy")
    member.external_attr = 0o120777 << 16
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(member, "/etc/passwd")
    with pytest.raises(RunError, match="leads out of the archive"):
        read_arrays(path)


def _npy() -> bytes:
    file = io.BytesIO()
    np.save(file, np.zeros(1))
    return file.getvalue()


@pytest.mark.parametrize("place", ["progress.csv", "policy/policy.json", "tensorboard/events"])
def test_a_link_in_a_run_folder_is_refused(place: str, finished: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(finished.path, tmp_path / "run")
    (tmp_path / "run" / place).unlink(missing_ok=True)
    (tmp_path / "run" / place).symlink_to(tmp_path / "mine")
    with pytest.raises(RunError, match=f"{place} is a link"):
        RunFolder.open(tmp_path / "run")
