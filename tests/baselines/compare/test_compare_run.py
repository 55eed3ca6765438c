"""Training what is compared: interrupted, resumed, and when a learner diverges."""

import json
from unittest.mock import Mock

import pandas
import pytest

from baselines.cli import main
from baselines.compare.run import train_all_runs
from baselines.compare.summary import summarise
from baselines.runs.files import RunError, read_json, write_json
from baselines.training.config import DivergenceError
from baselines.training.run_logger import Report
from mbn_marl.errors import ConfigError
from tests.support.problems import places_of
from tests.support.records import CONFIG, TINY

pytestmark = pytest.mark.slow


def test_an_interrupted_comparison_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr("baselines.compare.report.write_episode", lambda *drawn: None)
    out = tmp_path / "comparison"
    second = out / CONFIG.runs()[1].name

    def interrupt(report: Report) -> None:
        if report.run == second.name and (second / "checkpoints").exists():
            raise InterruptedError

    with pytest.raises(InterruptedError):
        train_all_runs(CONFIG, out, command="mbn compare", processes=1, listener=interrupt)
    first = out / CONFIG.runs()[0].name / "evaluation.json"
    finished_at = first.stat().st_mtime_ns
    killed = out / CONFIG.runs()[2].name
    killed.mkdir()
    (killed / ".config.json.x").touch()  # as a process leaves it that is killed at once
    results = train_all_runs(CONFIG, out, command="mbn compare", processes=1, resume=True)
    assert (results.labels, results.seeds) == (("mappo-tiny", "ippo-tiny"), 2)
    assert first.stat().st_mtime_ns == finished_at
    assert read_json(second / "resumed.json")[0]["env_steps"] > 0
    assert not (killed / "resumed.json").exists()
    config = read_json(second / "config.json")
    assert (config["label"], config["hyperparameters"]["num_worlds"]) == ("ippo-tiny", 4)
    page = tmp_path / "docs" / "found.md"
    words = ["report", "--comparison", str(out), "-o", str(page)]
    assert main([*words, "--marl-eval", str(tmp_path / "marl.json")]) == 0
    tasks = read_json(tmp_path / "marl.json")["mbn_marl"]
    assert {*tasks["field_03"]["mappo-tiny"]} == {"seed_0", "seed_1"}
    table = pandas.read_csv(page.parent / "found" / "runs.csv")
    assert [*table.label] == ["mappo-tiny"] * 2 + ["ippo-tiny"] * 2 and not table.passed.any()
    curves = pandas.read_csv(page.parent / "found" / "curves.csv")
    assert [*curves.env_steps[curves.label == "ippo-tiny"]] == [128, 256, 320] * 2
    assert "](found/learning_curves_field_03.png)" in page.read_text()
    reported = read_json(page.parent / "found" / "comparison.json")
    assert {row["label"] for row in reported["rows"]} == {"mappo-tiny", "ippo-tiny"}
    again = train_all_runs(CONFIG, out, command="mbn compare", processes=1, resume=True)
    assert summarise(again) == summarise(results)


WILD = {**TINY, "learning_rate": [1e30, 1e30], "max_grad_norm": 1e30}


def test_a_learner_that_breaks_down_stops_its_own_run_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("baselines.compare.report.write_episode", lambda *drawn: None)
    out, variants = tmp_path / "out", tmp_path / "variants.yaml"
    wild, tame = ({"algorithm": "mappo", "hyperparameters": values} for values in (WILD, TINY))
    variants.write_text(json.dumps({"wild": wild, "tame": tame}))
    budget = "--seeds 0 1 --steps 320 --evaluate-every 320 --episodes 1 --processes 2"
    words = ["compare", "--variants", str(variants), *budget.split(), "--out"]
    assert main([*words, str(out)]) == 2
    error = capsys.readouterr().err
    for seed in (0, 1):
        place = str(out / f"wild-field_03-seed{seed}")
        assert place in error and place in (out / "comparison.md").read_text()
        assert (out / f"tame-field_03-seed{seed}" / "evaluation.json").is_file()
    assert {path.name for path in out.iterdir() if path.is_file()} >= {
        *("command.txt", "comparison.md", "config.json", "gaps.png"),
        *("learning_curves_field_03.png", "table.csv", "runs.csv", "curves.csv", "versions.json"),
    }
    found = read_json(out / "comparison.json")
    assert {row["label"] for row in found["rows"]} == {"tame"}
    assert set(found["broken_runs"]) == {"wild-field_03-seed0", "wild-field_03-seed1"}


def test_nothing_is_left_to_compare(tmp_path, monkeypatch):
    diverge = Mock(side_effect=DivergenceError("loc is nan"))
    monkeypatch.setattr("baselines.sweep.run.train", diverge)
    with pytest.raises(RunError, match="loc is nan"):
        train_all_runs(CONFIG, tmp_path / "none", command="mbn compare", processes=1)


def test_only_the_same_comparison_goes_on(tmp_path):
    out = tmp_path / "comparison"
    out.mkdir()
    with pytest.raises(RunError, match=str(out)):
        train_all_runs(CONFIG, out, command="mbn compare", processes=1, resume=True)
    write_json(out / "config.json", {**CONFIG.to_json(), "seeds": [0, 2], "steps": 7})
    how = {"command": "mbn compare", "processes": 1, "resume": True}
    assert places_of(ConfigError, train_all_runs, CONFIG, out, **how) == ["seeds", "steps"]
    assert [path.name for path in out.iterdir()] == ["config.json"]
