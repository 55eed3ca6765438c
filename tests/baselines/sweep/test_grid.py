"""Many runs: each is trained once, resumed after kill -9, and stops no other."""

import multiprocessing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from baselines.cli import main
from baselines.runs.files import RunError, alone
from baselines.runs.folder import RunFolder
from baselines.sweep import run as sweep
from baselines.sweep.processes import Failure, LocalEngine
from baselines.sweep.run import TrainJob, runs_left, train_in_store, train_runs
from baselines.sweep.spec import runs_of
from baselines.training.config import TrainConfig
from mbn_marl.errors import ConfigError
from tests.support.dying import die_once
from tests.support.grids import BUDGET, TINY, run_here, spec_of
from tests.support.runs import recorded, same_policies

pytestmark = pytest.mark.slow


def test_runs_are_those_of_mbn_train_and_are_made_once(tmp_path, capsys):
    path, store = tmp_path / "grid.yaml", tmp_path / "runs"
    changes = {"settings": ["C"], "set": {"model.learning_rate": [0.01]}}
    path.write_text(yaml.safe_dump({"store": str(store), **TINY, **changes}))
    assert main(["grid", str(path), "--check"]) == 0
    names = ["a2c-A-learning_rate0.01-field_01-seed0", "a2c-C-learning_rate0.01-field_03-seed0"]
    listed = capsys.readouterr().out.splitlines()
    assert listed[0].startswith("2 runs, 0 of them done")
    assert listed[1:] == [f"{name}: not begun" for name in names]
    assert not store.exists()
    assert main(["grid", str(path), "--processes", "2"]) == 0
    runs = sorted(store.iterdir())
    assert [run.name for run in runs] == names
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
        run_here(changed)


def test_a_run_that_another_process_trains_is_left_to_it(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep, "PATIENCE", 0.1)
    spec = spec_of(tmp_path, seeds=[0, 1])
    held, free = (tmp_path / run.name for run in runs_of(spec))
    held.mkdir()
    with alone(held, "mbn grid"):
        outcomes = run_here(spec)
    assert [outcomes[place.name].state for place in (held, free)] == ["failed", "done"]
    assert "another mbn grid" in str(outcomes[held.name].error)
    source = replace(runs_of(spec)[0], transferred_from=held, setting="C")
    assert train_in_store(TrainJob(source, tmp_path), print).state == "failed"


def test_runs_that_begin_with_a_policy_of_the_zoo_are_resumed(tmp_path):
    smallest = {"num_worlds": 8, "rollout_steps": 2, "minibatches": 1, "memory": 2}
    how = {"steps": 32, "episodes": 1, "transferred_from": Path("zoo:generalist")}
    run = TrainConfig("mappo", "field_03", "G", hyperparameters=smallest, **how)
    (outcome,) = train_runs([run], tmp_path, LocalEngine(1)).values()
    assert outcome.state == "done" and runs_left([run], tmp_path) == []
    with pytest.raises(ConfigError, match="transferred_from: "):
        runs_left([replace(run, transferred_from=None)], tmp_path)


def test_a_process_that_dies_or_fails_fails_its_job_alone(tmp_path):
    jobs = [tmp_path / name for name in ("a", "b", "c", "bad")]
    for job in jobs[1:]:
        job.touch()
    done = []
    ended = {}
    LocalEngine(2).run(die_once, jobs, done.append, lambda job, end: ended.update({job.name: end}))
    assert sorted(done) == ["b", "c"]
    assert ended.pop("a") == Failure("a process died with exit code -9")
    assert "Traceback" in ended.pop("bad").error
    assert ended == {"b": 1, "c": 1}
    jobs[0].unlink()
    engine = LocalEngine(2, retries=1)
    engine.run(die_once, jobs, done.append, lambda job, end: ended.update({job.name: end}))
    assert sorted(done) == ["a", "b", "b", "c", "c"]
    assert ended["a"] == 1 and isinstance(ended["bad"], Failure)
    jobs[0].unlink()

    def stop(job: Path, end: Any) -> None:
        if isinstance(end, Failure):
            raise RunError(end.error)

    with pytest.raises(RunError, match="exit code -9"):
        LocalEngine(2).run(die_once, jobs, print, stop)
    assert not multiprocessing.active_children()
