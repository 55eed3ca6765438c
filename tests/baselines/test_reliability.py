"""Damaged files are named, a full disk loses nothing, and what others made runs no code."""

from __future__ import annotations

import io
import json
import os
import pickle
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from baselines.cli import main
from baselines.evaluation.policy import load_policy
from baselines.runs.files import RunError, alone, claim_folder, read_arrays, seal, write_arrays
from baselines.runs.folder import RunFolder
from baselines.runs.trust import TrustError, key_file, own_key
from baselines.training.config import TrainConfig
from baselines.training.progress_bar import Report
from baselines.training.train import prepare, train
from benchmarks.reliability import corruption, endurance
from benchmarks.reliability import fuzz as fuzzing
from benchmarks.speed.timing import cpu_backend
from mbn_marl import BatchEngine
from mbn_marl.checksums import check, is_signed, listed
from mbn_marl.errors import DamageError, FieldError, MbnError
from mbn_marl.field import catalogue, load_field

SMALL = {"policy_kwargs": {"net_arch": [8]}}


def _config(name: str) -> TrainConfig:
    """A run with two fresh evaluations on the way."""
    hyperparameters: dict[str, Any] = {"num_worlds": 4, "rollout_steps": 16, "hidden": [8]}
    hyperparameters |= {"action_repeat": [1, 1], "action_repeat_until": 0.5}
    if name == "ppo":
        model = {**SMALL, "n_steps": 32, "batch_size": 32}
        hyperparameters = {"num_envs": 2, "model": model}
    return TrainConfig(
        name,
        "field_03",
        steps=320,
        evaluate_every=100,
        episodes=2,
        environment={"max_steps": 50},
        hyperparameters=hyperparameters,
    )


def _stopped(name: str, out: Path) -> RunFolder:
    """A run that was interrupted after its first checkpoint."""

    def interrupt(report: Report) -> None:
        if (out / "checkpoints").exists():
            raise InterruptedError

    with pytest.raises(InterruptedError):
        train(_config(name), out, listener=interrupt)
    return RunFolder.open(out)


def _flip(path: Path) -> None:
    """Change a bit in the middle of a file."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


# Checksums


@pytest.fixture(scope="module", params=["mappo", "ppo"])
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    out = tmp_path_factory.mktemp(request.param) / "run"
    return train(_config(request.param), out)


@pytest.fixture(scope="module", params=["mappo", "ppo"])
def stopped(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return _stopped(request.param, tmp_path_factory.mktemp(request.param) / "run")


READERS: dict[str, Callable[[RunFolder], object]] = {
    "config.json": lambda run: run.config,
    "field.yaml": lambda run: run.field,
    "command.txt": lambda run: run.command,
    "evaluations.json": lambda run: run.evaluations,
    "evaluation.json": lambda run: run.evaluation,
}


@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_of_a_run_is_named(name: str, finished: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(finished.path, tmp_path / "run")
    run = RunFolder.open(tmp_path / "run")
    READERS[name](run)
    _flip(run.path / name)
    with pytest.raises(DamageError, match=f"{name} is damaged"):
        READERS[name](run)


def test_every_file_of_a_policy_is_checked(finished: RunFolder, tmp_path: Path) -> None:
    for path in finished.policy.iterdir():
        copy = tmp_path / path.name
        shutil.copytree(finished.path, copy)
        load_policy(copy)
        _flip(copy / "policy" / path.name)
        with pytest.raises((DamageError, TrustError)):  # of the list, perhaps its signature
            load_policy(copy)


def test_every_file_of_a_checkpoint_is_checked(stopped: RunFolder, tmp_path: Path) -> None:
    assert stopped.checkpoint is not None
    config = _config(stopped.config["algorithm"])
    read = "**/*" if config.algorithm == "ppo" else "*"  # mappo's policy is in the learner's file
    files = [path for path in stopped.checkpoint.glob(read) if path.is_file()]
    for number, path in enumerate((*files, stopped.progress)):
        copy = tmp_path / str(number)
        shutil.copytree(stopped.path, copy)
        _flip(copy / path.relative_to(stopped.path))
        with pytest.raises((DamageError, TrustError)):
            train(config, copy, resume=True)
        shutil.copy(path, copy / path.relative_to(stopped.path))
        if number in (0, len(files)):
            assert train(config, copy, resume=True).finished


def test_what_is_not_listed_is_not_checked(tmp_path: Path) -> None:
    (tmp_path / "by_hand").write_text("a")
    check(tmp_path / "by_hand")
    seal(tmp_path, ["other"])
    check(tmp_path / "by_hand")
    seal(tmp_path)
    assert [*listed(tmp_path)] == ["by_hand"]
    (tmp_path / "by_hand").write_text("b")
    with pytest.raises(DamageError, match=r"by_hand is damaged.*take its line out"):
        check(tmp_path / "by_hand")
    for content in ("", "[]", '{"a": {}}', '{"sha256": []}', "[" * 100_000):
        (tmp_path / "checksums.json").write_text(content)
        with pytest.raises(DamageError, match=r"checksums\.json is damaged"):
            check(tmp_path / "by_hand")


def test_the_catalogue_has_the_bytes_it_was_made_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(str(catalogue._FOLDER))
    assert [f"{name}.yaml" for name in catalogue.catalogue_names()] == [*listed(folder)]
    for name in listed(folder):
        check(folder / name)  # after a change: baselines.runs.files.seal(folder, names)
    copy = tmp_path / "envs_catalog"
    shutil.copytree(folder, copy)
    shutil.copy(copy / "field_03.yaml", copy / "field_04.yaml")
    monkeypatch.setattr(catalogue, "_FOLDER", copy)
    monkeypatch.setattr("mbn_marl.field.files._catalogue_field", _uncached())
    with pytest.raises(FieldError, match=r"field_04\.yaml is damaged"):
        load_field("field_04")


def _uncached() -> Any:
    from mbn_marl.field import files

    return files._catalogue_field.__wrapped__


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
    whole = train(_config(name), tmp_path / "whole")
    run = _stopped(name, tmp_path / "run")
    kept = run.checkpoint
    assert kept is not None
    before = {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()}
    with _files_up_to(size), pytest.raises(RunError, match=r"could not be written to \(.*large"):
        train(_config(name), run.path, resume=True)
    assert run.checkpoint == kept
    assert {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()} == before
    resumed = train(_config(name), run.path, resume=True)
    assert resumed.evaluation["stochastic"] == whole.evaluation["stochastic"]
    assert not list(run.path.glob(".*"))


# Locks


def test_the_second_process_is_told_of_the_first(tmp_path: Path) -> None:
    code = (
        "import sys, pathlib; from baselines.runs.files import alone\n"
        f"with alone(pathlib.Path({str(tmp_path)!r}), 'mbn train'): print('on'); sys.stdin.read()"
    )
    first = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert first.stdout is not None and first.stdout.readline() == "on\n"
    holder = rf"another mbn train \(process {first.pid} on .* since 20.* UTC\) is at work here"
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
    assert train(_config("mappo"), out).finished
    assert not list(out.glob(".*"))


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
    run = train(_config("mappo"), tmp_path / "run")
    (run.path / "policy" / "checksums.json").unlink()
    (run.path / "policy" / "policy.safetensors").write_bytes(evil)
    with pytest.raises(RunError, match="cannot be read"):
        load_policy(run)
    for name in ("policy.json", "config.json", "field.yaml"):
        (run.path / "checksums.json").unlink(missing_ok=True)
        place = run.policy if name == "policy.json" else run.path
        (place / name).write_bytes(evil)
        assert main(["evaluate", str(run.path)]) == 2


def _plant(run: Path, evil: bytes) -> None:
    """Put a pickle that runs code where Stable-Baselines3 would load it, with fresh checksums."""
    import base64

    model = run / "policy" / "model.zip"
    with zipfile.ZipFile(model) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(members["data"])
    planted = {":type:": "x", ":serialized:": base64.b64encode(evil).decode()}
    members["data"] = json.dumps({**data, "learning_rate": planted}).encode()
    with zipfile.ZipFile(model, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    seal(run / "policy", key=b"theirs")


@pytest.fixture(scope="module")
def ppo(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return train(_config("ppo"), tmp_path_factory.mktemp("ppo") / "run")


def test_a_zip_of_someone_else_needs_trust(
    ppo: RunFolder, evil: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    theirs = tmp_path / "theirs"
    shutil.copytree(ppo.path, theirs)
    _plant(theirs, evil)
    gif, page = str(tmp_path / "a.gif"), str(tmp_path / "page.html")
    moved = ["train", "ppo", "field_04", "--setting", "C", "--from", str(theirs)]
    commands = [
        ["evaluate", str(theirs), "--episodes", "1"],
        ["render", str(theirs), "-o", gif],
        ["watch", "field_03", "--policy", str(theirs)],
        ["report", str(theirs), "-o", page],
    ]
    for command in commands:
        assert main(command) == 2
        error = capsys.readouterr().err
        assert "can run any code; it was not made by you" in error and "--trust" in error
    assert main(moved) == 2  # since its settings differ; what follows is the same for --from
    assert not (tmp_path / "pwned").exists()


def test_trust_loads_it(ppo: RunFolder, tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    shutil.copytree(ppo.path, theirs)
    assert main(["evaluate", str(theirs), "--episodes", "1"]) == 0  # it is still one's own
    _plant(theirs, pickle.dumps(Evil(tmp_path / "pwned")))
    with pytest.raises(TrustError):
        load_policy(theirs)
    with pytest.raises(RunError, match="cannot be read"):  # os.mkdir returns no learning rate
        load_policy(RunFolder.open(theirs, trust=True))
    assert (tmp_path / "pwned").is_dir()


def test_a_checkpoint_of_someone_else_needs_trust(tmp_path: Path) -> None:
    run = _stopped("ppo", tmp_path / "run")
    assert run.checkpoint is not None
    seal(run.checkpoint / "policy", key=b"theirs")
    with pytest.raises(TrustError, match="--trust"):
        train(_config("ppo"), run.path, resume=True)
    assert train(_config("ppo"), run.path, resume=True, trust=True).finished


def test_the_key_is_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    key = own_key()
    assert key is not None and own_key() == key and len(key) == 32
    assert key_file().stat().st_mode & 0o777 == 0o600
    assert [path.name for path in key_file().parent.iterdir()] == ["key"]
    (tmp_path / "a").write_text("a")
    (tmp_path / "b").write_text("b")
    seal(tmp_path, ["a"], key=key)
    assert is_signed(tmp_path / "a", key)
    assert not is_signed(tmp_path / "a", b"theirs") and not is_signed(tmp_path / "b", key)
    content = json.loads((tmp_path / "checksums.json").read_text())
    content["sha256"]["b"] = content["sha256"]["a"]
    (tmp_path / "checksums.json").write_text(json.dumps(content))
    assert not is_signed(tmp_path / "b", key)
    (tmp_path / "home" / "mbn_marl" / "key").write_bytes(b"short")
    assert own_key() is None
    monkeypatch.setenv("XDG_CONFIG_HOME", "/dev/null/home")
    assert own_key() is None


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


def test_a_folder_with_something_else_in_it_is_not_claimed(tmp_path: Path) -> None:
    (tmp_path / ".lock").touch()
    claim_folder(tmp_path)
    (tmp_path / ".hidden").touch()
    with pytest.raises(RunError, match="already exists"):
        claim_folder(tmp_path)


# The measurements of docs/reliability.md, in small


def test_damaged_copies_are_counted(tmp_path: Path) -> None:
    folder, scratch = tmp_path / "subject", tmp_path / "scratch"
    for place in (folder, scratch):
        place.mkdir()
    shutil.copytree(str(catalogue._FOLDER), folder, dirs_exist_ok=True)
    files = tuple(path.relative_to(folder) for path in folder.glob("*.yaml"))
    subject = corruption.Subject("fields", folder, files, corruption._read_fields)
    count = corruption.try_copies(subject, 20, scratch, Random(0))
    assert count == corruption.Count(damaged=20, refused=20)
    unchecked = replace(subject, read=lambda copy: [(copy / file).read_bytes() for file in files])
    assert corruption.try_copies(unchecked, 5, scratch, Random(0)).wrong == 5
    careless = replace(subject, read=lambda copy: _without_errors(copy, files))
    assert corruption.try_copies(careless, 5, scratch, Random(0)).crashed > 0


def _without_errors(folder: Path, files: tuple[Path, ...]) -> None:
    """A reader that breaks down over what is damaged."""
    for file in files:
        if b"vertices:" not in (data := (folder / file).read_bytes()) or b"\nrois:" not in data:
            raise KeyError(file)
        data.decode("ascii")


@pytest.fixture(scope="module")
def guard(tmp_path_factory: pytest.TempPathFactory) -> fuzzing.Guard:
    return fuzzing.Guard(tmp_path_factory.getbasetemp(), Path(tempfile.gettempdir(), "numba"))


@pytest.mark.parametrize(
    ("name", "inputs"), [("field reader", 150), ("episode reader", 60), ("settings", 60)]
)
def test_inputs_that_nobody_meant(
    name: str,
    inputs: int,
    guard: fuzzing.Guard,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    prepare(_config("mappo"))  # loads the libraries
    prepare(_config("ppo"))
    count = fuzzing.fuzz(fuzzing.targets()[name], inputs, guard, seed=0)
    assert count.broken == [] and count.inputs >= inputs and count.refused > inputs / 3


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda number: 1 // (number // 5), "ZeroDivisionError"),
        (lambda number: Path("../outside").write_text("x"), "open /.*outside"),
        (lambda number: sum(range(10**8)), r"\d\.\d s"),
    ],
    ids=["another error", "a file outside", "a hang"],
)
def test_a_broken_promise_is_noted(
    call: Callable[[int], object],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "in").mkdir()
    monkeypatch.chdir(tmp_path / "in")
    monkeypatch.setattr(fuzzing, "LONGEST", 0.2)
    guard = fuzzing.Guard(tmp_path / "in")
    target = fuzzing.Target(lambda n: call(n) and None, st.integers(0, 9), MbnError, 1.0)
    count = fuzzing.fuzz(target, 5, guard, seed=0)
    assert len(count.broken) == 1 and re.search(message, count.broken[0])


def test_invariants_of_worlds() -> None:
    engine = BatchEngine(["field_01", "field_03"], 4, seed=0, random_starts=True)
    engine.reset()
    for _ in range(50):
        engine.step(engine.sample_actions())
    assert endurance.problems(engine, [0, 1, 2, 3]) == []
    now = cpu_backend(engine).now
    now.x[0, 1] += 400.0
    now.vy[0, 2] = np.float32(5.5)
    now.team_return[3] = np.nan
    found = endurance.problems(engine, [0, 1, 2, 3])
    assert {"the trail ends here, world 1", "speed limit, world 2", "episode_return"} <= {*found}
    assert not [problem for problem in found if problem.endswith("world 0")]


def test_growth_of_memory_is_found(capsys: pytest.CaptureFixture[str]) -> None:
    kept: list[np.ndarray] = []

    def leak(*arguments: Any) -> list[str]:
        kept.append(np.ones(1 << 13))
        return []

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(endurance, "problems", leak)
        assert not endurance.Endurance(env_steps=1 << 14, worlds=16).run("")
    assert "nothing" in capsys.readouterr().out
