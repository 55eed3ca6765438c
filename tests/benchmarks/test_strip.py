"""``python -m benchmarks strip`` and ``tables``: figures and tables of made-up runs, by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pandas
import pytest

from benchmarks import tables
from benchmarks.__main__ import main
from benchmarks.strip import COLUMNS, FIELDS, RADII, learned, reach, strip
from benchmarks.tables import fill, rows_of, searched, table
from mbn_marl import Field
from mbn_marl.field import Instance, splits
from tests.support.pages import ROOT
from tests.support.planning_cases import SQUARE

HEADING = "label,field,seed,passed,deterministic_gap,spl\n"
RUNS = "".join(
    f"mappo,field_01,{run}\n" for run in ("200,True,0.1,0.9", "201,False,,0", "202,True,0.3,0.75")
)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    for study in ("forms", "aids", FIELDS):
        (tmp_path / study).mkdir()
        (tmp_path / study / "comparison.json").write_text('{"rows": []}')
        own = [name for name, place in COLUMNS.items() if place == study and name != "mappo"]
        lines = "".join(f"{label},field_01,,True,0.5,0.5\n" for label in own)
        (tmp_path / study / "runs.csv").write_text(HEADING + lines)
    (tmp_path / "search").mkdir()
    gaps = "".join(f"greedy-local,a,{radius},{1 / (1 + radius)}\n" for radius in (0.0, math.inf))
    (tmp_path / "search" / "radii.csv").write_text(f"policy,field,comm_radius,gap\n{gaps}")
    with (tmp_path / "forms" / "runs.csv").open("a") as file:
        file.write(RUNS)
    return tmp_path


def test_figure_has_a_dot_a_run_and_counts_failures(results: Path) -> None:
    assert main(["strip", "--folder", str(results)]) == 0
    shown = pandas.read_csv(results / "strip.csv")
    assert [*dict.fromkeys(shown.label)] == [*COLUMNS] and len(shown) == len(COLUMNS) + 2
    assert (results / "strip.png").stat().st_size and (results / "forms" / "gaps.png").is_file()
    assert (results / "search" / "radii.png").is_file()
    (axes,) = reach(pandas.read_csv(results / "search" / "radii.csv")).axes
    assert axes.lines[0].get_xydata().tolist() == [[0.0, 2.0], [len(RADII) - 1, 1.0]]
    (axes,) = strip({"mappo": shown[shown.label == "mappo"]}).axes
    dots, crosses = axes.lines
    assert dots.get_ydata().tolist() == pytest.approx([1.1, 1.3])
    assert crosses.get_marker() == "x" and len(crosses.get_ydata()) == 1


def test_table_is_written_below_its_mark_once(results: Path) -> None:
    page = results / "forms.md"
    page.write_text("a\n\n<!-- table: forms -->\n\nb\n\n<!-- table: later -->\n\nc\n")
    for _ in range(2):
        assert main(["tables", "--folder", str(results)]) == 0
        text = page.read_text()
        lines = [line for line in text.splitlines() if line.startswith("|")]
        assert lines[2] == "| mappo | 2/3 | 21%..94% | 30% | 30% | 0 | 0.550 |", "the best SPL"
        assert len(lines) == 5
        assert text.endswith("\n\nb\n\n<!-- table: later -->\n\nc\n")


def test_prices_and_success_of_a_policy_that_knows_its_own(tmp_path: Path) -> None:
    rows = [
        {
            **{"field": field, "comm_radius": radius, "information": "own"},
            **{"makespan_lower_bound": 10, "mean": {"makespan": steps, "success_rate": 1.0}},
        }
        for field, all_steps in (("a", (60, 30, 20)), ("b", (40, 20, 20)))
        for radius, steps in zip(("0", "100", "inf"), all_steps, strict=True)
    ]
    rows[0]["mean"] = {"makespan": None, "success_rate": 0.0}
    (tmp_path / "own.json").write_text(json.dumps({"tiers": {"6-search": {"instances": rows}}}))
    (line,) = searched(tmp_path).lines
    assert line == ("own", "own", "50% / 100% / 100%", "2.00", "1.25 (1.00..1.50)", "2.00")


def test_passages_are_compared_with_bound_and_best_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fields = [Field(SQUARE, [(150, 150)], [(150, 150)], name=name) for name in "ab"]
    known = [Instance(field, makespan_lower_bound=10, best_known=15) for field in fields]
    monkeypatch.setattr(tables, "load_split", lambda *of: known)
    means = [{"makespan": 30.0, "success_rate": 1.0}, {"makespan": None, "success_rate": 0.0}]
    rows = [
        {"field": one.field.name, "information": "own", "makespan_lower_bound": 10, "mean": mean}
        for one, mean in zip(known, means, strict=True)
    ]
    result = {"tiers": {splits.PASSAGES: {"instances": rows}}}
    (tmp_path / "slow.json").write_text(json.dumps(result))
    (line,) = tables.passages(tmp_path).lines
    assert line == ("slow", "own", "50%", "3.00", "2.00")


def test_where_no_bound_is_known_makespans_are_shown(tmp_path: Path) -> None:
    heading = HEADING.replace("deterministic_gap", "deterministic_makespan,deterministic_gap")
    (tmp_path / "runs.csv").write_text(f"{heading}fast,a,0,True,20,,\nfast,a,1,True,40,0.5,0.7\n")
    (tmp_path / "classical.csv").write_text(f"{heading}slow,a,,False,,,\n")
    fast, slow = table(tmp_path).lines
    assert [*fast] == ["fast", "2/2", "34%..100%", "30.0", "30.0", "0"]
    assert [*slow] == ["slow", "0/1", "0%..79%", "-", "-", "1"]
    (axes,) = strip(dict(list(rows_of(tmp_path).groupby("label")))).axes
    dots, crosses = axes.lines[0], axes.lines[-1]
    assert dots.get_ydata().tolist() == [20.0, 40.0]
    assert crosses.get_marker() == "x" and "steps" in axes.get_ylabel()


def test_learned_policies_are_read_from_their_results(tmp_path: Path) -> None:
    rows = [{"field": "a", "comm_radius": name, "mean": {"gap": 0.5}} for name in ("0", "inf")]
    result = json.dumps({"tiers": {splits.SEARCH: {"instances": rows}}})
    for name in ("zoo-mine", "greedy"):
        (tmp_path / f"{name}.json").write_text(result)
    found = learned(tmp_path)
    assert found.to_numpy().tolist() == [["zoo-mine", "a", r, 0.5] for r in (0.0, math.inf)]


@pytest.mark.parametrize(
    ("returned", "gap"),
    [(158_800, 0.0), (158_710, 3 / 40), (148_590, 7 / 40), (10_000, None)],
    ids=["optimum", "3 steps more", "a push at a wall", "failure"],
)
def test_gap_of_a_median_return(returned: int, gap: float | None, tmp_path: Path) -> None:
    row = {"label": "a", "field": "field_01", "deterministic_median": returned, "optimum": 158_800}
    (tmp_path / "comparison.json").write_text(json.dumps({"rows": [row]}))
    (found,) = rows_of(tmp_path).itertuples()
    assert found.passed == (gap is not None)
    assert gap is None or found.deterministic_gap == pytest.approx(gap)


def test_tables_of_the_pages_are_of_their_data() -> None:
    for page in (ROOT / "docs" / "results").glob("*.md"):
        assert fill(page) == page.read_text(encoding="utf-8"), page
