"""``python -m benchmarks strip`` and ``tables``: figures and tables of made-up runs, by hand."""

import json
import math

import numpy as np
import pandas
import pytest
from matplotlib.lines import Line2D

from benchmarks import tables
from benchmarks.__main__ import main
from benchmarks.strip import COLUMNS, FIELDS, RADII, reach, strip
from benchmarks.tables import by_radius, fill, rows_of, searched, table
from mbn_marl import Field
from mbn_marl.field import Instance, splits
from tests.support.pages import ROOT
from tests.support.planning_cases import SQUARE

HEADING = "label,field,seed,passed,deterministic_gap,spl\n"
SEARCH_HEADING = "policy,information,field,comm_radius,gap\n"
RUNS = "".join(
    f"mappo,field_01,{run}\n" for run in ("200,True,0.1,0.9", "201,False,,0", "202,True,0.3,0.75")
)


@pytest.fixture
def results(tmp_path):
    for study in ("forms", "aids", FIELDS):
        (tmp_path / study).mkdir()
        own = [name for name, place in COLUMNS.items() if place == study and name != "mappo"]
        lines = "".join(f"{label},field_01,,True,0.5,0.5\n" for label in own)
        (tmp_path / study / "runs.csv").write_text(HEADING + lines)
    (tmp_path / "search").mkdir()
    gaps = "".join(f"script,own,a,{radius},{1 / (1 + radius)}\n" for radius in (0.0, math.inf))
    (tmp_path / "search" / "radii.csv").write_text(SEARCH_HEADING + gaps)
    with (tmp_path / "forms" / "runs.csv").open("a") as file:
        file.write(RUNS)
    return tmp_path


def heights(line: Line2D) -> dict[int, float]:
    return {at: y for at, y in enumerate(np.asarray(line.get_ydata(), float)) if not np.isnan(y)}


def test_figure_has_a_dot_a_run_and_counts_failures(results):
    assert main(["strip", "--folder", str(results)]) == 0
    shown = pandas.read_csv(results / "strip.csv")
    assert [*dict.fromkeys(shown.label)] == [*COLUMNS] and len(shown) == len(COLUMNS) + 2
    assert (results / "strip.png").stat().st_size and (results / "forms" / "gaps.png").is_file()
    assert (results / "search" / "radii.png").is_file()
    (axes,) = reach(pandas.read_csv(results / "search" / "radii.csv")).axes
    assert heights(axes.lines[0]) == {0: 2.0, len(RADII) - 1: 1.0}
    (axes,) = strip({"mappo": shown[shown.label == "mappo"]}).axes
    dots, crosses = axes.lines
    assert dots.get_ydata().tolist() == pytest.approx([1.1, 1.3])
    assert crosses.get_marker() == "x" and len(crosses.get_ydata()) == 1
    assert axes.collections[0].get_segments()[0][0][1] == pytest.approx(1.3), "the median of three"


def test_table_is_written_below_its_mark_once(results):
    page = results / "forms.md"
    page.write_text("a\n\n<!-- table: forms -->\n\nb\n\n<!-- table: later -->\n\nc\n")
    for _ in range(2):
        assert main(["tables", "--folder", str(results)]) == 0
        text = page.read_text()
        lines = [line for line in text.splitlines() if line.startswith("|")]
        assert lines[2] == "| mappo | 2/3 | 21%..94% | 30% | 30% | 0 | 0.550 |", "the best SPL"
        assert len(lines) == 5
        assert text.endswith("\n\nb\n\n<!-- table: later -->\n\nc\n")


def test_passages_are_compared_with_bound_and_best_plan(tmp_path, monkeypatch):
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


def test_weather_is_ordered_by_success_then_makespan(tmp_path):
    for name, makespan, success in (("a", None, 0.0), ("b", 9.0, 0.1), ("c", 40.0, 1.0)):
        mean = {"makespan": makespan, "success_rate": success}
        rows = [{"condition": one, "information": "all", "mean": mean} for one in splits.CONDITIONS]
        result = {"tiers": {splits.WEATHER: {"instances": rows}}}
        (tmp_path / f"{name}.json").write_text(json.dumps(result))
    lines = tables.weather(tmp_path).lines
    assert [line[0] for line in lines] == ["c", "b", "a"]
    assert [line[2] for line in lines] == ["40.0 (100%)", "9.0 (10%)", "- (0%)"]


def test_where_no_bound_is_known_makespans_are_shown(tmp_path):
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


def test_policies_are_compared_by_radius(tmp_path):
    measured = "script,own,a,0,1.0\nscript,own,a,inf,0.0\nscript,own,b,0,\n"
    (tmp_path / "radii.csv").write_text(SEARCH_HEADING + measured)
    rows = [
        {"field": field, "comm_radius": name, "information": "state", "mean": {"gap": gap}}
        for field, gaps in (("a", (2.0, 0.5, 0.0)), ("b", (1.0, 1.0, 1.0)))
        for name, gap in zip(("0", "100", "inf"), gaps, strict=True)
    ]
    result = json.dumps({"tiers": {splits.SEARCH: {"instances": rows}}})
    for name in ("mine", "script"):
        (tmp_path / f"{name}.json").write_text(result)
    (tmp_path / "instances.csv").write_text(
        "label,field,seed,instance,bound,makespan\n"
        "mappo-0,t,0,a,10,30\nmappo-0,t,1,a,10,50\nmappo-inf,t,0,a,10,20\nmappo-inf,t,0,b,10,\n"
        "joint-inf,t,0,a,10,10\njoint-inf,t,0,b,10,20\n"
    )
    sees = "label,information\nmappo-0,own\nmappo-inf,own\njoint-inf,all\n"
    (tmp_path / "runs.csv").write_text(sees)
    assert searched(tmp_path).lines == [
        (
            "mine",
            "state",
            "100% / 100% / 100%",
            "2.50 (2.00..3.00)",
            "1.75 (1.50..2.00)",
            "1.50 (1.00..2.00)",
            "1.25 (1.00..1.50)",
            "2.00 (1.00..3.00)",
        ),
        ("script", "own", "50% / - / 100%", "2.00", "-", "1.00", "-", "2.00"),
        ("mappo", "own", "100% / - / 50%", "4.00", "-", "2.00", "-", "2.00"),
        ("joint", "all", "- / - / 100%", "-", "-", "1.50 (1.00..2.00)", "-", "-"),
    ]
    (axes,) = reach(by_radius(tmp_path)).axes
    assert heights(axes.lines[0]) == {len(RADII) - 1: 1.5}
    assert heights(axes.lines[1]) == {0: 4.0, len(RADII) - 1: 2.0}, "no line between them"
    assert [*axes.lines[2].get_ydata()] == [2.5, 2.5], "one line for all radii"


def test_tables_of_the_pages_are_of_their_data():
    for page in (ROOT / "docs" / "results").glob("*.md"):
        assert fill(page) == page.read_text(encoding="utf-8"), page
