"""Run folders: what they hold, what they refuse, and one process at a time."""

import errno
import fcntl
import json
import os
import pickle
import shutil
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from baselines.policies.load import load_trained
from baselines.runs.files import RunError, alone, claim_folder, read_arrays, read_json, write_arrays
from baselines.runs.folder import RunFolder
from baselines.runs.tensors import read_tensors, write_tensors
from baselines.training.run_logger import BEST
from baselines.training.train import train
from mbn_marl.errors import MbnError
from mbn_marl.field import load_field
from tests.support.runs import small_config


def test_a_folder_is_claimed_without_loss(tmp_path, monkeypatch):
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
    with pytest.raises(MbnError, match="UTF-8"):
        claim_folder(tmp_path / "\udcff")
    monkeypatch.chdir(folder)
    with pytest.raises(MbnError, match="aside"):
        claim_folder(Path(), force=True)
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="file"):
        claim_folder(tmp_path / "file", force=True)
    inner = folder / "inner"
    inner.mkdir()
    with alone(inner, "mbn train"), pytest.raises(RunError, match="inner"):
        claim_folder(folder, force=True)
    claim_folder(folder, force=True)
    assert (tmp_path / "run.3" / "inner").is_dir()


def test_a_second_process_is_refused(tmp_path):
    code = (
        "import sys, pathlib; from baselines.runs.files import alone\n"
        f"with alone(pathlib.Path({str(tmp_path)!r}), 'mbn train'):\n"
        "    print('on', flush=True)\n"
        "    sys.stdin.read()"
    )
    first = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert first.stdout.readline() == "on\n"
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
def test_a_drive_without_locks_is_used(code, tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", Mock(side_effect=OSError(getattr(errno, code), code)))
    with pytest.warns(UserWarning, match="lock"), alone(tmp_path, "mbn train"):
        pass
    assert not list(tmp_path.iterdir())


def test_a_run_records_field_command_versions_and_progress(tmp_path):
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


MAPPO = ("obs_size", "n_robots", "hidden", "sharing", "actor")
SHARED = ("algorithm", "observes", "policy", "obs_size", "action_shape", "arguments")


class Evil:
    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.path,)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mappo", "ppo"])
def test_a_file_that_is_cut_off_or_a_pickle_is_named(name, tmp_path, tiny_runs):
    trap = tmp_path / "pwned"
    run = RunFolder(shutil.copytree(tiny_runs.finished(name).path, tmp_path / "finished"))
    stopped = tiny_runs.stopped(name, tmp_path / "stopped")
    read = "**/*" if name == "ppo" else "*"  # mappo's policy is in the learner's file
    files = [(path, lambda: load_trained(run)) for path in run.policy.iterdir()]
    files += [
        (path, lambda: train(small_config(name), stopped.path, resume=True))
        for path in filter(Path.is_file, stopped.checkpoint.glob(read))
    ]
    for path, load in files:
        if path.parent.name == BEST or path == run.policy / "learner.safetensors":
            continue  # at the end of the run, or by runs that begin with this one, it is read
        whole = path.read_bytes()
        for bad in (whole[: len(whole) // 2], pickle.dumps(Evil(trap))):
            path.write_bytes(bad)
            with pytest.raises(RunError, match=path.name):
                load()
        path.write_bytes(whole)
    assert not trap.exists()
    stopped.progress.write_text("env_steps\n")  # it ends before the checkpoint
    with pytest.raises(RunError, match=r"progress\.csv"):
        train(small_config(name), stopped.path, resume=True)


def test_an_archive_that_is_no_file_of_a_run_is_named(tmp_path):
    place = tmp_path / "arrays.npz"
    write_arrays(place, {"a": np.arange(3)})
    assert read_arrays(place)["a"].tolist() == [0, 1, 2]
    data = bytearray(place.read_bytes())
    data[len(data) // 2] ^= 1
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000,), }\n"

    def with_a_huge_shape() -> None:
        with zipfile.ZipFile(place, "w") as archive:
            version = b"\x93NUMPY\x01\x00"
            archive.writestr("a.npy", version + struct.pack("<H", len(head)) + head)

    makers = [
        lambda: np.savez(place, allow_pickle=True, a=np.array([Evil(tmp_path / "pwned")], object)),
        lambda: place.write_bytes(pickle.dumps(Evil(tmp_path / "pwned"))),
        lambda: place.write_bytes(data),
        with_a_huge_shape,
        place.unlink,
    ]
    for make in makers:
        make()
        with pytest.raises(RunError, match=r"arrays\.npz"):
            read_arrays(place)
    assert not (tmp_path / "pwned").exists()


def test_a_link_in_a_run_folder_is_refused(tmp_path):
    (tmp_path / "config.json").touch()
    for place in ("progress.csv", "policy/policy.json", "tensorboard/events"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).symlink_to(tmp_path / "mine")
        with pytest.raises(RunError, match=place):
            RunFolder.open(tmp_path)
        (tmp_path / place).unlink()
    RunFolder.open(tmp_path)


def past_the_key(counters: Any) -> Any:
    counters["generators"]["numpy"]["state"]["pos"] = 10**8
    return counters


def with_entry(entry: str, value: Any) -> Callable[[Any], Any]:
    return lambda content: content | {entry: value}


WEIGHTS = (
    lambda weight: weight * torch.nan,
    lambda weight: torch.full_like(weight, torch.inf),
    lambda weight: weight.double(),
    lambda weight: weight.long(),
    lambda weight: weight[None],
)
EDITS = [
    *(("mappo", "policy.json", with_entry(k, v)) for k in MAPPO for v in (None, "x", -3, 10**12)),
    ("mappo", "policy.json", with_entry("tokens", {"own": 3})),
    *(("ppo-shared", "policy.json", with_entry(k, v)) for k in SHARED for v in (None, "x")),
    ("ppo-shared", "policy.json", with_entry("normalization", {"mean": [float("nan")]})),
    *(
        (name, "policy.safetensors", lambda a, change=change: {k: change(a[k]) for k in a})
        for name in ("mappo", "ppo-shared")
        for change in WEIGHTS
    ),
    ("mappo", "worlds.npz", lambda a: a | {"now.steps": a["now.steps"] + np.int32(10**8)}),
    ("ppo", "worlds.npz", lambda a: a | {"now.x": a["now.x"] * np.float32(np.nan)}),
    ("ppo", "worlds.npz", lambda a: a | {"_last_obs": a["_last_obs"][:, 1:]}),
    ("tqc", "replay.npz", with_entry("pos", np.array(10**9))),
    ("tqc", "counters.json", with_entry("num_timesteps", "x")),
    ("mappo", "counters.json", with_entry("curriculum", {"first": "x"})),
    ("mappo", "counters.json", lambda a: [a]),
    ("mappo", "counters.json", with_entry("env_steps", -1)),
    ("mappo", "recorder.json", with_entry("progress_bytes", -5)),
    ("ppo", "recorder.json", lambda a: [a]),
    ("mappo", "counters.json", past_the_key),
    ("ppo", "counters.json", past_the_key),
]
READERS = {".json": read_json, ".npz": read_arrays, ".safetensors": read_tensors}


@pytest.mark.parametrize(("name", "file", "change"), EDITS)
def test_an_edited_file_is_refused(name, file, change, tmp_path, tiny_runs):
    of_policy = file.startswith("policy.")
    if of_policy:
        run = RunFolder(shutil.copytree(tiny_runs.finished(name).path, tmp_path / "run"))
    else:
        run = tiny_runs.stopped(name, tmp_path / "run")
    place = run.policy / file if of_policy else run.policy.parent / file
    content = change(READERS[place.suffix](place))
    if place.suffix == ".json":
        place.write_text(json.dumps(content))
    else:
        (write_arrays if place.suffix == ".npz" else write_tensors)(place, content)
    with pytest.raises(RunError, match=str(run.path)):
        load_trained(run) if of_policy else train(small_config(name), run.path, resume=True)
