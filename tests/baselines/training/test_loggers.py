"""Weights & Biases, as far as it can be shown without it: a module that writes down its calls."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from baselines.cli import main
from baselines.runs.files import read_json
from baselines.training.config import TrainConfig
from baselines.training.progress_bar import Report
from baselines.training.train import train

CONFIG = TrainConfig(
    "ippo",
    "field_03",
    steps=320,
    evaluate_every=128,
    episodes=2,
    hyperparameters={"num_worlds": 4, "rollout_steps": 16, "hidden": [8], "action_repeat": [1, 1]},
)


class FakeRun:
    """A run of the library's: what it was begun with, what it was told, and whether it ended."""

    def __init__(self, arguments: dict[str, Any]) -> None:
        self.arguments = arguments
        self.logged: list[tuple[int, dict[str, float]]] = []
        self.finished = False

    def log(self, values: dict[str, float], *, step: int) -> None:
        self.logged.append((step, values))

    def finish(self) -> None:
        self.finished = True


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[FakeRun]:
    """The runs that are begun."""
    begun: list[FakeRun] = []

    def init(**arguments: Any) -> FakeRun:
        begun.append(FakeRun(arguments))
        return begun[-1]

    module = ModuleType("wandb")
    module.init = init  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", module)
    return begun


def test_a_run_is_logged_to_the_project(runs: list[FakeRun], tmp_path: Path) -> None:
    run = train(CONFIG, tmp_path / "run", wandb="robots")
    (logged,) = runs
    assert logged.finished
    assert (logged.arguments["project"], logged.arguments["name"]) == ("robots", CONFIG.name)
    assert logged.arguments["config"] == run.config
    values: dict[str, float] = {}
    for _, row in logged.logged:
        values |= row
    assert values["evaluation/return_mean"] == run.evaluation["stochastic"]["return_mean"]
    assert values["training/seconds"] > 0.0
    assert [step for step, _ in logged.logged] == sorted(step for step, _ in logged.logged)


def test_an_interrupted_run_goes_on_in_the_same_one(runs: list[FakeRun], tmp_path: Path) -> None:
    out = tmp_path / "run"

    def interrupt(report: Report) -> None:
        if (out / "checkpoints").exists():
            raise InterruptedError

    with pytest.raises(InterruptedError):
        train(CONFIG, out, wandb="robots", listener=interrupt)
    assert not runs[0].finished
    train(CONFIG, out, wandb="robots", resume=True)
    assert runs[1].arguments["id"] == runs[0].arguments["id"] == read_json(out / "wandb.json")["id"]
    assert runs[1].arguments["resume"] == "allow"
    assert runs[1].finished


@pytest.mark.parametrize("command", [["train", "ippo", "field_03"], ["compare"]])
def test_without_the_package_nothing_is_begun(
    command: list[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert main([*command, "--wandb", "robots", "--out", str(tmp_path / "out")]) == 2
    assert "wandb: the package is not installed; pip install wandb" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_nothing_is_logged_unless_asked_for(runs: list[FakeRun], tmp_path: Path) -> None:
    train(CONFIG, tmp_path / "run")
    assert not runs
    assert list((tmp_path / "run" / "tensorboard").iterdir())
