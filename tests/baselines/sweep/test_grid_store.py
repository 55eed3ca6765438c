"""Stores of runs: interrupted on one machine, resumed on another, bit by bit as if never."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.sweep import store as stores
from baselines.sweep import worker
from baselines.sweep.run import Sweep
from baselines.sweep.status import Status
from baselines.sweep.store import RemoteStore, Store, open_store
from baselines.sweep.worker import Outcome, TrainJob, train_in_store
from baselines.training.progress_bar import Report
from baselines.training.train import train
from tests.support.grids import spec_of
from tests.support.runs import recorded, same_policies


class VanishedError(BaseException):
    """The process is gone; nothing after this is done."""


def train_and_vanish(job: TrainJob, monkeypatch: pytest.MonkeyPatch) -> None:
    """Train until a checkpoint is written, and where it has to go, kept."""
    follow = worker.Watch.__call__

    def vanish(watch: Any, report: Report) -> None:
        follow(watch, report)
        newest = watch._run.checkpoint
        if newest is not None and int(newest.name) > watch._first_steps:
            raise VanishedError

    with monkeypatch.context() as patch, pytest.raises(VanishedError):
        patch.setattr(worker.Watch, "__call__", vanish)
        train_in_store(job, lambda report: None)


@pytest.fixture(params=["folder", "elsewhere"])
def place(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A store, of each kind."""
    use_machine(tmp_path / "machine-1", monkeypatch)
    store = tmp_path / "store"
    return str(store) if request.param == "folder" else store.as_uri()


def use_machine(scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Be a machine with a scratch folder of its own."""
    scratch.mkdir(exist_ok=True)
    monkeypatch.setattr(stores.tempfile, "tempdir", str(scratch))


def job_of(sweep: Sweep, place: int) -> TrainJob:
    return TrainJob(sweep.runs[place], sweep.place, noted=True)


def test_another_machine_resumes_where_one_was_lost(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = Sweep.of(spec_of(place, settings=["C"]))
    source, name = sweep.names
    assert train_in_store(job_of(sweep, 0), print) == Outcome(source, "done")
    train_and_vanish(job_of(sweep, 1), monkeypatch)
    assert [one.standing for one in Status.of(sweep).runs] == ["done", "running"]
    use_machine(tmp_path / "machine-2", monkeypatch)
    sweep = Sweep.of(spec_of(place, settings=["C"]))
    assert train_in_store(job_of(sweep, 1), print) == Outcome(name, "done")
    out = tmp_path / "store"
    if isinstance(sweep.store, RemoteStore):
        out = tmp_path / "fetched"
        for one in sweep.names:
            sweep.store.fetch(one, out / one)
        left = sorted(path.name for path in (tmp_path / "store").rglob("*") if path.is_file())
        runs = (f"{one}.{ending}" for one in sweep.names for ending in ("json", "zip"))
        assert left == sorted(runs), "something else is left in the store"
    resumed = RunFolder(out / name)
    history = json.loads((resumed.path / "resumed.json").read_text())
    assert [entry["env_steps"] > 0 for entry in history] == [True]
    config = replace(sweep.runs[1], transferred_from=out / source)
    whole = train(config, tmp_path / "whole")
    assert recorded(resumed) == recorded(whole)
    assert same_policies(resumed, whole)
    note = sweep.store.notes()[name]
    assert (note.state, note.attempt) == ("done", 2)
    assert sweep.left() == []


def checkpoint_of(folder: Path, steps: int) -> None:
    """Make the folder of a run with a checkpoint, and that one alone."""
    run = RunFolder(folder)
    with run.new_checkpoint(steps) as checkpoint:
        (checkpoint / "steps.txt").write_text(str(steps))
    (folder / "config.json").write_text('{"transferred_from": null}')


@pytest.mark.parametrize(("kept", "here", "newest"), [(40, 60, 60), (60, 40, 60), (40, 40, 40)])
def test_the_newest_checkpoint_is_resumed_wherever_it_is(
    kept: int, here: int, newest: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = (tmp_path / "store").as_uri()
    use_machine(tmp_path / "machine-1", monkeypatch)
    first = open_store(store)
    checkpoint_of(first.folder("run"), kept)
    first.keep("run")
    use_machine(tmp_path / "machine-2", monkeypatch)
    second = open_store(store)
    checkpoint_of(second.folder("run"), here)
    second.restore("run")
    found = RunFolder(second.folder("run")).checkpoint
    assert found is not None and (found / "steps.txt").read_text() == str(newest)
    checkpoint_of(second.folder("run"), 80)
    second.keep("run")
    first.keep("run")  # of a machine that was taken for lost, too late
    use_machine(tmp_path / "machine-3", monkeypatch)
    third = open_store(store)
    third.restore("run")
    found = RunFolder(third.folder("run")).checkpoint
    assert found is not None and int(found.name) == 80


def test_a_machine_that_is_too_late_cannot_undo_a_finished_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = (tmp_path / "store").as_uri()
    use_machine(tmp_path / "machine-1", monkeypatch)
    late = open_store(store)
    checkpoint_of(late.folder("run"), 40)
    use_machine(tmp_path / "machine-2", monkeypatch)
    other = open_store(store)
    checkpoint_of(other.folder("run"), 60)
    other.finish("run")
    late.keep("run")
    assert other.finished(["run"]) == {"run"}
    other.restore("run")
    assert isinstance(other, RemoteStore)
    other.fetch("run", tmp_path / "fetched")
    found = RunFolder(tmp_path / "fetched").checkpoint
    assert found is not None and int(found.name) == 60


def test_a_damaged_checkpoint_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_machine(tmp_path / "machine-1", monkeypatch)
    sweep = Sweep.of(spec_of((tmp_path / "store").as_uri()))
    train_and_vanish(job_of(sweep, 0), monkeypatch)
    (archive,) = (tmp_path / "store" / ".grid").glob("*.zip")
    data = bytearray(archive.read_bytes())
    data[len(data) // 2] ^= 1
    archive.write_bytes(data)
    use_machine(tmp_path / "machine-2", monkeypatch)
    outcome = train_in_store(job_of(Sweep.of(spec_of(sweep.place)), 0), print)
    assert outcome.state == "failed" and archive.name in (outcome.error or "")


def test_a_run_of_an_older_version_is_named_and_taken_once_it_is_packed(tmp_path: Path) -> None:
    store, folder = open_store((tmp_path / "store").as_uri()), tmp_path / "store" / "run"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text('{"steps": 7}')
    with pytest.raises(RunError, match=r": run$"):
        store.finished(["run", "other"])
    shutil.make_archive(str(folder), "zip", folder)
    assert store.finished(["run", "other"]) == {"run"}
    assert store.config("run") == {"steps": 7}


def test_a_path_and_a_url_are_stores_of_their_kind(tmp_path: Path) -> None:
    kinds: Mapping[str, type] = {str(tmp_path): Store, "memory://runs": RemoteStore}
    assert {place: type(open_store(place)) for place in kinds} == kinds
