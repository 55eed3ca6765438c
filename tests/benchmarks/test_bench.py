"""``python -m benchmarks``: its timing by hand, and every row of speed in a tiny run."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import speed
from benchmarks.__main__ import SUBJECTS, main
from benchmarks.report import Findings, Measurement
from benchmarks.speed import Budget, Case, Speed, Timings, interleaved

TINY = Budget(rounds=2, seconds=0.0, warm_up=3, worlds=10, many_worlds=16, startup=False)


@pytest.fixture(scope="module")
def findings() -> Findings:
    """A whole run, as small as it can be."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(speed, "VMAS_WORLDS", (8,))
        patch.setattr(Speed, "budget", TINY)
        return Speed().measure()


def test_ratios_are_medians_over_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    turns = pd.DataFrame({"lean": [1e-6, 2e-6, 30e-6], "all": [4e-6, 10e-6, 60e-6]})
    monkeypatch.setattr(speed, "interleaved", lambda cases, budget: Timings(turns, turns))
    (lean,) = speed.measure_torchrl(TINY)
    assert lean.value == pytest.approx(0.5) and "4.00 x" in lean.note  # of 4, 5, 2


def test_cases_take_turns_and_prepare_first() -> None:
    turns: list[str] = []
    cases = [
        Case(
            name,
            run=lambda calls, name=name: turns.append(f"run {name} {calls}"),
            prepare=lambda calls, name=name: turns.append(f"prepare {name} {calls}"),
        )
        for name in "ab"
    ]
    timings = interleaved(cases, Budget(rounds=2, seconds=0.0))
    turn = [f"{what} {name} 1" for name in "ab" for what in ("prepare", "run")]
    assert turns[-8:] == 2 * turn
    for clock in timings:
        assert list(clock) == ["a", "b"] and clock.shape == (2, 2)


def test_seconds_are_per_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = {"now": 0.0}
    monkeypatch.setattr(speed, "thread_time", lambda: clock["now"])
    monkeypatch.setattr(speed, "perf_counter", lambda: 3.0 * clock["now"])

    def run(calls: int) -> None:
        clock["now"] += 0.5 * calls

    cpu, wall = interleaved([Case("a", run, units=10.0)], Budget(rounds=3, seconds=4.0))
    assert cpu["a"].tolist() == [0.05] * 3
    assert wall["a"].tolist() == pytest.approx([0.15] * 3)
    assert clock["now"] == 0.5 * (1 + 1 + 2 + 3 * 8)  # warm-up, calibration, three turns of 4 s


@pytest.mark.parametrize(
    ("value", "target", "at_least", "met"),
    [
        (2.0, 2.0, True, True),
        (1.9, 2.0, True, False),
        (1.9, 2.0, False, True),
        (2.1, 2.0, False, False),
        (None, 2.0, True, None),
        (1.0, None, True, None),
        (math.inf, 2.0, False, False),
    ],
)
def test_target_is_met(
    value: float | None, target: float | None, at_least: bool, met: bool | None
) -> None:
    one = Measurement("a", value, "x", target, at_least)
    assert one.met is met
    if value == math.inf:
        assert one.words() == ("a", "never", "<= 2", "missed", "") and not one.to_json()["value"]


def test_folder_with_every_row_is_written_once(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    findings: Findings,
) -> None:
    rows = findings.values["rows"]
    assert len({row["name"] for row in rows}) == len(rows) == 10
    for row in rows:
        assert (row["value"] is None) == ("needs" in row["note"])
        assert row["value"] is None or row["value"] > 0
    monkeypatch.setattr(Speed, "measure", lambda self: findings)
    words = ["speed", "--out", str(tmp_path / "bench")]
    assert main(words) == 0
    printed = capsys.readouterr().out
    stored = json.loads((tmp_path / "bench" / "speed.json").read_text())
    assert stored["command"].startswith("python -m benchmarks speed --out ")
    assert stored["rows"] == rows and stored["machine"]["packages"]["numba"]
    assert stored["machine"]["processor"] in printed
    assert all(row["name"] in " ".join(printed.split()) for row in rows)
    assert main(words) == 2
    assert "--force" in capsys.readouterr().err


def test_subjects(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main([]) == 0
    listed = capsys.readouterr().out
    assert all(f"  {subject} " in listed for subject in SUBJECTS)
    for subject in SUBJECTS:
        with pytest.raises(SystemExit) as caught:
            main([subject, "--help"])
        assert caught.value.code == 0 and f"benchmarks {subject}" in capsys.readouterr().out
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for words, place in (["sped"], "speed?"), (["gpu", "--out", str(tmp_path / "gpu")], "cuda"):
        assert main(words) == 2
        assert place in capsys.readouterr().err
