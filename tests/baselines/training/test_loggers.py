"""Weights & Biases, as far as it can be shown without it: a module that writes down its calls."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from baselines.cli import main
from baselines.runs.files import read_json
from baselines.training.train import train
from tests.support.runs import interrupted, small_config

pytestmark = pytest.mark.slow


class FakeRun:
    """A run of the library's: its arguments, its numbers, and whether it ended."""

    def __init__(self, **arguments: Any) -> None:
        self.arguments = arguments
        self.logged: list[tuple[int, dict[str, float]]] = []
        self.finished = False

    def log(self, values: dict[str, float], *, step: int) -> None:
        self.logged.append((step, values))

    def finish(self) -> None:
        self.finished = True


def test_resumed_run_is_logged_to_the_same_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs: list[FakeRun] = []
    config, out, module = small_config("ppo"), tmp_path / "run", ModuleType("wandb")

    def init(**arguments: Any) -> FakeRun:
        runs.append(FakeRun(**arguments))
        return runs[-1]

    module.init = init  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", module)
    interrupted(config, out, wandb="robots")
    assert not runs[0].finished
    run = train(config, out, wandb="robots", resume=True)
    first, second = (one.arguments for one in runs)
    assert (first["project"], first["name"], first["config"]) == ("robots", config.name, run.config)
    assert first["id"] == second["id"] == read_json(out / "wandb.json")["id"]
    assert second["resume"] == "allow" and runs[1].finished
    for one in runs:
        steps = [step for step, _ in one.logged]
        assert steps and steps == sorted(steps)
    values = {name: value for _, row in runs[1].logged for name, value in row.items()}
    assert values["evaluation/return_mean"] == run.evaluation["stochastic"]["return_mean"]
    assert values["training/seconds"] > 0.0


def test_without_the_package_nothing_is_begun(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    for command in (["train", "ippo", "field_03"], ["compare"]):
        assert main([*command, "--wandb", "robots", "--out", str(tmp_path / "out")]) == 2
        assert "wandb: " in capsys.readouterr().err
        assert not (tmp_path / "out").exists()
