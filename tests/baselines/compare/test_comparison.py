"""Comparisons: what may be compared, and what tables and files say."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest
from pandas import DataFrame
from rich.console import Console

from baselines.compare.records import Results, find_records
from baselines.compare.summary import THRESHOLDS, summarise
from baselines.compare.tables import print_comparison
from baselines.compare.text_table import TextTable, csv_text
from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from mbn_marl.config import NavigationConfig
from mbn_marl.errors import ConfigError, MbnError
from mbn_marl.field import Field, load_field, load_fields
from tests.support.records import make_run


def test_a_comparison_by_hand(tmp_path: Path) -> None:
    shares = {"field_01": (1.0, 0.5), "field_03": (0.75, 0.25)}
    results = [
        make_run(tmp_path, share, field=field, seed=seed)
        for field, pair in shares.items()
        for seed, share in enumerate(pair)
    ]
    results += [
        make_run(tmp_path, 0.6, field=field, seed=seed, algorithm="ppo", label="central")
        for field in shares
        for seed in (0, 1)
    ]
    found = summarise(Results.of(results))
    row = found.rows[1]
    for name, value in {
        **{"label": "mappo", "algorithm": "mappo", "form": "decentralized", "field": "field_01"},
        **{"seeds": 2, "env_steps": 400, "seconds": 10.5, "makespan": 20.0},
        **{"optimum": 158_800.0, "optimum_share": 0.375, "return_mean": 59_550.0},
        **{"return_low": 39_700.0, "return_high": 79_400.0},
        **{"success_rate": 0.75, "deterministic_success_rate": 0.5},
        **{"deterministic_return": 0.75 * 158_800.0, "deterministic_best": 158_800.0},
        **{"reached": 1, "env_steps_to_threshold": 300.0, "seconds_to_threshold": 3.0},
    }.items():
        assert row[name] == value, name
    assert [(entry["label"], entry["field"]) for entry in found.rows] == [
        (label, field) for field in shares for label in ("central", "mappo")
    ]
    central, mappo = found.aggregates
    # Sampled scores 0.5, 0.25, 0.375, 0.125: the middle two, and the mean shortfall.
    assert mappo["iqm"].value == pytest.approx(0.3125)
    assert mappo["gap"].value == pytest.approx(0.6875)
    assert mappo["deterministic_gap"].value == pytest.approx(0.375)
    assert (mappo["reached"], mappo["fields"], mappo["seeds"]) == (2, 2, 2)
    assert (central["form"], central["success_rate"]) == ("centralized", 0.6)
    # In each field one run of two is above 0.6 of the optimum.
    assert found.probability_of_improvement["mappo"]["central"].value == 0.5
    share = dict(zip(THRESHOLDS.round(3), mappo["profile"].share, strict=True))
    assert (share[0.2], share[0.3], share[0.45]) == (0.75, 0.5, 0.25)


def test_tables_and_files_hold_the_numbers(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    for seed, share in enumerate((1.0, 0.5)):
        make_run(tmp_path / "runs", share, seed=seed)
        make_run(tmp_path / "runs", 0.9, seed=seed, label="other")
    out = io.StringIO()
    comparison = summarise(Results.of(find_records([tmp_path / "runs"])))
    print_comparison(comparison, Console(width=200, file=out))
    text = out.getvalue()
    assert "field_03: 400 env-steps a run, 2 seeds each" in text
    line = next(line for line in text.splitlines() if "25.0..50.0" in line)
    assert " ".join(line.split()) == "mappo D 0/2 37.5% 25.0..50.0 62.50% 25.00% 75.0% 0k 1/2 3.0"
    encoded = json.loads(json.dumps(comparison.to_json(), allow_nan=False))
    assert encoded["aggregates"][0]["iqm"] == {"value": 0.375, "low": 0.25, "high": 0.5}
    assert encoded["probability_of_improvement"]["other"]["mappo"]["value"] == 0.5
    assert len(encoded["profile_thresholds"]) == len(encoded["aggregates"][0]["profile"]["share"])
    assert comparison.csv().splitlines()[1].startswith("mappo,mappo,decentralized,2,400,0.75")


WORLD = NavigationConfig().model_dump(mode="json")
WIND, TEAM = {**WORLD, "wind": [0.1, 30.0]}, {**WORLD, "reward_sharing": "team"}
GUSTS = [{**WORLD, "gust": 0.2, "gust_time": time} for time in (5.0, 9.0)]


@pytest.mark.parametrize(
    ("changes", "places"),
    [
        ([{"seed": 0}], ["seeds: ppo on field_03 has 1"]),
        ([{"seed": 0}] * 2, ["seeds: ppo on field_03 has 1", "seeds: ppo on field_03 has"]),
        ([{"seed": 0}, {"seed": 1, "steps": 500, "episodes": 3}], ["steps: ", "episodes: "]),
        ([{"seed": 0}, {"seed": 1, "hyperparameters": {}}], ["hyperparameters: "]),
        ([{"seed": k, "environment": WIND} for k in (0, 1)], ["environment.wind: "]),
        ([{"seed": 0}, {"seed": 1, "environment": TEAM}], ["environment: "]),
        ([{"seed": k, "environment": GUSTS[0]} for k in (0, 1)], ["environment.gust: "]),
        ([{"seed": k, "field_object": "other"} for k in (0, 1)], ["fields: "] * 2),
    ],
)
def test_what_may_not_be_compared_is_refused_by_place(
    changes: list[dict[str, Any]], places: list[str], tmp_path: Path
) -> None:
    known = load_field("field_01")
    other = Field(known.vertices, known.rois[:1], known.starts, name="field_03")
    runs = [make_run(tmp_path, seed=seed) for seed in (0, 1)]
    for one in changes:
        own = {"field_object": other} if "field_object" in one else {}
        runs.append(make_run(tmp_path, algorithm="ppo", **{**one, **own}))
    with pytest.raises(ConfigError) as caught:
        Results.of(runs)
    problems = caught.value.problems
    assert len(problems) == len(places), problems
    assert all(map(str.startswith, problems, places))


def test_labels_may_name_different_tasks(tmp_path: Path) -> None:
    plain = make_run(tmp_path)
    Results.of([plain, make_run(tmp_path, label="team", environment=TEAM)])  # sees other things
    lulls = [
        make_run(tmp_path, algorithm=name, environment=world)
        for name, world in zip(("mappo", "ippo", "ppo"), (*GUSTS[:1], *GUSTS), strict=True)
    ]
    Results.of(lulls[:2])
    with pytest.raises(ConfigError, match=r"environment\.gust_time: "):
        Results.of(lulls)
    comparison = summarise(Results.of([plain, make_run(tmp_path, label="windy", environment=WIND)]))
    assert not comparison.aggregates and comparison.fields_without_proved_optimum == ["field_03"]


def test_only_finished_runs_are_compared(tmp_path: Path) -> None:
    run = make_run(tmp_path).run
    (run.path / "evaluation.json").unlink()
    with pytest.raises(RunError, match=r"evaluation\.json"):
        find_records([tmp_path])

    (tmp_path / "empty").mkdir()
    with pytest.raises(RunError, match="empty"):
        find_records([tmp_path / "empty"])


def test_runs_on_random_fields_are_left_out(tmp_path: Path) -> None:
    one = make_run(tmp_path).run.path
    random = tmp_path / "random"
    RunFolder.create(random, {}, load_fields("random_convex"), "mbn train")
    notes: list[str] = []
    assert [record.run.path for record in find_records([tmp_path], notes.append)] == [one]
    assert notes == [f"left out: {random}, trained on random fields"]
    with pytest.raises(RunError, match=str(random)):
        find_records([random])


@pytest.mark.parametrize(
    ("file", "path", "value"),
    [
        ("config.json", ["label"], "a | b"),
        ("config.json", ["algorithm"], "<b>x"),
        ("config.json", ["setting"], "A"),
        ("config.json", ["seed"], -5),
        ("config.json", ["steps"], 10**30),
        ("config.json", ["environment", "evil"], 1),
        ("config.json", [], [1]),
        ("evaluation.json", ["stochastic", "return_mean"], float("nan")),
        ("evaluation.json", ["deterministic", "success_rate"], 5.0),
        ("evaluation.json", ["stochastic", "makespan"], -1.0),
        *(("evaluations.json", [], bad) for bad in ({"a": 1}, [])),
        ("evaluations.json", [0, "seconds"], "x"),
    ],
)
def test_an_entry_that_no_run_writes_is_named(
    file: str, path: list[Any], value: Any, tmp_path: Path
) -> None:
    place = make_run(tmp_path).run.path / file
    content = json.loads(place.read_text())
    holder = content
    for step in path[:-1]:
        holder = holder[step]
    if path:
        holder[path[-1]] = value
    place.write_text(json.dumps(content if path else value))
    with pytest.raises(MbnError) as caught:
        find_records([tmp_path])
    assert str(place) in str(caught.value)
    assert not path or str(path[-1]) in str(caught.value)


def test_words_stay_in_their_cells() -> None:
    words = ("a | b\n## c", "<img src=x>", r"\input{x}$^~")
    table = TextTable("c", ("x", "y", "z"), (words,), words=3)
    assert (
        table.markdown().splitlines()[-1] == r"| a \| b<br>## c | &lt;img src=x> | \input{x}$^~ |"
    )
    shown = r"\textbackslash input\{x\}\$\textasciicircum \textasciitilde  \\"
    assert shown in table.latex("t") and r"\#\# c" in table.latex("t")
    assert ">&lt;img src=x&gt;</td>" in table.html("t")
    table = TextTable("c", ("a_b", "x"), (("field_01", "-1.5"), ("", "2")))
    assert "a\\_b & x" in table.latex("t") and "field\\_01 & $-$1.5 \\\\\n & 2" in table.latex("t")
    signs = DataFrame({"label": ["=1+2", "+1", "-x", "@x", "plain"], "number": [-1.0, 2, 3, 4, 5]})
    rows = ["label,number", "'=1+2,-1.0", "'+1,2.0", "'-x,3.0", "'@x,4.0", "plain,5.0"]
    assert csv_text(signs).splitlines() == rows


def recorded(passes: bool, makespan: float) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    rate, mean = float(passes), 150_000.0 if passes else -80_000.0
    kind = {"return_mean": mean, "success_rate": rate, "makespan": makespan if passes else None}
    final = {"env_steps": 400, "seconds": 9.0, "stochastic": kind, "deterministic": kind}
    return [{"env_steps": 400, "seconds": 4.0, "return_mean": mean}], final


@pytest.mark.parametrize(
    "joint, mappo, words",
    [
        ([0, 0], [0, 0], "No run passes: the budget of 400 env-steps is too small to compare."),
        ([20], [30], "with one seed the order stays open"),
        ([20, 26], [30, 20], "the order stays open (-"),
        ([20, 21], [30, 31], "ppo-joint (centralized) is faster than mappo (decentralized) by 9."),
        ([20, 0], [30, 31], "in 2 of 2 runs, ppo-joint (centralized) in 1: too few runs"),
        ([0] * 4, [30] * 4, "passes in 4 of 4 runs, ppo-joint (centralized) in 0."),
    ],
)
def test_the_result_in_words(
    joint: list[int], mappo: list[int], words: str, tmp_path: Path
) -> None:
    runs = [
        make_run(tmp_path, recorded=recorded(steps > 0, steps), algorithm=name, seed=seed)
        for name, sides in (("ppo-joint", joint), ("mappo", mappo))
        for seed, steps in enumerate(sides)
    ]
    comparison = summarise(Results.of(runs))
    assert words in comparison.verdict
    assert comparison.to_json()["verdict"] == comparison.verdict
    asked = "Centralized (ppo-joint) or decentralized (mappo) on field_03, 400 env-steps a run, "
    assert comparison.question.startswith(asked)


def test_the_result_changes_no_library_with_the_form(tmp_path: Path) -> None:
    makespans = {"ppo": 10, "ppo-joint": 20, "mappo": 30}
    runs = [
        make_run(tmp_path, recorded=recorded(True, steps), algorithm=name, seed=seed)
        for name, steps in makespans.items()
        for seed in (0, 1)
    ]
    assert "ppo-joint (centralized) is faster than mappo" in summarise(Results.of(runs)).verdict
    apart = [run for run in runs if run.config["algorithm"] != "ppo-joint"]
    assert "ppo (centralized) is faster than mappo" in summarise(Results.of(apart)).verdict
