"""Interrupted runs continue from their newest checkpoint as if nothing had happened."""

from __future__ import annotations

import os
import platform
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from baselines.algorithms import ALGORITHMS
from baselines.cli import main
from baselines.policies.trained import load_trained
from baselines.runs.files import RunError, read_json
from baselines.runs.folder import RunFolder
from baselines.training import run_logger as recorder
from baselines.training.progress_bar import Report
from baselines.training.train import prepare, train
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field, save_field
from tests.support.runs import STAGES, TinyRuns, interrupted, recorded, same_policies, small_config
from tests.support.terminal import MBN

pytestmark = pytest.mark.slow

FAMILIES = ("ppo", "ars", "tqc", "mappo", "ppo-shared")
"""An algorithm of each kind; the others share their trainers."""


def assert_equal(run: RunFolder, other: RunFolder) -> None:
    assert recorded(run) == recorded(other)
    assert same_policies(run, other)


@pytest.mark.parametrize(
    "name",
    [*FAMILIES, *(pytest.param(k, marks=pytest.mark.all) for k in ALGORITHMS if k not in FAMILIES)],
)
def test_a_resumed_run_equals_an_uninterrupted_one(
    name: str, tmp_path: Path, tiny_runs: TinyRuns
) -> None:
    config, stopped = small_config(name), tiny_runs.stopped(name, tmp_path / "run")
    torch.manual_seed(99)
    np.random.seed(99)
    resumed = train(config, stopped.path, resume=True)
    (history,) = read_json(resumed.path / "resumed.json")
    assert 0 < history["env_steps"] < config.steps
    assert_equal(resumed, tiny_runs.finished(name))
    budget = ALGORITHMS[name].budget(*prepare(config))
    least = budget.env_steps if budget.exact else config.steps
    assert least <= resumed.evaluation["env_steps"] <= budget.env_steps
    if STAGES.items() <= config.hyperparameters.items():
        sizes = [float(row["roi_radius"]) for row in recorded(resumed)["rows"]]
        assert 1.0 < sizes[0] < 4.0 and sizes[-1] == 1.0
    assert not (resumed.path / "checkpoints").exists()
    events = EventAccumulator(str(resumed.path / "tensorboard")).Reload()
    shown = [(event.step, event.value) for event in events.Scalars("evaluation/return_mean")]
    evaluated = [(entry["env_steps"], entry["return_mean"]) for entry in resumed.evaluations]
    assert shown == [(steps, pytest.approx(mean)) for steps, mean in evaluated]
    assert name != "tqc" or "train/critic_loss" in events.Tags()["scalars"]


def test_a_killed_process_is_resumed(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    words = "train ppo-shared field_03 --episodes 2 --steps 4000 --evaluate-every 500 --num-envs 2"
    sets = "--set action_repeat=[4,1] roi_radius=5.0 roi_success=[0.0,0.0] episode_steps=50"
    model = "model.n_steps=32 model.batch_size=64"
    arguments = [*words.split(), *sets.split(), *model.split(), "--out"]
    assert main([*arguments, str(whole)]) == 0
    command = [*MBN, *arguments, str(killed)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 600.0
        while not list(killed.glob("checkpoints/[0-9]*")):
            assert process.poll() is None, "the run ended before it could be interrupted"
            assert time.monotonic() < deadline, "no checkpoint appeared"
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert RunFolder.open(killed).unfinished is not None
    assert not (killed / "evaluation.json").exists()
    assert main([*arguments, str(killed), "--resume"]) == 0
    assert_equal(RunFolder.open(killed), RunFolder.open(whole))
    assert read_json(killed / "resumed.json")[0]["command"].endswith("--resume")
    assert not list(killed.glob(".*"))


def test_a_run_killed_before_its_first_checkpoint_begins_again(
    tmp_path: Path, tiny_runs: TinyRuns
) -> None:
    config, out = small_config("ppo"), tmp_path / "run"

    def interrupt(report: Report) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        train(config, out, listener=interrupt)
    (out / ".policy.abc").mkdir()
    assert (out / "progress.csv").exists() and not (out / "checkpoints").exists()
    for name in ("field.yaml", "versions.json"):
        (out / name).unlink()
    assert_equal(train(config, out, resume=True), tiny_runs.finished("ppo"))
    assert RunFolder.open(out).field == load_field("field_03") and (out / "versions.json").exists()
    assert not list(out.glob(".*"))


def test_slow_training_is_saved_between_evaluations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(recorder, "ROW_STEPS", 64)
    stopped = interrupted(replace(small_config("ppo"), evaluate_every=100_000), tmp_path / "run")
    assert stopped.checkpoint is not None and int(stopped.checkpoint.name) == 64
    assert stopped.evaluations == []


def test_a_checkpoint_that_fails_leaves_the_one_before(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    (tmp_path / "config.json").touch()
    with run.new_checkpoint(100) as folder:
        (folder / "part").write_text("whole")
    with pytest.raises(InterruptedError), run.new_checkpoint(200) as folder:
        (folder / "part").write_text("half")
        raise InterruptedError
    assert run.checkpoint == tmp_path / "checkpoints" / "000000000100"
    with run.new_checkpoint(1000) as folder:
        (folder / "part").write_text("newer")
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["000000001000"]


def test_a_policy_can_be_looked_at_before_the_run_is_finished(
    tmp_path: Path, tiny_runs: TinyRuns, capsys: pytest.CaptureFixture[str]
) -> None:
    stopped = tiny_runs.stopped("mappo", tmp_path / "run")
    load_trained(stopped)
    assert stopped.unfinished and "of 400 env-steps" in stopped.unfinished
    assert main(["evaluate", str(stopped.path), "--episodes", "1"]) == 0
    assert stopped.unfinished in capsys.readouterr().out
    with pytest.raises(RunError):
        _ = stopped.evaluation


def test_an_interrupted_run_says_where_it_can_be_resumed_and_gives_threads_back(
    tmp_path: Path,
) -> None:
    threads, during = torch.get_num_threads(), []

    def interrupt(report: Report) -> None:
        during.append(torch.get_num_threads())
        if (tmp_path / "run" / "checkpoints").exists():
            raise KeyboardInterrupt

    torch.set_num_threads(3)
    try:
        with pytest.raises(KeyboardInterrupt, match="--resume") as caught:
            train(small_config("ppo"), tmp_path / "run", listener=interrupt)
        assert torch.get_num_threads() == 3 and set(during) == {1}
    finally:
        torch.set_num_threads(threads)
    assert str(tmp_path / "run") in str(caught.value)


MEMORY = """
import numpy as np
from pathlib import Path
from baselines.training.train import keep_freed_memory

def held():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096

keep_freed_memory()
before, block = held(), np.ones(2**24)
del block
print(held() - before)
"""


@pytest.mark.all
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="malloc is another one")
def test_freed_memory_is_kept_for_the_next_update() -> None:
    ran = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True)
    assert int(ran.stdout) > 2**26  # half of the block


def test_a_finished_run_is_left_as_it_is(tmp_path: Path, tiny_runs: TinyRuns) -> None:
    stopped = tiny_runs.stopped("ppo", tmp_path / "run")
    run = train(small_config("ppo"), stopped.path, resume=True)
    before = {path: path.stat().st_mtime_ns for path in run.path.iterdir()}
    assert train(small_config("ppo"), run.path, resume=True).evaluation == run.evaluation
    assert {path: path.stat().st_mtime_ns for path in run.path.iterdir()} == before


def test_only_the_same_run_can_be_resumed(tmp_path: Path, tiny_runs: TinyRuns) -> None:
    config, stopped = small_config("ppo"), tiny_runs.stopped("ppo", tmp_path / "run")
    before = stopped.progress.read_bytes()
    with pytest.raises(ConfigError) as caught:
        train(replace(config, seed=5, steps=500), stopped.path, resume=True)
    assert [line.split(":")[0] for line in caught.value.problems] == ["seed", "steps"]
    with pytest.raises(RunError):
        train(config, tmp_path / "nothing", resume=True)
    save_field(load_field("field_04"), stopped.path / "field.yaml")
    with pytest.raises(ConfigError, match="field"):
        train(config, stopped.path, resume=True)
    assert stopped.progress.read_bytes() == before and stopped.checkpoint is not None


def test_a_run_that_another_process_trains_is_left_alone(tmp_path: Path) -> None:
    config, out, refused = small_config("ppo"), tmp_path / "run", []

    def interfere(report: Report) -> None:
        for options in ({"resume": True}, {"force": True}):
            with pytest.raises(RunError, match=f"{out}.*process {os.getpid()} on"):
                train(config, out, **options)
            refused.append(options)
        raise InterruptedError

    with pytest.raises(InterruptedError):
        train(config, out, listener=interfere)
    assert len(refused) == 2 and [path.name for path in tmp_path.iterdir()] == ["run"]


@contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """No file can grow beyond ``size`` bytes, as on a disk that is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("name", ["mappo", "ppo"])
def test_a_full_disk_leaves_the_checkpoint_before(
    name: str, tmp_path: Path, tiny_runs: TinyRuns
) -> None:
    run = tiny_runs.stopped(name, tmp_path / "run")
    kept: Any = run.checkpoint
    before = {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()}
    for size in (0, 300, 3_000):
        with files_up_to(size), pytest.raises(RunError, match=str(run.path)):
            train(small_config(name), run.path, resume=True)
        assert run.checkpoint == kept
        assert {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()} == before
    assert_equal(train(small_config(name), run.path, resume=True), tiny_runs.finished(name))
    assert not list(run.path.glob(".*"))
