"""Comparisons: what may be compared, and what tables and files say."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest

from baselines.algorithms import ALGORITHMS
from baselines.compare.records import find_records, ordered
from baselines.compare.results import Results
from baselines.compare.summary import THRESHOLDS, summarise
from baselines.compare.tables import gaps, print_comparison
from baselines.console import WholeCells
from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from mbn_marl.config import NavigationConfig
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, load_field, load_fields
from tests.support.records import make_run


def test_an_algorithm_looks_the_same_whatever_it_is_compared_with() -> None:
    registry = list(ALGORITHMS)
    every = ordered({name: name for name in reversed(registry)})
    assert list(every.items()) == [(name, place) for place, name in enumerate(registry)]
    mappo = registry.index("mappo")
    assert ordered({"mappo": "mappo"}) == {"mappo": mappo}
    # A second label of mappo has the first look that no algorithm here has: a2c's, then trpo's.
    labels = {"team": "mappo", "ppo": "ppo", "alone": "mappo", "last": "mappo"}
    found = ordered(labels)
    assert list(found) == ["ppo", "alone", "last", "team"]
    assert list(found.values()) == [registry.index("ppo"), mappo, 0, 2]


def test_order_and_looks_do_not_depend_on_the_order_of_the_runs(tmp_path: Path) -> None:
    names = [("mappo", "field_03"), ("ppo", "field_03"), ("mappo", "field_01"), ("ppo", "field_01")]
    runs = [make_run(tmp_path, algorithm=name, field=field) for name, field in names]
    found, back = Results.of(runs), Results.of(runs[::-1])
    assert list(found.looks.items()) == list(back.looks.items())
    assert (found.labels, found.fields) == (("ppo", "mappo"), ("field_01", "field_03"))
    assert summarise(found).to_json() == summarise(back).to_json()


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
    assert (
        row.items()
        >= {
            **{
                "label": "mappo",
                "algorithm": "mappo",
                "form": "decentralized",
                "field": "field_01",
            },
            **{"seeds": 2, "env_steps": 400, "seconds": 10.5, "makespan": 20.0},
            **{"optimum": 158_800.0, "optimum_share": 0.375, "return_mean": 59_550.0},
            **{"return_low": 39_700.0, "return_high": 79_400.0},
            **{"success_rate": 0.75, "deterministic_success_rate": 0.5},
            **{"deterministic_return": 0.75 * 158_800.0, "deterministic_best": 158_800.0},
            **{"reached": 1, "env_steps_to_threshold": 300.0, "seconds_to_threshold": 3.0},
        }.items()
    )
    assert [(entry["label"], entry["field"]) for entry in found.rows] == [
        ("central", "field_01"),
        ("mappo", "field_01"),
        ("central", "field_03"),
        ("mappo", "field_03"),
    ]
    central, mappo = found.aggregates
    # Sampled scores 0.5, 0.25, 0.375, 0.125: the middle two, and the mean shortfall.
    assert mappo["iqm"].value == pytest.approx(0.3125)
    assert mappo["gap"].value == pytest.approx(0.6875)
    assert mappo["deterministic_gap"].value == pytest.approx(0.375)
    assert (mappo["reached"], mappo["fields"], mappo["seeds"]) == (2, 2, 2)
    assert (central["form"], central["success_rate"]) == ("centralized", 0.6)
    # In each field one run of two is above 0.6 of the optimum.
    assert found.improvement["mappo"]["central"].value == 0.5
    share = dict(zip(THRESHOLDS.round(3), mappo["profile"].share, strict=True))
    assert (share[0.2], share[0.3], share[0.45]) == (0.75, 0.5, 0.25)


def test_the_threshold_is_reached_at_the_first_evaluation_that_has_it(tmp_path: Path) -> None:
    # 100 000 at evaluation 2 of the first run and 4 of the second: the mean of 200 and 400.
    histories = [(0.0, 100_000.0, 5.0), (0.0, 99_999.0, 0.0, 120_000.0), (0.0,)]
    summary = {"return_mean": 0.0, "success_rate": 0.0, "makespan": None}
    final = {"env_steps": 400, "seconds": 1.0, "stochastic": summary, "deterministic": summary}
    runs = []
    for seed, returns in enumerate(histories):
        numbers = enumerate(returns, start=1)
        history = [
            {"env_steps": 100 * k, "seconds": 2.0 * k, "return_mean": mean} for k, mean in numbers
        ]
        runs.append(make_run(tmp_path, seed=seed, recorded=(history, final)))
    (row,) = summarise(Results.of(runs)).rows
    names = ("reached", "seeds", "env_steps_to_threshold", "seconds_to_threshold", "makespan")
    assert [row[name] for name in names] == [2, 3, 300.0, 6.0, None]
    (row,) = summarise(Results.of([make_run(tmp_path, seed=9)])).rows
    assert [row[name] for name in names[:4]] == [0, 1, None, None]


def test_runs_that_pass_are_counted(tmp_path: Path) -> None:
    entry = {"env_steps": 400, "seconds": 1.0, "return_mean": 0.0}
    runs = []
    for seed, (mean, sampled, own) in enumerate(
        [(1e5, 0.99, 1.0), (9e4, 1.0, 1.0), (1e5, 1.0, 0.9)]
    ):
        stochastic = {"return_mean": mean, "success_rate": sampled, "makespan": None}
        final = {"env_steps": 400, "seconds": 1.0, "stochastic": stochastic}
        final["deterministic"] = {**stochastic, "success_rate": own}
        runs.append(make_run(tmp_path, seed=seed, recorded=([entry], final)))
    assert summarise(Results.of(runs)).aggregates[0]["passed"] == 1


def test_tables_and_files_hold_the_numbers(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    for seed, share in enumerate((1.0, 0.5)):
        make_run(tmp_path / "runs", share, seed=seed)
        make_run(tmp_path / "runs", 0.9, seed=seed, label="other")
    out = io.StringIO()
    comparison = summarise(Results.of(find_records([tmp_path / "runs"])))
    print_comparison(comparison, WholeCells(width=200, file=out))
    text = out.getvalue()
    assert "field_03: 400 env-steps a run, 2 seeds each" in text
    line = next(line for line in text.splitlines() if "25.0..50.0" in line)
    assert " ".join(line.split()) == "mappo 0/2 37.5% 25.0..50.0 62.50% 25.00% 75.0% 0k 1/2 3.0"
    encoded = json.loads(json.dumps(comparison.to_json(), allow_nan=False))
    assert encoded["aggregates"][0]["iqm"] == {"value": 0.375, "low": 0.25, "high": 0.5}
    assert encoded["probability_of_improvement"]["other"]["mappo"]["value"] == 0.5
    assert len(encoded["profile_thresholds"]) == len(encoded["aggregates"][0]["profile"]["share"])
    assert comparison.csv().splitlines()[1].startswith("mappo,mappo,decentralized,2,400,0.75")


def test_fields_without_a_proof_are_left_out_of_the_aggregates(tmp_path: Path) -> None:
    known = load_field("field_03")
    own = Field(vertices=known.vertices, rois=known.rois, starts=known.starts, name="own")
    unproved = make_run(tmp_path, 0.5, field_object=own)
    assert summarise(Results.of([unproved])).aggregates == []
    both = summarise(Results.of([unproved, make_run(tmp_path, 0.5)]))
    assert both.unproved == ["own"]
    assert both.aggregates[0]["fields"] == 1
    assert both.aggregates[0]["deterministic_gap"].value == pytest.approx(0.5)


WIND = {**NavigationConfig().model_dump(mode="json"), "wind": [0.1, 30.0]}
TEAM = {**NavigationConfig().model_dump(mode="json"), "reward_sharing": "team"}


@pytest.mark.parametrize(
    ("other", "places"),
    [
        ([], ["seeds: ppo on field_03 has 1 (0)"]),
        (
            [{"field": "field_01", "seed": 1}],
            [
                "seeds: ppo on field_01 has 1 (1)",
                "seeds: ppo on field_03 has 1 (0)",
                "seeds: mappo on field_01 has 0 (none)",
            ],
        ),
        ([{"seed": 0}], ["seeds: ppo on field_03 has 1 (0)", "seeds: ppo on field_03 has seed 0"]),
        (
            [{"seed": 1, "steps": 500, "episodes": 3}],
            ["steps: ", "episodes: "],
        ),
        ([{"seed": 1, "hyperparameters": {}}], ["hyperparameters: "]),
        ([{"seed": 1, "environment": WIND}], ["environment.wind: ", "environment: "]),
        ([{"seed": 1, "environment": TEAM}], ["environment: "]),
    ],
)
def test_what_may_not_be_compared_is_named(
    other: list[dict[str, Any]], places: list[str], tmp_path: Path
) -> None:
    results = [make_run(tmp_path, seed=seed) for seed in (0, 1)]
    results += [make_run(tmp_path, algorithm="ppo", seed=0)]
    results += [make_run(tmp_path, algorithm="ppo", **changes) for changes in other]
    with pytest.raises(ConfigError) as caught:
        Results.of(results)
    assert len(caught.value.problems) == len(places)
    for problem, place in zip(caught.value.problems, places, strict=True):
        assert problem.startswith(place)
    if "steps" in places[0]:
        assert "400" in caught.value.problems[0] and "500" in caught.value.problems[0]


def test_learners_may_see_different_things(tmp_path: Path) -> None:
    Results.of([make_run(tmp_path), make_run(tmp_path, label="team", environment=TEAM)])


def test_gusts_of_different_lengths_are_different_tasks(tmp_path: Path) -> None:
    worlds = [{**WIND, "wind": [0.0, 0.0], "gust": 0.2, "gust_time": time} for time in (5.0, 9.0)]
    runs = [make_run(tmp_path, environment=worlds[0])]
    Results.of([*runs, make_run(tmp_path, algorithm="ippo", environment=worlds[0])])
    with pytest.raises(ConfigError, match=r"environment\.gust_time: "):
        Results.of([*runs, make_run(tmp_path, algorithm="ppo", environment=worlds[1])])


def test_labels_may_name_different_tasks(tmp_path: Path) -> None:
    runs = [make_run(tmp_path), make_run(tmp_path, label="in wind", environment=WIND)]
    assert [*Results.of(runs[:1]).optima] == ["field_03"]
    comparison = summarise(Results.of(runs))
    assert not comparison.aggregates and comparison.unproved == ["field_03"]
    (line,) = gaps(comparison).lines
    cells = dict(zip(comparison.looks, line[1:], strict=True))
    assert cells["in wind"] == "-" and cells["mappo"].endswith("%")
    with pytest.raises(ConfigError, match=r"environment\.wind: "):
        Results.of([runs[0], make_run(tmp_path, algorithm="ppo", environment=WIND)])


def test_fields_of_one_name_must_be_the_same(tmp_path: Path) -> None:
    known = load_field("field_01")
    other = Field(
        vertices=known.vertices, rois=known.rois[:1], starts=known.starts, name="field_03"
    )
    with pytest.raises(ConfigError, match="- fields: "):
        Results.of([make_run(tmp_path), make_run(tmp_path, label="b", field_object=other)])


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
    with pytest.raises(RunError, match="random fields"):
        find_records([random])
