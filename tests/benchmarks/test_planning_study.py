"""The study of the planner."""

from __future__ import annotations

import dataclasses

import pytest

from benchmarks.planning import Attempt, Planning, target_rows


def test_the_study_counts_what_was_proved(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[None] = []
    monkeypatch.setattr("benchmarks.planning.CONVEX", 2)
    monkeypatch.setattr("benchmarks.planning.WINDING", 1)
    found = Planning().measure(lambda: seen.append(None))
    rows, instances = found.measurements, found.details
    assert len(seen) == 13
    assert [len(instances[name]) for name in ("catalogue", "convex", "winding")] == [10, 2, 1]
    assert [row.value for row in rows[:1] + rows[2:3] + rows[5:6] + rows[-1:]] == [10, 2, 1, 0]
    wrong = [dataclasses.replace(Attempt(**instances["convex"][0]), bound=99)]
    assert target_rows(wrong, wrong, wrong)[-1].value == 3
