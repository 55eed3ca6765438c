"""Many runs: each ends once, whatever happens on the way, and says how it stands."""

from __future__ import annotations

import io
import multiprocessing
import os
import platform
import re
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from rich.console import Console

from baselines.cli import main
from baselines.runs.files import RunError, alone
from baselines.runs.folder import RunFolder
from baselines.sweep.processes import Failure, LocalEngine
from baselines.sweep.run import Sweep
from baselines.sweep.status import Status, duration, show
from baselines.sweep.store import LOST, Note
from baselines.sweep.worker import Outcome, TrainJob, train_in_store
from mbn_marl.errors import ConfigError
from tests.support.dying import FileJob, die_once
from tests.support.grids import BUDGET, TINY, run_here, spec_of
from tests.support.runs import recorded, same_policies

pytestmark = pytest.mark.slow


def test_runs_are_those_of_mbn_train_and_are_made_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, store = tmp_path / "grid.yaml", tmp_path / "runs"
    changes = {"settings": ["C"], "set": {"model.learning_rate": [0.01]}}
    path.write_text(yaml.safe_dump({"store": str(store), **TINY, **changes}))
    assert main(["grid", str(path), "--check"]) == 0
    assert "2 runs, 0 of them done" in capsys.readouterr().out
    assert not store.exists()
    assert main(["grid", str(path), "--processes", "1"]) == 0
    runs = sorted(folder for folder in store.iterdir() if folder.name != ".grid")
    assert [run.name for run in runs] == [
        "a2c-A-learning_rate0.01-field_01-seed0",
        "a2c-C-learning_rate0.01-field_03-seed0",
    ]
    run, same = RunFolder(runs[1]), RunFolder(tmp_path / "same")
    assert main([*run.command.split()[1:], "--out", str(same.path)]) == 0
    assert recorded(same) == recorded(run) and same_policies(same, run)
    assert same.config == run.config
    before = {file: file.stat().st_mtime_ns for file in store.rglob("*")}
    capsys.readouterr()
    assert main(["grid", str(path)]) == 0
    assert "2 runs, 2 of them done" in capsys.readouterr().out
    assert {file: file.stat().st_mtime_ns for file in store.rglob("*")} == before
    changed = spec_of(store, **changes, budget={**BUDGET, "episodes": 2})
    with pytest.raises(ConfigError, match=r"a2c-A-.*: episodes: "):
        run_here(Sweep.of(changed))


def test_a_run_that_diverges_stops_no_other(tmp_path: Path) -> None:
    wild = {"model.learning_rate": [1e30, 1e-4], "model.max_grad_norm": [1e30]}
    sweep = Sweep.of(spec_of(tmp_path, set=wild, budget={**BUDGET, "steps": 100}))
    bad, good = sweep.names
    with pytest.raises(RunError, match=re.escape(bad)):
        run_here(sweep)
    status = Status.of(sweep)
    assert [one.standing for one in status.runs] == ["failed", "done"]
    assert {name: note.state for name, note in sweep.store.notes().items()} == {
        bad: "diverged",
        good: "done",
    }
    with pytest.raises(RunError):
        run_here(sweep)  # tried again, and only that
    notes = sweep.store.notes()
    assert [notes[name].attempt for name in sweep.names] == [2, 1]


def test_a_defect_fails_its_run_alone_and_is_shown(tmp_path: Path) -> None:
    sweep = Sweep.of(spec_of(tmp_path, seeds=[0, 1]))
    first, second = sweep.runs
    nowhere: Any = None
    tries = [TrainJob(first, nowhere), TrainJob(second, str(tmp_path))]
    ended: dict[str, Any] = {}
    engine = LocalEngine(1, retries=1)
    engine.run(train_in_store, tries, print, lambda job, end: ended.update({job.name: end}))
    assert isinstance(ended[first.name], Failure) and "Traceback" in ended[first.name].error
    assert ended[second.name] == Outcome(second.name, "done")


def test_a_run_that_another_process_trains_is_left_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("baselines.sweep.worker.PATIENCE", 0.1)
    sweep = Sweep.of(spec_of(tmp_path, seeds=[0, 1]))
    held = tmp_path / sweep.names[0]
    held.mkdir()
    with alone(held, "mbn grid"), pytest.raises(RunError):
        run_here(sweep)
    assert sweep.store.finished(sweep.names) == {sweep.names[1]}
    assert sweep.names[0] not in sweep.store.notes()


def _note(**changes: Any) -> Note:
    """A note of a process that runs: this one."""
    here = {"machine": platform.node(), "process": os.getpid(), "updated": time.time()}
    return Note.model_validate({"state": "running", "attempt": 1, **here, **changes})


def test_what_is_left_is_estimated_from_what_is_known(tmp_path: Path) -> None:
    spec = spec_of(tmp_path, algorithms=["a2c", "ppo"], seeds=[0, 1], budget={"steps": 1000})
    sweep = Sweep.of(spec)
    assert Status.of(sweep).seconds_left() is None
    a2c, ppo = sweep.names[0], sweep.names[1]
    sweep.store.note(a2c, _note(env_steps=500, steps_per_second=10.0, machine="m1"))
    sweep.store.note(ppo, _note(env_steps=0, steps_per_second=0.0))
    status = Status.of(sweep)
    # 500 + 1000 steps of A2C at 10/s, 2 x 1000 of PPO, of which nothing is known, too; two at once.
    assert status.seconds_left() == pytest.approx((1500 + 2000) / 10.0 / 2)
    sweep.store.note(ppo, _note(state="failed", error="no [b]memory[/b]\nmore", env_steps=7))
    sweep.store.note(sweep.names[2], _note(updated=time.time() - LOST - 1.0))
    sweep.store.note(sweep.names[3], _note(process=2**22 + 1))  # larger than any process's
    status = Status.of(sweep)
    assert [one.standing for one in status.runs] == ["running", "failed", "waiting", "waiting"]
    console = Console(width=100, file=io.StringIO(), record=True)
    console.print(show(status))
    assert f"{ppo} (failed): no [b]memory[/b]" in console.export_text()
    words = ["60 s", "10 min", "2.5 h", "3.5 days"]
    assert [duration(seconds) for seconds in (59.6, 600, 9000, 3e5)] == words


def run_jobs(jobs: Sequence[FileJob], engine: LocalEngine) -> tuple[list[str], dict[str, Any]]:
    """Do jobs that die once; the reports, and how each job ended."""
    done: list[str] = []
    ended: dict[str, Any] = {}
    engine.run(die_once, jobs, done.append, lambda job, end: ended.update({job.name: end}))
    return done, ended


def test_a_worker_that_is_killed_fails_its_job_alone(tmp_path: Path) -> None:
    jobs = [FileJob(tmp_path / name) for name in "abcd"]
    for job in jobs[1:]:
        job.path.touch()
    done, ended = run_jobs(jobs, LocalEngine(2))
    assert sorted(done) == ["b", "c", "d"]
    assert ended.pop("a") == Failure("a process died with exit code -9")
    assert ended == {"b": 1, "c": 1, "d": 1}
    jobs[0].path.unlink()
    jobs[1] = FileJob(jobs[1].path, after="a")  # b has to wait for a's second try
    done, ended = run_jobs(jobs, LocalEngine(2, retries=1))
    assert sorted(done) == ["a", "b", "c", "d"] and set(ended.values()) == {1}
    assert done.index("a") < done.index("b")


def test_jobs_are_drawn_when_one_has_ended(tmp_path: Path) -> None:
    ended: list[str] = []

    def jobs() -> Iterator[FileJob]:
        for number in range(4):
            assert len(ended) >= number - 1, "drawn before there was a process for it"
            job = FileJob(tmp_path / str(number))
            job.path.touch()
            yield job

    LocalEngine(2).run(die_once, jobs(), print, lambda job, end: ended.append(job.name))
    assert sorted(ended) == ["0", "1", "2", "3"]


def test_an_error_on_the_way_stops_all(tmp_path: Path) -> None:
    jobs = [FileJob(tmp_path / name) for name in "ab"]

    def stop(job: FileJob, end: Any) -> None:
        raise RunError(end.error)

    with pytest.raises(RunError, match="exit code -9"):
        LocalEngine(2).run(die_once, jobs, print, stop)
    assert not multiprocessing.active_children()
