"""The studies of learning: targets by hand, and the commands."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from baselines.compare.records import RunRecord
from baselines.training.train import prepare, resolve
from benchmarks.__main__ import main
from benchmarks.studies import learning
from benchmarks.studies.learning import (
    STUDIES,
    Study,
    field_table,
    makespan,
    run_table,
    target_rows,
    write_targets,
)
from mbn_marl.errors import ConfigError
from tests.support.records import CONFIG, make_run

pytestmark = pytest.mark.slow

GOOD = {
    "return_mean": 150_000.0,
    "success_rate": 0.99,
    "deterministic_success_rate": 1.0,
    "deterministic_return_mean": 155_000.0,
}
LOW, RARE, STUCK = (
    {**GOOD, "return_mean": 99_999.0},
    {**GOOD, "success_rate": 0.98},
    {**GOOD, "deterministic_success_rate": 0.0},
)


def evaluations(*entries: dict[str, Any]) -> list[dict[str, Any]]:
    """A history with one entry every 100,000 env-steps and 10 seconds."""
    return [
        {**entry, "env_steps": 100_000 * number, "wall_seconds": 10.0 * number, "seconds": 1.0}
        for number, entry in enumerate(entries, start=1)
    ]


def final(entry: dict[str, Any], deterministic_return: float) -> dict[str, Any]:
    """A final evaluation after 1,000 seconds."""
    sampled = {"return_mean": entry["return_mean"], "success_rate": entry["success_rate"]}
    mean = {
        "return_mean": deterministic_return,
        "success_rate": entry["deterministic_success_rate"],
        "makespan": None,
    }
    return {
        "env_steps": 500_000,
        "seconds": 900.0,
        "wall_seconds": 1000.0,
        "stochastic": {**sampled, "makespan": None},
        "deterministic": mean,
    }


def records(folder: Path) -> list[RunRecord]:
    """Two fields, two seeds."""
    histories = {
        ("field_01", 0): (evaluations(LOW, GOOD, LOW), final(GOOD, 158_800.0)),
        ("field_01", 1): (evaluations(RARE, STUCK, GOOD), final(RARE, 158_000.0)),
        ("field_10", 0): (evaluations(GOOD), final(GOOD, 157_000.0)),
        ("field_10", 1): (evaluations(LOW, LOW, LOW, GOOD), final(GOOD, 156_000.0)),
    }
    return [
        make_run(folder, field=field, seed=seed, recorded=recorded)
        for (field, seed), recorded in histories.items()
    ]


def test_a_field_is_summarised_by_medians(tmp_path: Path) -> None:
    runs = run_table(records(tmp_path))
    assert runs.env_steps.tolist() == [200_000, 300_000, 100_000, 400_000]
    assert runs.seconds.tolist() == [20.0, 30.0, 10.0, 40.0]
    assert runs.passed.tolist() == [True, False, True, True]
    line: Any = field_table(runs).iloc[0]
    assert (line.passed, line.runs) == (1, 2)
    assert (line.env_steps, line.worst_env_steps) == (250_000, 300_000)
    assert (line.seconds, line.success_rate) == (25.0, 0.985)
    assert (line.deterministic_median, line.deterministic_best) == (158_400.0, 158_800.0)
    assert (line.optimum, line.paper_best) == (158_800.0, 158_800.0)


def test_the_best_return_may_be_one_on_the_way(tmp_path: Path) -> None:
    better = {**GOOD, "deterministic_return_mean": 158_800.0}
    history = evaluations(GOOD, better, GOOD)
    run = make_run(tmp_path, field="field_01", recorded=(history, final(GOOD, 158_000.0)))
    line: Any = field_table(run_table([run])).iloc[0]
    assert (line.deterministic_median, line.deterministic_best) == (158_000.0, 158_800.0)


def test_workers_take_jobs_in_order() -> None:
    seconds = (3.0, 1.0, 1.0, 4.0)
    assert makespan(seconds, 1) == 9.0
    assert makespan(seconds, 2) == 6.0  # 3 then nothing; 1, 1, then 4


def test_targets_are_scaled_to_the_runs(tmp_path: Path) -> None:
    runs = run_table(records(tmp_path))
    rows = target_rows(runs, processes=2)
    seen = [(row.value, row.target, row.met) for row in rows]
    assert seen == [
        (3, 4, False),  # of 4 final policies
        (400_000, 1_500_000, True),  # the slowest
        (30.0, 32.0, True),  # the seeds: max(20, 10) and max(30, 40)
        (0, 2, False),  # 158,400 is 0.252 % below 158,800, 156,500 is farther from 157,870
        (2, 2, True),  # 158,800 and 157,000 against the paper's 158,800 and 156,351
        (1, 2, False),  # the optimum of field_01
        (2000.0, 360.0, False),  # 4 runs of 1,000 s, two at a time
    ]
    write_targets(runs, rows, tmp_path)
    page = (tmp_path / "learning.md").read_text()
    assert "| field_01 | 1/2 | 250,000 | 300,000 | 25.0 |" in page
    stored = json.loads((tmp_path / "learning.json").read_text())
    assert stored["targets"][0]["met"] is False
    assert [line["field"] for line in stored["fields"]] == ["field_01", "field_10"]


def test_a_run_that_never_passes_leaves_no_number(tmp_path: Path) -> None:
    run = make_run(tmp_path, field="field_01", recorded=(evaluations(LOW), final(STUCK, 0.0)))
    runs = run_table([run])
    rows = target_rows(runs, processes=1)
    assert (rows[1].value, rows[1].met, rows[2].value) == (math.inf, False, math.inf)
    write_targets(runs, rows, tmp_path)
    assert "| field_01 | 0/1 | - | - | - |" in (tmp_path / "learning.md").read_text()


@pytest.mark.parametrize("name", STUDIES)
def test_studies_can_be_trained_and_their_variants_differ(name: str) -> None:
    config = Study(study=name).config()
    assert min(config.seeds) >= 100  # no seed that was looked at while tuning
    runs = config.runs()[: len(config.variants)]
    resolved = [resolve(*prepare(run)) for run in runs]
    assert [found["label"] for found in resolved] == [run.label for run in runs]
    parts = [(one["algorithm"], one["hyperparameters"], one["environment"]) for one in resolved]
    assert all(part not in parts[:index] for index, part in enumerate(parts))


def test_unknown_study_is_named() -> None:
    with pytest.raises(ConfigError, match=r"form: .*forms"):
        Study(study="form").config()


def test_the_benchmark_of_learning_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(learning, "labelled", lambda blocks, place: CONFIG.variants)
    monkeypatch.setattr("baselines.compare.report.write_episode", lambda *drawn: None)
    out = tmp_path / "bench"
    size = ("--fields", "field_03", "--seeds", "0", "--steps", "1", "--processes", "1")
    assert main(["study", "learning", *size, "--out", str(out)]) == 0
    assert "final policies that pass" in capsys.readouterr().out
    assert (out / "learning.md").is_file() and (out / "comparison.md").is_file()
    stored = json.loads((out / "learning.json").read_text())
    assert [row["value"] for row in stored["targets"][:3]] == [0, None, None]
