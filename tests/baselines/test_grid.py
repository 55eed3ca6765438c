"""Grids: what a file stands for, and runs that end once, whatever happens on the way."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from rich.console import Console

from baselines.cli import main
from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.sweep import store as stores
from baselines.sweep import worker as work
from baselines.sweep.processes import work_all
from baselines.sweep.run import Grid, run_grid
from baselines.sweep.spec import GridSpec, cells_of, read_spec
from baselines.sweep.status import Status, duration, show
from baselines.sweep.store import FolderStore, RemoteStore, State, open_store
from baselines.sweep.worker import Assignment, Outcome, work_on_cell
from baselines.training.progress_bar import Report
from baselines.training.train import train
from benchmarks import capacity
from mbn_marl.errors import ConfigError
from tests.support.dying import die_once
from tests.support.pages import ROOT, blocks_of, write_file
from tests.support.runs import recorded, same_policies

BUDGET = {"steps": 60, "evaluate_every": 20, "episodes": 1}
TINY: dict[str, Any] = {
    "algorithms": ["a2c"],
    "fields": ["field_03"],
    "settings": ["A"],
    "seeds": [0],
    "budget": BUDGET,
    "resources": {"upload_seconds": 0},
}


def spec_of(store: Path | str, **changes: Any) -> GridSpec:
    """A grid of tiny runs."""
    return GridSpec.model_validate({"store": str(store), **TINY, **changes})


def names_of(**changes: Any) -> list[str]:
    return [cell.name for cell in cells_of(spec_of("runs", **changes))]


def run_here(grid: Grid, processes: int = 1) -> dict[str, Outcome]:
    """Run a grid by the local engine; how each cell ended."""
    outcomes: dict[str, Outcome] = {}

    def listen(outcome: Outcome) -> None:
        assert outcome.name not in outcomes, "a cell ended twice"
        outcomes[outcome.name] = outcome

    run_grid(grid, engine="local", processes=processes, listener=listen)
    return outcomes


# What a file stands for


def test_the_examples_are_what_the_page_says(tmp_path: Path) -> None:
    for block in blocks_of(ROOT / "docs" / "grid.md"):
        write_file(block, tmp_path)
    cells = cells_of(read_spec(tmp_path / "paper.yaml"))
    assert len(cells) == 180
    assert {cell.config.steps for cell in cells} == {5_000_000}
    seen: set[str] = set()
    for cell in cells:
        assert cell.source is None or cell.source in seen, "a run stands before its source"
        seen.add(cell.name)
    names = [cell.name for cell in cells_of(read_spec(tmp_path / "winds.yaml"))]
    assert len(names) == 48 and "mappo-2robots-wind0.1+30-field_03-seed1" in names


def test_axes_multiply_and_name_the_runs() -> None:
    names = names_of(
        algorithms=["ppo", "mappo"],
        settings=["A", "N"],
        robots=[2, 3],
        seeds=[4, 5],
        set={"environment.wind": [[0.1, 30]]},
    )
    assert len(names) == len(set(names)) == 3 * 2 * 2
    assert names[0] == "ppo-A-2robots-wind0.1+30-field_03-seed4"
    assert "mappo-3robots-wind0.1+30-field_03-seed5" in names
    cell = cells_of(spec_of("runs", robots=[2], set={"model.gamma": [0.9]}))[0]
    assert cell.config.environment == {"n_robots": 2}
    assert cell.config.hyperparameters == {"model": {"gamma": 0.9}}
    assert cell.learner == "a2c-A-2robots-gamma0.9"


def test_setting_c_brings_the_run_it_begins_with() -> None:
    assert names_of(settings=["C"]) == ["a2c-A-field_01-seed0", "a2c-C-field_03-seed0"]
    both = names_of(settings=["A", "C"], fields=["field_01", "field_03"])
    assert len(both) == 4 and both[:2] == ["a2c-A-field_01-seed0", "a2c-A-field_03-seed0"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algorithms": []}, "algorithms: "),
        (
            {"algorithm": ["ppo"]},
            "algorithm: unknown name (did you mean algorithms?)",
        ),
        ({"algorithms": ["ppo", "ppo"]}, "algorithms: ppo is given twice"),
        ({"algorithms": ["sac"]}, "sac: unknown algorithm; known: a2c"),
        ({"algorithms": ["mappo"]}, "settings: mappo has N, and none is asked for"),
        ({"fields": ["field_00"]}, "known: field_01"),
        ({"settings": ["D"]}, "settings.0: "),
        ({"seeds": [-1]}, "seed: must be at least 0"),
        ({"robots": [2, 9]}, "robots: field_03 has 3 starts, not 9"),
        ({"set": {"model.gama": [1]}}, "model.gama: unknown name"),
        ({"set": {"model.gamma": [2]}}, "model.gamma: must be a finite number"),
        ({"set": {"model.gamma": [0.9, 0.9]}}, "set.model.gamma: 0.9 is given twice"),
        ({"robots": [2], "set": {"environment.n_robots": [3]}}, "set: environment.n_robots is"),
        ({"set": {"environment.wind": [7]}}, "wind"),
        ({"budget": {"steps": 0}}, "budget.steps: "),
        ({"resources": {"cpus": 0}}, "resources.cpus: "),
        ({"resources": {"retries": -1}}, "resources.retries: "),
        ({"store": "nowhere://bucket"}, "store: nowhere://bucket: "),
    ],
)
def test_wrong_values_are_named_and_nothing_is_made(
    changes: dict[str, Any], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "grid.yaml"
    path.write_text(yaml.safe_dump({"store": str(tmp_path / "runs"), **TINY, **changes}))
    assert main(["grid", str(path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("mbn: error: ") and message in error
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "SPEC: one file is needed, not 0"),
        (["status"], "SPEC: one file is needed, not 0"),
        (["nothing.yaml"], "nothing.yaml: 1 problem"),
        (["a.yaml", "--address", "here:1"], "address: allowed with --engine ray"),
        (["a.yaml", "--processes", "0"], "processes: at least 1"),
        (["a.yaml", "--out", "runs"], "out: needed by fetch, and allowed there alone"),
        (["fetch", "a.yaml"], "out: needed by fetch"),
    ],
)
def test_wrong_commands(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["grid", *words]) == 2
    assert message in capsys.readouterr().err


# Runs


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
    capsys.readouterr()
    for run in runs:
        words = (run / "command.txt").read_text().split()
        same = tmp_path / f"same-{run.name}"
        assert main([*words[1:], "--out", str(same)]) == 0
        assert recorded(RunFolder(same)) == recorded(RunFolder(run))
        assert same_policies(RunFolder(same), RunFolder(run))
        ours, theirs = RunFolder(run).config, RunFolder(same).config
        assert ours == theirs
    before = {file: file.stat().st_mtime_ns for file in store.rglob("*")}
    capsys.readouterr()
    assert main(["grid", str(path)]) == 0
    assert "2 runs, 2 of them done" in capsys.readouterr().out
    assert {file: file.stat().st_mtime_ns for file in store.rglob("*")} == before
    assert main(["report", "--paper", str(store), "-o", str(tmp_path / "report")]) == 0
    changed = spec_of(store, **changes, budget={**BUDGET, "episodes": 2})
    with pytest.raises(ConfigError, match="episodes: the run has 1, the grid 2"):
        run_here(Grid.of(changed))


def test_a_cell_that_breaks_down_stops_no_other(tmp_path: Path) -> None:
    wild = {"model.learning_rate": [1e30, 1e-4], "model.max_grad_norm": [1e30]}
    grid = Grid.of(spec_of(tmp_path, set=wild, budget={**BUDGET, "steps": 100}))
    with pytest.raises(RunError, match=r"(?s)1 of 2 cells were done.*the learner broke down"):
        run_here(grid)
    status = Status.of(grid)
    assert [one.standing for one in status.cells] == ["failed", "done"]
    assert status.cells[0].state is not None and status.cells[0].state.attempt == 1
    with pytest.raises(RunError, match="0 of 1 cells were done"):
        run_here(grid)  # tried again, and only that
    states = grid.store.states()
    assert [states[name].attempt for name in grid.names] == [2, 1]


def test_a_worker_that_is_killed_fails_its_job_alone(tmp_path: Path) -> None:
    jobs = [tmp_path / name for name in "abcd"]
    for job in jobs[1:]:
        job.touch()
    failures: list[tuple[int, str]] = []
    done: list[str] = []

    def again(place: int, error: str) -> bool:
        failures.append((place, error))
        return True

    work_all(die_once, jobs, 2, done.append, failed=again)
    assert failures == [(0, "a process died with exit code -9")]
    assert sorted(done) == ["a", "b", "c", "d"]
    jobs[0].unlink()
    with pytest.raises(RunError, match="a process died with exit code -9"):
        work_all(die_once, jobs, 2, done.append)


def test_a_job_waits_for_the_one_before_it(tmp_path: Path) -> None:
    jobs = [tmp_path / name for name in "abc"]
    for job in jobs:
        job.touch()
    done: list[str] = []
    work_all(die_once, jobs, 2, done.append, after=[2, None, 1])
    assert done == ["b", "c", "a"]


# Interrupted, on this machine or another


def _stop_after_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the process of a cell seem to vanish once its checkpoint is kept."""
    whole = work.Claim.__call__

    def vanish(claim: work.Claim, report: Report) -> None:
        whole(claim, report)
        if claim._run.checkpoint is not None:
            claim._over.set()
            claim.end = lambda *_: None  # type: ignore[method-assign]
            raise InterruptedError

    monkeypatch.setattr(work.Claim, "__call__", vanish)


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


def assign(grid: Grid, place: int, call: str) -> Assignment:
    return Assignment(grid.cells[place], grid.place, call, upload_seconds=0.0)


def test_another_machine_goes_on_where_one_was_lost(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = Grid.of(spec_of(place, settings=["C"]))
    ended: list[Any] = []
    work_on_cell(assign(grid, 0, "first"), ended.append)
    with monkeypatch.context() as patch, pytest.raises(InterruptedError):
        _stop_after_checkpoint(patch)
        work_on_cell(assign(grid, 1, "first"), ended.append)
    state = grid.store.state(grid.names[1])
    assert state is not None and state.alive
    assert [one.standing for one in Status.of(grid).cells] == ["done", "running"]
    use_machine(tmp_path / "machine-2", monkeypatch)
    grid = Grid.of(grid.spec)
    work_on_cell(assign(grid, 1, "second"), ended.append)
    assert ended[-1].state == "elsewhere", "another call may not take a living cell"
    work_on_cell(assign(grid, 1, "first"), ended.append)
    outcomes = [message.state for message in ended if isinstance(message, Outcome)]
    assert outcomes == ["done", "elsewhere", "done"]
    out = tmp_path / "store"
    if isinstance(grid.store, RemoteStore):
        out = tmp_path / "fetched"
        stores.fetch_all(grid.store, grid.names, out)
        left = [path.name for path in (tmp_path / "store" / ".grid").iterdir()]
        assert sorted(left) == sorted(f"{name}.json" for name in grid.names), "archives are left"
    resumed = RunFolder(out / grid.names[1])
    history = json.loads((resumed.path / "resumed.json").read_text())
    assert [entry["env_steps"] > 0 for entry in history] == [True]
    source, config = RunFolder(out / grid.names[0]), grid.cells[1].config
    whole = train(replace(config, transferred_from=source.path), tmp_path / "whole")
    assert recorded(resumed) == recorded(whole)
    assert same_policies(resumed, whole)
    after = grid.store.state(grid.names[1])
    assert after is not None and (after.state, after.attempt) == ("done", 2)


def test_an_older_attempt_stops_and_spoils_nothing(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stores, "BEAT", 0.01)
    grid = Grid.of(spec_of(place, budget={**BUDGET, "steps": 100_000}))
    ended: list[Any] = []
    taken: list[State] = []
    whole = work.Claim.__call__

    def take_over(claim: work.Claim, report: Report) -> None:
        known = grid.store.state(grid.names[0])
        assert known is not None
        if not taken:
            taken.append(known.model_copy(update={"attempt": known.attempt + 1}))
            grid.store.note(grid.names[0], taken[0])
        time.sleep(0.02)
        whole(claim, report)

    monkeypatch.setattr(work.Claim, "__call__", take_over)
    work_on_cell(assign(grid, 0, "call"), ended.append)
    outcomes = [message.state for message in ended if isinstance(message, Outcome)]
    assert outcomes == ["elsewhere"]
    assert grid.store.state(grid.names[0]) == taken[0]
    assert not grid.store.finished(grid.names)


def test_a_damaged_checkpoint_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_machine(tmp_path / "machine-1", monkeypatch)
    grid = Grid.of(spec_of((tmp_path / "store").as_uri()))
    with monkeypatch.context() as patch, pytest.raises(InterruptedError):
        _stop_after_checkpoint(patch)
        work_on_cell(assign(grid, 0, "first"), print)
    (archive,) = (tmp_path / "store" / ".grid").glob("*.zip")
    data = bytearray(archive.read_bytes())
    data[len(data) // 2] ^= 1
    archive.write_bytes(data)
    use_machine(tmp_path / "machine-2", monkeypatch)
    ended: list[Any] = []
    work_on_cell(assign(Grid.of(grid.spec), 0, "first"), ended.append)
    assert ended[0].state == "failed" and "the checkpoint is damaged" in (ended[0].error or "")


def test_a_killed_grid_goes_on_with_the_same_command(tmp_path: Path) -> None:
    path, store = tmp_path / "grid.yaml", tmp_path / "runs"
    changes = {"seeds": [0, 1], "budget": {"steps": 1500, "evaluate_every": 300, "episodes": 1}}
    path.write_text(yaml.safe_dump({"store": str(store), **TINY, **changes}))
    words = [sys.executable, "-m", "mbn_marl", "grid", str(path), "--processes", "1"]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 120.0
    while not list(store.glob("*/checkpoints/0*")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    process.kill()
    process.wait()
    time.sleep(1.0)  # the worker ends at its next report
    notes = FolderStore(store)
    for name, state in notes.states().items():  # as if a minute had gone by
        notes.note(name, state.model_copy(update={"updated": 0.0}))
    grid = Grid.of(read_spec(path))
    assert [one.standing for one in Status.of(grid).cells] == ["waiting", "waiting"]
    run_here(grid)
    assert [one.standing for one in Status.of(grid).cells] == ["done", "done"]
    history = json.loads((store / grid.names[0] / "resumed.json").read_text())
    assert history[0]["env_steps"] > 0
    whole = train(grid.cells[0].config, tmp_path / "whole")
    assert recorded(RunFolder(store / grid.names[0])) == recorded(whole)


# How it stands


def _state(**changes: Any) -> State:
    values = {"grid": "g", "attempt": 1, "machine": "m1", "process": 7, "updated": time.time()}
    return State.model_validate({"state": "running", **values, **changes})


def test_what_is_left_is_estimated_from_what_is_known(tmp_path: Path) -> None:
    grid = Grid.of(
        spec_of(tmp_path, algorithms=["a2c", "ppo"], seeds=[0, 1], budget={"steps": 1000})
    )
    assert Status.of(grid).seconds_left() is None
    a2c, ppo = grid.names[0], grid.names[1]
    grid.store.note(a2c, _state(env_steps=500, steps_per_second=10.0))
    grid.store.note(ppo, _state(env_steps=0, steps_per_second=0.0))
    status = Status.of(grid)
    # 500 + 1000 steps of A2C at 10/s, 2 x 1000 of PPO, of which nothing is known, too; two at once.
    assert status.seconds_left() == pytest.approx((1500 + 2000) / 10.0 / 2)
    grid.store.note(ppo, _state(state="failed", error="no [b]memory[/b]\nmore", env_steps=7))
    lost = grid.names[2]
    grid.store.note(lost, _state(updated=time.time() - stores.LOST - 1.0))
    status = Status.of(grid)
    assert [one.standing for one in status.cells] == ["running", "failed", "waiting", "waiting"]
    console = Console(width=100, file=io.StringIO(), record=True)
    console.print(show(status))
    text = console.export_text()
    assert "a2c-A-field_03-seed0 (m1): 50%" in text
    assert f"{ppo} (failed): no [b]memory[/b]" in text and "more" not in text
    assert "with 1 at a time" in text


def test_status_is_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "grid.yaml"
    path.write_text(yaml.safe_dump({"store": str(tmp_path / "runs"), **TINY}))
    assert main(["grid", "status", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    row = next(line.split() for line in lines if "a2c-A" in line)
    assert row == ["a2c-A", "0", "0", "0", "1", "0%"]
    (tmp_path / "runs" / ".grid").mkdir(parents=True)
    (tmp_path / "runs" / ".grid" / "a2c-A-field_03-seed0.json").write_text("{")
    assert main(["grid", "status", str(path)]) == 2
    assert "a2c-A-field_03-seed0.json is not a note of a grid" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("seconds", "words"), [(59.6, "60 s"), (600, "10 min"), (9000, "2.5 h"), (3e5, "3.5 days")]
)
def test_duration(seconds: float, words: str) -> None:
    assert duration(seconds) == words


def test_a_path_and_a_url_are_stores_of_their_kind(tmp_path: Path) -> None:
    kinds: Mapping[str, type] = {str(tmp_path): FolderStore, "memory://runs": RemoteStore}
    assert {place: type(open_store(place)) for place in kinds} == kinds


def test_capacity_counts_what_has_to_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capacity, "SPEEDS", {"a2c": 2.0})
    budget = {"steps": 20}
    chain = cells_of(spec_of("runs", settings=["C"], budget=budget))
    assert [capacity.makespan(chain, workers) for workers in (1, 5)] == [20.0, 20.0]
    three = cells_of(spec_of("runs", seeds=[0, 1, 2], budget=budget))
    assert [capacity.makespan(three, workers) for workers in (1, 2, 3)] == [30.0, 20.0, 10.0]
