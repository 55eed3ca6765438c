"""``python -m benchmarks``: its timing by hand, and every row of speed in a tiny run."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.__main__ import SUBJECTS, benchmark_class, main
from benchmarks.conditions import POLICIES, Conditions
from benchmarks.report import Findings, Measurement, other_seconds
from benchmarks.speed.adapters import measure_sb3, measure_torchrl
from benchmarks.speed.measure import Speed
from benchmarks.speed.timing import Budget, Case, Timings, interleaved
from mbn_marl.config import Condition
from mbn_marl.errors import ConfigError

TINY = Budget(rounds=2, seconds=0.0, warm_up=3, worlds=10, many_worlds=16, startup=False)


@pytest.fixture(scope="module")
def findings() -> Findings:
    """A whole run, as small as it can be."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.speed.peers.VMAS_WORLDS", (8,))
        patch.setattr("benchmarks.speed.adapters.ROWS", 4)
        patch.setattr(Speed, "budget", TINY)
        return Speed().measure()


# -- the harness -----------------------------------------------------------------------------------


def test_ratios_are_medians_over_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    fast, slow = [1e-6, 2e-6, 30e-6], [4e-6, 10e-6, 60e-6]
    turns = pd.DataFrame({"engine": fast, "SB3": slow, "own": slow, "lean": fast, "empty": fast})
    timings = Timings(turns, pd.DataFrame())
    monkeypatch.setattr("benchmarks.speed.timing.interleaved", lambda cases, budget: timings)
    (over,) = measure_sb3(TINY)
    assert over.value == pytest.approx(8.0)  # us: of 3, 8, 30
    lean, of_empty = measure_torchrl(TINY)
    assert lean.value == pytest.approx(0.5) and "4.00 x" in lean.note  # of 4, 5, 2
    assert of_empty.value == pytest.approx(25.0)  # %: of 1/4, 1/5, 1/2


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
    monkeypatch.setattr("benchmarks.speed.timing.thread_time", lambda: clock["now"])
    monkeypatch.setattr("benchmarks.speed.timing.perf_counter", lambda: 3.0 * clock["now"])

    def run(calls: int) -> None:
        clock["now"] += 0.5 * calls

    cpu, wall = interleaved([Case("a", run, units=10.0)], Budget(rounds=3, seconds=4.0))
    assert cpu["a"].tolist() == [0.05] * 3
    assert wall["a"].tolist() == pytest.approx([0.15] * 3)
    assert clock["now"] == 0.5 * (1 + 1 + 2 + 3 * 8)  # warm-up, calibration, three turns of 4 s


@pytest.mark.parametrize(
    ("value", "target", "at_least", "met"),
    [
        (3.0, 2.0, True, True),
        (2.0, 2.0, True, True),
        (1.9, 2.0, True, False),
        (1.9, 2.0, False, True),
        (2.1, 2.0, False, False),
        (None, 2.0, True, None),
        (1.0, None, True, None),
    ],
)
def test_a_target_is_met(
    value: float | None, target: float | None, at_least: bool, met: bool | None
) -> None:
    assert Measurement("a", value, "x", target, at_least).met is met


# -- what is measured ------------------------------------------------------------------------------


@pytest.mark.all
def test_conditions_are_those_of_the_zoo_and_the_classical_policies() -> None:
    conditions: tuple[Condition, ...] = ("calm", "failing", "storm")
    policies = (*POLICIES, "zoo:generalist-hint")
    asked = Conditions(policies=policies, conditions=conditions, fields=("field_03",), episodes=2)
    found = asked.measure()
    for name, rows in found.values["evaluations"].items():
        assert rows["calm"]["field_03"]["success_rate"] == 1.0, name
    assert not found.values["evaluations"]["planner"]["failing"]
    in_storm = {name: rows["storm"] for name, rows in found.values["evaluations"].items()}
    assert in_storm["zoo-sampled"]["field_03"]["episodes"] == 2
    assert not in_storm["zoo-sampled"]["field_03"]["deterministic"]
    assert in_storm["zoo:generalist-hint"]["field_03"]["deterministic"]
    (success, _) = found.tables.values()
    assert success.lines[0][:2] == ("calm", "100.0% (100%)")


def test_every_unknown_policy_is_named() -> None:
    asked = Conditions(policies=("greedy", "nobody", "zoo:none"), fields=("field_03",))
    with pytest.raises(ConfigError) as caught:
        asked.measure()
    first, second = caught.value.problems
    assert "nobody" in first and "none" in second


# -- the findings ----------------------------------------------------------------------------------


def test_every_row_has_a_figure_or_a_reason(findings: Findings) -> None:
    rows = findings.values["rows"]
    assert len({row["name"] for row in rows}) == len(rows) == 12
    for row in rows:
        assert row.keys() == {"name", "value", "unit", "target", "at_least", "note", "met"}
        assert (row["value"] is None) == ("needs" in row["note"])
        assert row["met"] is None or isinstance(row["met"], bool)
    with_target = [row for row in rows if row["target"] is not None]
    assert len(with_target) == 10
    # The share of an overhead may come out at or below zero in so small a run.
    rates = [row for row in rows if "over the engine" not in row["name"]]
    assert all(row["value"] is None or row["value"] > 0 for row in rates)


def test_never_misses_its_target() -> None:
    never = Measurement("until", math.inf, "s", 10.0, at_least=False)
    assert never.words() == ("until", "never", "<= 10", "missed", "")
    assert never.to_json()["value"] is None


@pytest.mark.parametrize(("others", "doubtful"), [(0.0, False), (1e9, True)])
def test_a_folder_is_written_once(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    findings: Findings,
    others: float,
    doubtful: bool,
) -> None:
    monkeypatch.setattr(Speed, "measure", lambda self: findings)
    monkeypatch.setattr("benchmarks.report.other_seconds", iter((0.0, others)).__next__)
    out = tmp_path / "bench"
    words = ["speed", "--out", str(out)]
    assert main(words) == 0
    printed = capsys.readouterr().out
    stored = json.loads((out / "speed.json").read_text())
    assert [path.name for path in out.iterdir()] == ["speed.json"]
    assert stored["command"] == f"python -m benchmarks speed --out {out}"
    assert stored["rows"] == findings.values["rows"]
    assert stored["machine"]["cores"] >= 1 and stored["machine"]["packages"]["numba"]
    assert stored["machine"]["processor"] in printed
    assert all(row["name"] in " ".join(printed.split()) for row in findings.values["rows"])
    assert ("not valid" in printed) == doubtful
    assert main(words) == 2
    assert "--force" in capsys.readouterr().err


def test_load_of_others_leaves_out_our_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By hand: 100 ticks a second; of 14.1 s of work, 3.5 s were ours and our children's."""
    stat = tmp_path / "stat"
    monkeypatch.setattr("benchmarks.report.STAT", stat)
    monkeypatch.setattr("os.sysconf", lambda name: 100)
    monkeypatch.setattr("os.times", lambda: (2.0, 0.5, 1.0, 0.0, 99.0))
    assert other_seconds() is None
    stat.write_text("cpu  900 40 180 9900 90 10 230 50 0 0\n")
    assert other_seconds() == pytest.approx(14.1 - 3.5)


# -- the command -----------------------------------------------------------------------------------


def test_every_subject_has_a_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    listed = capsys.readouterr().out
    assert all(f"  {subject} " in listed for subject in SUBJECTS)
    for subject in SUBJECTS:
        with pytest.raises(SystemExit) as caught:
            main([subject, "--help"])
        assert caught.value.code == 0
        first, shown = benchmark_class(subject).__doc__.split(".")[0], capsys.readouterr().out
        assert " ".join(first.split()) in " ".join(shown.split())


def test_an_unknown_subject_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sped"]) == 2
    assert "speed?" in capsys.readouterr().err


def test_without_a_gpu_there_is_an_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert main(["gpu", "--out", str(tmp_path / "gpu")]) == 2
    assert "cuda" in capsys.readouterr().err
