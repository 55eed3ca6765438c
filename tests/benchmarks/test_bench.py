"""``python -m benchmarks``: its timing by hand, and every row of speed in a tiny run."""

import json

import pytest

from benchmarks import speed
from benchmarks.__main__ import SUBJECTS, main
from benchmarks.report import Measurement
from benchmarks.speed import Budget, Case, Speed, interleaved

TINY = Budget(rounds=2, seconds=0.0, warm_up=3, worlds=10, many_worlds=16, startup=False)


@pytest.fixture(scope="module")
def findings():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(speed, "VMAS_WORLDS", (8,))
        patch.setattr(Speed, "budget", TINY)
        return Speed().measure()


def test_cases_take_turns_and_seconds_are_per_unit(monkeypatch):
    clock, turns = {"now": 0.0}, []
    monkeypatch.setattr(speed, "thread_time", lambda: clock["now"])
    monkeypatch.setattr(speed, "perf_counter", lambda: 3.0 * clock["now"])

    def make(name: str) -> Case:
        def run(calls: int) -> None:
            turns.append(f"run {name}")
            clock["now"] += 0.5 * calls

        return Case(name, run, 10.0, lambda calls: turns.append(f"prepare {name}"))

    cpu, wall = interleaved([make("a"), make("b")], Budget(rounds=3, seconds=4.0))
    assert turns[-12:] == 3 * ["prepare a", "run a", "prepare b", "run b"]
    assert list(cpu) == list(wall) == ["a", "b"]
    assert cpu["a"].tolist() == [0.05] * 3
    assert wall["a"].tolist() == pytest.approx([0.15] * 3)
    assert clock["now"] == 2 * 0.5 * (1 + 1 + 2 + 3 * 8)  # warm-up, calibration, turns of 4 s


def test_target_is_met():
    for value, target, at_least, met in (
        (2.0, 2.0, True, True),
        (1.9, 2.0, True, False),
        (1.9, 2.0, False, True),
        (2.1, 2.0, False, False),
        (None, 2.0, True, None),
        (1.0, None, True, None),
    ):
        assert Measurement("a", value, "x", target, at_least).met is met
    missed = Measurement("a", 2.1, "x", 2.0, at_least=False)
    assert missed.words() == ("a", "2.1 x", "<= 2", "missed", "")


def test_folder_with_every_row_is_written_once(tmp_path, monkeypatch, capsys, findings):
    rows = findings.values["rows"]
    assert len({row["name"] for row in rows}) == len(rows) == 10
    for row in rows:
        assert (row["value"] is None) == ("needs" in row["note"])
        assert row["value"] is None or row["value"] > 0
    monkeypatch.setattr(Speed, "measure", lambda self: findings)
    words = ["speed", "--out", str(tmp_path / "bench")]
    assert main(words) == 0
    stored = json.loads((tmp_path / "bench" / "speed.json").read_text())
    assert stored["command"].startswith("python -m benchmarks speed --out ")
    assert stored["rows"] == rows and stored["machine"]["packages"]["numba"]
    assert main(words) == 2
    assert "--force" in capsys.readouterr().err


def test_subjects(tmp_path, capsys, monkeypatch):
    assert main([]) == 0
    listed = capsys.readouterr().out
    assert all(f"  {subject} " in listed for subject in SUBJECTS)
    for subject in SUBJECTS:
        with pytest.raises(SystemExit, match="0"):
            main([subject, "--help"])
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for words, place in (["sped"], "speed?"), (["gpu", "--out", str(tmp_path / "gpu")], "cuda"):
        assert main(words) == 2
        assert place in capsys.readouterr().err
