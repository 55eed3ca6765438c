"""Files of a run that no run writes: an error that names the file, and never more than that."""

from __future__ import annotations

import errno
import fcntl
import json
import multiprocessing
import os
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from baselines.evaluation.policy import load_trained
from baselines.runs.files import RunError, alone, claim_folder, read_arrays, seal, write_arrays
from baselines.runs.folder import RunFolder
from baselines.runs.tensors import read_tensors, write_tensors
from baselines.torchrl import policy as team_policy
from baselines.training.run_logger import Report
from baselines.training.train import train
from mbn_marl.errors import MbnError
from tests.support.runs import TinyRuns, small_config

MAPPO = ("obs_size", "n_robots", "hidden", "sharing", "actor")
SHARED = ("algorithm", "observes", "policy", "obs_size", "action_shape", "arguments")


@pytest.mark.parametrize(
    ("name", "entry", "value"),
    [
        *(("mappo", entry, bad) for entry in MAPPO for bad in (None, "evil", -3, 10**12)),
        *(("mappo", "tokens", bad) for bad in ("evil", [1], {"own": 3})),
        *(("ppo-shared", entry, bad) for entry in SHARED for bad in (None, "evil")),
        *(("ppo-shared", "normalization", bad) for bad in ("evil", {}, {"mean": [float("nan")]})),
    ],
)
def test_a_shape_that_no_network_has_is_named(
    name: str, entry: str, value: Any, tmp_path: Path, tiny_runs: TinyRuns
) -> None:
    run = RunFolder(shutil.copytree(tiny_runs.finished(name).path, tmp_path / "run"))
    (run.policy / "checksums.json").unlink()
    place = run.policy / "policy.json"
    place.write_text(json.dumps(json.loads(place.read_text()) | {entry: value}))
    with pytest.raises(RunError, match=str(run.policy)):
        load_trained(run)


@pytest.mark.parametrize(
    "change",
    [
        lambda weight: weight * torch.nan,
        lambda weight: torch.full_like(weight, torch.inf),
        lambda weight: weight.double(),
        lambda weight: weight.long(),
        lambda weight: weight[None],
    ],
)
@pytest.mark.parametrize("name", ["mappo", "ppo-shared"])
def test_weights_of_another_kind_are_refused(
    name: str, change: Callable[[Any], Any], tmp_path: Path, tiny_runs: TinyRuns
) -> None:
    run = RunFolder(shutil.copytree(tiny_runs.finished(name).path, tmp_path / "run"))
    (run.policy / "checksums.json").unlink()
    place = run.policy / "policy.safetensors"
    write_tensors(place, {key: change(one) for key, one in read_tensors(place).items()})
    with pytest.raises(RunError, match=r"policy\.safetensors"):
        load_trained(run)


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


def test_archives_that_need_more_than_there_is_are_refused(tmp_path: Path) -> None:
    place = tmp_path / "worlds.npz"
    large = np.zeros((200, 1 << 20), np.uint8)
    write_arrays(place, {"now.x": large}, compress=True)
    with pytest.raises(RunError, match=r"worlds\.npz: 209,715,3.. bytes in it; allowed: 67,108,"):
        read_arrays(place)
    assert read_arrays(place, {"now.x": large})["now.x"].nbytes == large.nbytes
    head = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000,), }\n"
    content = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head
    with zipfile.ZipFile(place, "w") as archive:
        archive.writestr("now.x.npy", content)
    with pytest.raises(RunError, match=r"worlds\.npz: 'now\.x\.npy' in it has no room"):
        read_arrays(place)


@pytest.mark.parametrize("code", ["ENOSYS", "ENOLCK", "EOPNOTSUPP"])
def test_a_drive_without_locks_is_worked_on(
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


def test_a_run_killed_before_its_first_file_begins(tmp_path: Path, tiny_runs: TinyRuns) -> None:
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


CRAFTED: list[tuple[str, str, Callable[[Any], Any]]] = [
    ("mappo", "worlds.npz", lambda a: a | {"now.steps": a["now.steps"] + np.int32(10**8)}),
    ("ppo", "worlds.npz", lambda a: a | {"0/now.x": a["0/now.x"] * np.float32(np.nan)}),
    ("ppo", "worlds.npz", lambda a: a | {"_last_obs": a["_last_obs"][:, 1:]}),
    ("tqc", "replay.npz", lambda a: a | {"pos": np.array(10**9)}),
    ("tqc", "counters.json", lambda a: a | {"num_timesteps": "x"}),
    ("mappo", "counters.json", lambda a: a | {"curriculum": {"first": "x"}}),
    ("mappo", "counters.json", lambda a: [a]),
    ("mappo", "counters.json", lambda a: a | {"env_steps": -1}),
    ("mappo", "recorder.json", lambda a: a | {"progress_bytes": -5}),
    ("ppo", "recorder.json", lambda a: [a]),
    *((name, "counters.json", lambda a: past_the_key(a)) for name in ("mappo", "ppo")),
]


def past_the_key(counters: Any) -> Any:
    """Let NumPy's generator go on far behind its numbers."""
    counters["generators"]["numpy"]["state"]["pos"] = 10**8
    return counters


def craft(checkpoint: Path, file: str, change: Callable[[Any], Any]) -> None:
    """Change a file of a checkpoint as somebody would who can make its checksums anew."""
    place = checkpoint / file
    if place.suffix == ".npz":
        write_arrays(place, change(read_arrays(place)))
    else:
        place.write_text(json.dumps(change(json.loads(place.read_text()))))
    seal(checkpoint)


@pytest.mark.parametrize(("name", "file", "change"), CRAFTED)
def test_a_crafted_checkpoint_is_refused(
    name: str, file: str, change: Callable[[Any], Any], tmp_path: Path, tiny_runs: TinyRuns
) -> None:
    run = tiny_runs.stopped(name, tmp_path / "run")
    assert run.checkpoint is not None
    craft(run.checkpoint, file, change)
    with pytest.raises(RunError, match=str(run.path)):
        train(small_config(name), run.path, resume=True)


def fuzz(name: str, folder: Path, edits: int) -> None:
    """Resume from checkpoints with an edited array or number."""
    rng, config = np.random.default_rng(5), small_config(name)
    for number in range(edits):
        run = RunFolder(shutil.copytree(folder, folder.with_name(f"edit{number}")))
        files = sorted(run.checkpoint.glob("*.*[nz]"))  # type: ignore[union-attr]

        def edit(content: Any) -> Any:
            key = str(rng.choice(sorted(content)))
            value = np.array(content[key]) if isinstance(content, dict) else content
            if value.dtype == object or value.dtype.kind == "U":
                return {**content, key: int(rng.choice([-1, 10**18, 0]))}
            flat = value.reshape(-1)
            raw = flat.view(np.uint8)
            raw[rng.integers(max(raw.size, 1), size=min(raw.size, 8))] ^= np.uint8(0x90)
            return {
                **content,
                key: value if isinstance(content[key], np.ndarray) else value.tolist(),
            }

        try:
            craft(run.checkpoint, str(rng.choice([file.name for file in files])), edit)  # type: ignore[arg-type]
            train(config, run.path, resume=True)
        except MbnError as error:
            assert str(run.path) in str(error)
        shutil.rmtree(run.path)


@pytest.mark.all
@pytest.mark.parametrize("name", ["mappo", "ppo", "tqc"])
def test_edited_checkpoints_are_refused_or_run(
    name: str, tmp_path: Path, tiny_runs: TinyRuns
) -> None:
    folder = tiny_runs.stopped(name, tmp_path / "run").path
    child = multiprocessing.get_context("spawn").Process(target=fuzz, args=(name, folder, 50))
    child.start()
    child.join(600)
    child.kill()
    assert child.exitcode == 0
