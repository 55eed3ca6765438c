"""Interrupted runs continue from their newest checkpoint as if nothing had happened."""

from __future__ import annotations

import json
import os
import platform
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from baselines.algorithms import ALGORITHMS
from baselines.cli import main
from baselines.evaluation.policy import load_trained
from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.training import run_logger as recorder
from baselines.training.config import TrainConfig
from baselines.training.progress_bar import Report
from baselines.training.train import train
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field, save_field
from tests.support.runs import interrupted, recorded, same_policies

SMALL = {"policy_kwargs": {"net_arch": [8]}}
REPLAY = {**SMALL, "learning_starts": 100, "batch_size": 16, "buffer_size": 150}
"""The buffer is full and the warm-up is over when the run is interrupted."""
AIDS = {
    **{"roi_radius": 4.0, "scattered": 0.5},
    **{"action_repeat": [2, 1], "action_repeat_until": 0.5},
}
AIDED = ("trpo", "ppo-shared")
"""Those of Stable-Baselines3 with aids; ROIs shrink before and after the interruption."""
MODELS: dict[str, dict[str, Any]] = {
    "a2c": SMALL,
    "ppo": {**SMALL, "n_steps": 32, "batch_size": 32, "learning_rate": {"from": 0.01, "to": 0.001}},
    "trpo": {**SMALL, "n_steps": 32, "batch_size": 32},
    "ars": {"n_delta": 1, "n_top": 1, "learning_rate": {"from": 0.1, "to": 0.01}},
    "crossq": {**REPLAY, "gradient_steps": 2},
    "tqc": REPLAY,
    "ppo-shared": {**SMALL, "n_steps": 32, "batch_size": 32},
    "ppo-supersuit": {**SMALL, "n_steps": 32, "batch_size": 32},
}


def _config(name: str, **changes: Any) -> TrainConfig:
    """A run of a few updates with a checkpoint on the way."""
    if ALGORITHMS[name].package == "torchrl":
        small = {"num_worlds": 4, "rollout_steps": 16, "hidden": [8, 8]}
        small |= AIDS
        config = TrainConfig(name, "field_03", steps=320, evaluate_every=128, episodes=2)
        return replace(config, hyperparameters=small, **changes)
    envs = 1 if name == "ars" else 2
    hyperparameters = {"num_envs": envs, "model": MODELS[name]}
    if name != "ars":
        hyperparameters["policy"] = "MlpPolicy"
    if name in AIDED:
        hyperparameters |= {**AIDS, "roi_stages": 3, "roi_success": [0.0, 0.0]}
    return TrainConfig(
        name,
        "field_03",
        steps=400,
        evaluate_every=150,
        episodes=2,
        environment={"max_steps": 50, "random_starts": True},
        hyperparameters=hyperparameters,
        **changes,
    )


def _assert_equal(run: RunFolder, other: RunFolder) -> None:
    assert recorded(run) == recorded(other)
    assert same_policies(run, other)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_resumed_run_equals_an_uninterrupted_one(name: str, tmp_path: Path) -> None:
    config = _config(name)
    whole = train(config, tmp_path / "whole")
    stopped = interrupted(config, tmp_path / "resumed")
    torch.manual_seed(99)
    np.random.seed(99)
    resumed = train(config, stopped.path, resume=True)
    history = json.loads((resumed.path / "resumed.json").read_text())
    assert 0 < history[0]["env_steps"] < config.steps
    if name in AIDED:
        sizes = [row["roi_radius"] for row in recorded(resumed)["rows"]]
        assert len(sizes) == 3 and 1.0 < float(sizes[0]) < 4.0 and sizes[-1] == "1"
    _assert_equal(resumed, whole)
    assert not (resumed.path / "checkpoints").exists()


def _start(arguments: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "mbn_marl", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def _wait_for_checkpoint(folder: Path, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 120.0
    while not list(folder.glob("checkpoints/[0-9]*")):
        assert process.poll() is None, "the run ended before it could be interrupted"
        assert time.monotonic() < deadline, "no checkpoint appeared"
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("name", "number", "code", "options"),
    [
        ("tqc", signal.SIGKILL, -9, "--steps 800 --evaluate-every 200 --num-envs 2"),
        ("mappo", signal.SIGKILL, -9, "--steps 3000 --evaluate-every 500 --num-envs 2"),
        ("ppo-shared", signal.SIGKILL, -9, "--steps 4000 --evaluate-every 500 --num-envs 2"),
        ("a2c", signal.SIGTERM, 130, "--steps 4000 --evaluate-every 800 --setting A"),
    ],
)
def test_a_killed_process_is_resumed(
    name: str, number: signal.Signals, code: int, options: str, tmp_path: Path
) -> None:
    arguments = ["train", name, "field_03", "--episodes", "2", *options.split()]
    if name == "tqc":
        block = {"normalize_observation": True, "reward_scale": 5e-5, "model": REPLAY}
        hyperparams = tmp_path / "small.yaml"
        hyperparams.write_text(yaml.safe_dump({"N": block}))
        arguments += ["--hyperparams", str(hyperparams)]
    elif name == "ppo-shared":
        arguments += ["--set", "action_repeat=[4,1]", "roi_radius=5.0", "roi_success=[0.0,0.0]"]
        arguments += ["episode_steps=50", "model.n_steps=32", "model.batch_size=64"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert main([*arguments, "--out", str(whole)]) == 0
    again = [*arguments, "--out", str(killed)]
    process = _start(again)
    try:
        _wait_for_checkpoint(killed, process)
        process.send_signal(number)
        _, error = process.communicate(timeout=60)
        assert process.returncode == code
        assert "Traceback" not in error
        stopped = RunFolder.open(killed)
        assert stopped.unfinished is not None
        if code == 130:
            assert (
                error == f"interrupted: {killed} is {stopped.unfinished}; continue with --resume\n"
            )
    finally:
        process.kill()
    assert not (killed / "evaluation.json").exists()
    assert main([*again, "--resume"]) == 0
    _assert_equal(RunFolder.open(killed), RunFolder.open(whole))
    history = json.loads((killed / "resumed.json").read_text())
    assert history[0]["env_steps"] > 0
    assert history[0]["command"].endswith("--resume")
    assert not list(killed.glob(".*"))


def test_a_run_killed_before_its_first_checkpoint_begins_again(tmp_path: Path) -> None:
    config = _config("ppo")
    whole = train(config, tmp_path / "whole")

    def interrupt(report: Report) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        train(config, tmp_path / "run", listener=interrupt)
    (tmp_path / "run" / ".policy.abc").mkdir()
    assert (tmp_path / "run" / "progress.csv").exists()
    assert not (tmp_path / "run" / "checkpoints").exists()
    _assert_equal(train(config, tmp_path / "run", resume=True), whole)
    assert not list((tmp_path / "run").glob(".*"))


def test_tensorboard_shows_every_step_once(tmp_path: Path) -> None:
    config = _config("tqc")
    stopped = interrupted(config, tmp_path / "run")
    run = train(config, stopped.path, resume=True)
    events = EventAccumulator(str(run.path / "tensorboard")).Reload()
    shown = [(event.step, event.value) for event in events.Scalars("evaluation/return_mean")]
    expected = [(entry["env_steps"], entry["return_mean"]) for entry in run.evaluations]
    assert [step for step, _ in shown] == [step for step, _ in expected]
    assert [value for _, value in shown] == pytest.approx([value for _, value in expected])
    assert "train/critic_loss" in events.Tags()["scalars"]


def test_slow_training_is_saved_between_evaluations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(recorder, "ROW_STEPS", 64)
    config = replace(_config("ppo"), evaluate_every=100_000)
    stopped = interrupted(config, tmp_path / "run")
    assert stopped.checkpoint is not None and int(stopped.checkpoint.name) == 64
    assert stopped.evaluations == []


def test_a_checkpoint_that_fails_leaves_the_one_before(tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
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
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stopped = interrupted(_config("ippo"), tmp_path / "run")
    load_trained(stopped)
    assert stopped.unfinished == "unfinished: checkpoint at 128 of 320 env-steps"
    assert main(["evaluate", str(stopped.path), "--episodes", "1"]) == 0
    assert stopped.unfinished in capsys.readouterr().out
    with pytest.raises(RunError, match="is not a finished run"):
        _ = stopped.evaluation


def test_an_interrupted_run_says_where_it_can_be_resumed(tmp_path: Path) -> None:
    out = tmp_path / "run"

    def interrupt(report: Report) -> None:
        if (out / "checkpoints").exists():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        train(_config("mappo"), out, listener=interrupt)
    where = f"{out} is unfinished: checkpoint at 128 of 320 env-steps"
    assert str(caught.value) == f"{where}; continue with --resume"


def test_torch_has_its_threads_again_after_a_run(tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    during: list[int] = []
    torch.set_num_threads(3)
    try:
        train(
            _config("ippo"),
            tmp_path / "run",
            listener=lambda report: during.append(torch.get_num_threads()),
        )
        interrupted(_config("ippo"), tmp_path / "interrupted")
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)
    assert set(during) == {1}


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


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="malloc is another one")
def test_freed_memory_is_kept_for_the_next_update() -> None:
    ran = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True)
    assert int(ran.stdout) > 2**26  # half of the block


def test_a_finished_run_is_left_as_it_is(tmp_path: Path) -> None:
    config = _config("a2c")
    run = train(config, tmp_path / "run")
    before = {path: path.stat().st_mtime_ns for path in run.path.iterdir()}
    assert train(config, run.path, resume=True).evaluation == run.evaluation
    assert {path: path.stat().st_mtime_ns for path in run.path.iterdir()} == before


def test_only_the_same_run_can_be_resumed(tmp_path: Path) -> None:
    config = _config("a2c")
    stopped = interrupted(config, tmp_path / "run")
    before = stopped.progress.read_bytes()
    with pytest.raises(ConfigError) as caught:
        train(replace(config, seed=5, steps=500), stopped.path, resume=True)
    assert [line.split(":")[0] for line in caught.value.problems] == ["seed", "steps"]
    assert "recorded is 0, asked for is 5" in caught.value.problems[0]
    with pytest.raises(RunError, match="is not a run folder"):
        train(config, tmp_path / "nothing", resume=True)
    assert stopped.progress.read_bytes() == before
    assert stopped.checkpoint is not None


def test_a_field_that_was_edited_meanwhile_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    save_field(load_field("field_03"), path)
    config = replace(_config("a2c"), field=str(path))
    stopped = interrupted(config, tmp_path / "run")
    save_field(load_field("field_04"), path)
    with pytest.raises(ConfigError, match="it has changed since the run was started"):
        train(config, stopped.path, resume=True)
    save_field(load_field("field_03"), path)
    assert train(config, stopped.path, resume=True).finished


def test_a_run_at_work_is_left_alone(tmp_path: Path) -> None:
    config, out = _config("a2c"), tmp_path / "run"
    refused: list[str] = []

    def interfere(report: Report) -> None:
        for options in ({"resume": True}, {"force": True}):
            with pytest.raises(RunError, match=r"another mbn.* is running here") as caught:
                train(config, out, **options)
            refused.append(str(caught.value))
        raise InterruptedError

    with pytest.raises(InterruptedError):
        train(config, out, listener=interfere)
    holder = f"process {os.getpid()} on {socket.gethostname()} since 20"
    assert all(f"{out}: another mbn train ({holder}" in problem for problem in refused)
    assert len(refused) == 2
    assert train(config, out, resume=True).finished
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
