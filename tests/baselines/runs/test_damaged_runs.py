"""Damaged or edited files of a run: an error names the file, and no code in them is run."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import struct
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from baselines.cli import main
from baselines.policies.load import load_trained
from baselines.runs.files import RunError, read_arrays, read_json, write_arrays
from baselines.runs.folder import RunFolder
from baselines.runs.tensors import read_tensors, write_tensors
from baselines.torchrl import policy as team_policy
from baselines.training.train import train
from mbn_marl.errors import MbnError
from tests.support.runs import TinyRuns, small_config

MAPPO = ("obs_size", "n_robots", "hidden", "sharing", "actor")
SHARED = ("algorithm", "observes", "policy", "obs_size", "action_shape", "arguments")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mappo", "ppo"])
def test_a_file_that_is_cut_off_is_named(name: str, tmp_path: Path, tiny_runs: TinyRuns) -> None:
    run = RunFolder(shutil.copytree(tiny_runs.finished(name).path, tmp_path / "finished"))
    stopped: Any = tiny_runs.stopped(name, tmp_path / "stopped")
    read = "**/*" if name == "ppo" else "*"  # mappo's policy is in the learner's file
    files = [(path, lambda: load_trained(run)) for path in run.policy.iterdir()]
    files += [
        (path, lambda: train(small_config(name), stopped.path, resume=True))
        for path in filter(Path.is_file, stopped.checkpoint.glob(read))
    ]
    for path, load in files:
        if path.parent == run.policy and path.name == "learner.safetensors":
            continue  # only runs that begin with this one read it
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(RunError, match=path.name):
            load()
        path.write_bytes(whole)
    stopped.progress.write_text("env_steps\n")  # it ends before the checkpoint
    with pytest.raises(RunError, match=r"progress\.csv"):
        train(small_config(name), stopped.path, resume=True)


class Evil:
    """Unpickling it makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.path,)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mappo", "ppo"])
def test_no_pickle_is_loaded(name: str, tmp_path: Path, tiny_runs: TinyRuns) -> None:
    trap = tmp_path / "pwned"
    run = tiny_runs.stopped(name, tmp_path / name)
    files = [path.relative_to(run.path) for path in run.path.rglob("*.*") if path.is_file()]
    assert {".safetensors", ".npz", ".json", ".yaml", ".csv"} <= {file.suffix for file in files}
    for file in files:
        shutil.rmtree(run.path)
        tiny_runs.stopped(name, run.path)
        (run.path / file).write_bytes(pickle.dumps(Evil(trap)))
        main(["evaluate", str(run.path), "--episodes", "1"])
        with suppress(MbnError):
            train(small_config(name), run.path, resume=True)
    assert not trap.exists()


def test_an_archive_that_is_no_file_of_a_run_is_named(tmp_path: Path) -> None:
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

    makers: list[Callable[[], object]] = [
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


def test_a_link_in_a_run_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").touch()
    for place in ("progress.csv", "policy/policy.json", "tensorboard/events"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).symlink_to(tmp_path / "mine")
        with pytest.raises(RunError, match=place):
            RunFolder.open(tmp_path)
        (tmp_path / place).unlink()
    RunFolder.open(tmp_path)


def test_the_next_checkpoint_is_read_when_one_is_gone(
    tmp_path: Path, tiny_runs: TinyRuns, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, load = tiny_runs.stopped("mappo", tmp_path / "run"), team_policy.load_policy
    old: Any = run.checkpoint

    def late(folder: Path) -> Any:
        if old.exists():
            old.rename(old.with_name("000000009999"))
        return load(folder)

    monkeypatch.setattr(team_policy, "load_policy", late)
    assert load_trained(run).observes == "observations"
    shutil.rmtree(run.path / "checkpoints" / "000000009999" / "policy")
    with pytest.raises(RunError, match="000000009999"):
        load_trained(run)


def past_the_key(counters: Any) -> Any:
    """Let NumPy's generator read far behind its numbers."""
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
EDITS: list[tuple[str, str, Callable[[Any], Any]]] = [
    *(("mappo", "policy.json", with_entry(k, v)) for k in MAPPO for v in (None, "x", -3, 10**12)),
    *(("mappo", "policy.json", with_entry("tokens", v)) for v in ("x", [1], {"own": 3})),
    *(("ppo-shared", "policy.json", with_entry(k, v)) for k in SHARED for v in (None, "x")),
    *(
        ("ppo-shared", "policy.json", with_entry("normalization", v))
        for v in ("x", {}, {"mean": [float("nan")]})
    ),
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
READERS: dict[str, Any] = {".json": read_json, ".npz": read_arrays, ".safetensors": read_tensors}


@pytest.mark.parametrize(("name", "file", "change"), EDITS)
def test_an_edited_file_is_refused(
    name: str, file: str, change: Callable[[Any], Any], tmp_path: Path, tiny_runs: TinyRuns
) -> None:
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
