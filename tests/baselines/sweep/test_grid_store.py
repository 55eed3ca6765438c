"""Stores of runs: interrupted on one machine, resumed on another, bit by bit as if never."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from baselines.runs.files import read_json
from baselines.runs.folder import RunFolder
from baselines.sweep import store as stores
from baselines.sweep import worker
from baselines.sweep.run import Sweep
from baselines.sweep.status import Status
from baselines.sweep.worker import Outcome, TrainJob, train_in_store
from baselines.training.run_logger import Report
from baselines.training.train import train
from tests.support.grids import spec_of
from tests.support.runs import recorded, same_policies

pytestmark = pytest.mark.slow


class VanishedError(BaseException):
    """The process is gone; nothing after this is done."""


@pytest.mark.parametrize("kind", ["folder", pytest.param("url", marks=pytest.mark.all)])
def test_another_machine_resumes_where_one_was_lost(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tmp_path / "store"
    place = str(store) if kind == "folder" else store.as_uri()

    def sweep_of(machine: str) -> tuple[Sweep, list[TrainJob]]:
        """The grid on a machine with a scratch folder for itself."""
        (tmp_path / machine).mkdir()
        monkeypatch.setattr(stores.tempfile, "tempdir", str(tmp_path / machine))
        sweep = Sweep.of(spec_of(place, settings=["C"]))
        return sweep, [TrainJob(run, sweep.place, noted=True) for run in sweep.runs]

    follow = worker.Watch.__call__

    def vanish(watch: Any, report: Report) -> None:
        follow(watch, report)
        newest = watch._run.checkpoint
        if newest is not None and int(newest.name) > watch._first_steps:
            raise VanishedError

    sweep, jobs = sweep_of("first")
    source, name = sweep.names
    assert train_in_store(jobs[0], print) == Outcome(source, "done")
    with monkeypatch.context() as patch, pytest.raises(VanishedError):
        patch.setattr(worker.Watch, "__call__", vanish)
        train_in_store(jobs[1], print)
    assert [one.standing for one in Status.of(sweep).runs] == ["done", "running"]
    sweep, jobs = sweep_of("second")
    assert train_in_store(jobs[1], print) == Outcome(name, "done")
    if kind == "url":
        for one in sweep.names:
            sweep.store.fetch(one, tmp_path / "fetched" / one)  # type: ignore[attr-defined]
        store = tmp_path / "fetched"
    resumed = RunFolder(store / name)
    assert [entry["env_steps"] > 0 for entry in read_json(resumed.path / "resumed.json")] == [True]
    whole = train(replace(sweep.runs[1], transferred_from=store / source), tmp_path / "whole")
    assert recorded(resumed) == recorded(whole)
    assert same_policies(resumed, whole)
    note = sweep.store.notes()[name]
    assert (note.state, note.attempt) == ("done", 2)
    assert sweep.left() == []
