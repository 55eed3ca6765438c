"""Comparisons: what may be compared, and what tables and files say."""

import io
import json

import pytest
from pandas import DataFrame
from pytest import approx
from rich.console import Console

from baselines.cli.compare import train_and_compare
from baselines.compare.curves import draw_gaps
from baselines.compare.records import Results, RunRecord, find_records
from baselines.compare.report import marl_eval_data, report_comparison
from baselines.compare.summary import summarise
from baselines.compare.tables import overall_tables, print_comparison
from baselines.compare.text_table import TextTable, csv_text
from baselines.compare.variants import CompareConfig
from baselines.runs.files import Place, RunError, write_json
from baselines.runs.folder import RunFolder
from mbn_marl.config import NavigationConfig
from mbn_marl.errors import ConfigError, MbnError
from mbn_marl.field import Field, load_field, load_split
from tests.support.records import make_run, make_runs


def test_a_comparison_by_hand(tmp_path):
    scores = {"field_01": (0.8, 0.5), "field_03": (1.0, 0.25)}
    records = []
    for field, pair in scores.items():
        records += make_runs(tmp_path, {"mappo": pair}, field=field)
        records += make_runs(tmp_path, {"ppo": [0.6, 0.6]}, field=field, label="central")
    write_json(records[0].run.path / "versions.json", {"git_revision": "abc-dirty"})
    write_json(records[1].run.path / "versions.json", {"git_revision": "abc"})
    found = summarise(Results.of(records))
    order = [(label, field) for field in scores for label in ("mappo", "central")]
    assert [(row["label"], row["field"]) for row in found.rows] == order
    assert found.rows[0] == {
        **{"label": "mappo", "algorithm": "mappo", "form": "decentralized", "information": "all"},
        **{"field": "field_01", "runs": 2, "env_steps": 400, "seconds": 10.5},
        **{
            "passed": 1,
            "pass_low": approx(0.0945, rel=1e-3),
            "pass_high": approx(0.9055, rel=1e-3),
        },
        **{"gap": approx(0.25), "spl": 0.65, "spl_low": 0.5, "spl_high": 0.8},
        **{"success_rate": 0.75, "makespan": 22.5, "return_mean": 112_500.0},
        **{"deterministic_success_rate": 0.625, "deterministic_makespan": 22.5},
        **{"deterministic_spl": 0.525, "deterministic_return_mean": 93_750.0},
        **{"env_steps_to_pass": 350.0, "never_passed": 1},
    }
    mappo, central = found.aggregates
    # SPL 0.25, 0.5, 0.8, 1: the middle two, and the lowest. A failure has no gap.
    assert (mappo["iqm"], mappo["worst_tenth"]) == (approx(0.65), 0.25)
    assert (mappo["gap"], central["gap"]) == (approx(0.125), None)
    assert (mappo["passed"], mappo["runs"], mappo["fields"]) == (2, 4, 2)
    (pair,) = found.pairs
    assert (pair["better"], pair["worse"]) == ("mappo", "central")
    assert pair["difference"] == approx(0.0375)
    names = ("label", "field", "seed", "passed", "first_pass", "policy_env_steps", "clean")
    runs = {tuple(run[name] for name in names): run["revision"] for run in found.runs}
    assert runs["mappo", "field_01", 0, True, 300, 300, False] == "abc"
    assert runs["mappo", "field_01", 1, False, None, 300, True] == "abc"
    assert len(runs) == 8


def test_tables_and_files_hold_the_numbers(tmp_path):
    (tmp_path / "runs").mkdir()
    make_runs(tmp_path / "runs", {"mappo": [1.0, 0.5]})
    make_runs(tmp_path / "runs", {"mappo": [0.8, 0.8]}, label="other")
    out = io.StringIO()
    results = Results.of(find_records([tmp_path / "runs"]))
    comparison = summarise(results)
    print_comparison(comparison, Console(width=200, file=out))
    lines = [" ".join(line.split()) for line in out.getvalue().splitlines()]
    assert "field_03: 400 env-steps a run, 2 seeds each" in lines
    over_all = lines.index("other all D 2/2 25.0% 100.0% 80.0% 80.0% 150,000 0k")
    assert lines[over_all + 1].endswith("80.0..80.0")
    behind = lines.index("mappo all D 1/2 0.0% 75.0% 75.0% 50.0% 112,500 0k")
    assert over_all < behind and lines[behind + 1].endswith("50.0..100.0 1 never")
    encoded = json.loads(json.dumps(vars(comparison), allow_nan=False))
    ends = [encoded["aggregates"][1][f"iqm{end}"] for end in ("", "_low", "_high")]
    assert ends == [0.75, 0.5, 1.0]
    assert sum(len(line.get_xdata()) for line in draw_gaps(comparison).axes[0].lines) == 4
    failing, passing = (
        marl_eval_data(results)["mbn_marl"]["field_03"][label][f"seed_{seed}"]
        for label, seed in (("mappo", 1), ("other", 0))
    )
    assert [*passing] == ["step_0", "step_1", "step_2", "absolute_metrics"]
    numbers = {"return": [150_000.0], "success_rate": [1.0], "makespan": [25.0], "spl": [0.8]}
    assert passing["step_1"] == {"step_count": 300, **numbers}
    assert passing["absolute_metrics"] == numbers
    assert failing["absolute_metrics"]["makespan"] == [(20.0 + 1000.0) / 2]  # of 20 and T_max


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
def test_what_may_not_be_compared_is_refused_by_place(changes, places, tmp_path):
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


def test_labels_may_name_different_tasks(tmp_path):
    plain = make_run(tmp_path)
    Results.of([plain, make_run(tmp_path, label="team", environment=TEAM)])  # sees other things
    lulls = [
        make_run(tmp_path, algorithm=name, environment=world)
        for name, world in zip(("mappo", "ippo", "ppo"), (*GUSTS[:1], *GUSTS), strict=True)
    ]
    Results.of(lulls[:2])
    with pytest.raises(ConfigError, match=r"environment\.gust_time: "):
        Results.of(lulls)
    windy = make_run(tmp_path, 0.9, label="windy", environment=WIND, bounded=False)
    comparison = summarise(Results.of([plain, windy]))
    assert not comparison.aggregates and comparison.fields_without_bound == ["field_03"]
    assert "no bound is proved" in comparison.verdict


def test_only_finished_runs_are_compared(tmp_path):
    run = make_run(tmp_path).run
    (run.path / "evaluation.json").unlink()
    with pytest.raises(RunError, match=r"evaluation\.json"):
        find_records([tmp_path])
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunError, match="empty"):
        find_records([tmp_path / "empty"])


def test_runs_on_random_fields_are_of_their_tier(tmp_path):
    random = {"field": "random_convex", "algorithm": "mappo", "setting": "G"}
    runs = [make_run(tmp_path, seed=seed, tier="1-convex", **random) for seed in (0, 1)]
    left_out = make_run(tmp_path, tier="1-convex", **random).run
    write_json(left_out.path / "config.json", {**left_out.config, "tier": None})
    notes = []
    found = find_records([tmp_path], notes.append)
    assert [record.run.path for record in found] == [record.run.path for record in runs]
    assert notes == [f"left out: {left_out.path}, trained on random fields"]
    with pytest.raises(RunError, match=str(left_out.path)):
        find_records([left_out.path])
    assert [row["field"] for row in summarise(Results.of(found)).rows] == ["1-convex"]
    assert found[0].field_to_show() == load_split("test", "1-convex")[0].field
    shapes = {**random, "field": "random_shapes", "label": "shapes"}
    runs += [make_run(tmp_path, seed=seed, tier="1-convex", **shapes) for seed in (0, 1)]
    with pytest.raises(ConfigError, match=r"fields: .* of the name 1-convex"):
        Results.of(runs)


def test_each_frozen_field_has_a_row_without_a_makespan_if_it_failed(tmp_path):
    random = {"field": "random_convex", "algorithm": "mappo", "setting": "G"}
    run = make_run(tmp_path, tier="1-convex", **random).run
    found = run.evaluation
    found["deterministic"]["per_episode"] = {
        **{"bounds": [10] * 101, "successes": [True, *[False] * 100], "steps": [12] * 101}
    }
    write_json(run.path / "evaluation.json", found)
    rows = RunRecord.read(RunFolder.open(run.path)).instances
    who = {"label": "mappo-G", "field": "1-convex", "seed": 0}
    names = [one.field.name for one in load_split("test", "1-convex")]
    assert [row["instance"] for row in rows] == [*names, names[0]]
    assert rows[0] == {**who, "instance": names[0], "bound": 10, "makespan": 12}
    assert {row["makespan"] for row in rows[1:]} == {None}


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
        ("evaluation.json", ["stochastic", "spl"], "x"),
        *(("evaluations.json", [], bad) for bad in ({"a": 1}, [])),
        ("evaluations.json", [0, "seconds"], "x"),
    ],
)
def test_an_entry_that_no_run_writes_is_named(file, path, value, tmp_path):
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


def test_words_stay_in_their_cells(capsys):
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
    TextTable("a [c]", ("[b]", "x"), (("runs[old]/[/a]:x:", "1"),)).print("[t]")
    said = capsys.readouterr().out
    assert all(word in said for word in ("[t]", "[b]", "runs[old]/[/a]:x:", "a [c]")), said


def test_a_narrow_terminal_breaks_no_word():
    out, headings = io.StringIO(), ("label", *(f"number {k}" for k in range(10)))
    table = TextTable("", headings, (("a-label", *(f"-{k},972,196" for k in range(10))),))
    table.print("a title", Console(width=80, file=out))
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert [line.split()[0] for line in lines if "196" in line] == ["a-label"] * 2
    assert {*out.getvalue().split()} >= {f"-{k},972,196" for k in range(10)}


@pytest.mark.parametrize(
    "joint, mappo, words",
    [
        ([0.5] * 2, [0.5] * 2, "No run passes: the budget of 400 env-steps is too small"),
        ([0.9], [0.8], "With one seed the order of ppo-joint (centralized) and mappo (dec"),
        ([0.9, 0.75], [0.8, 0.95], "stays open (-10.0 .. 20.0 points of SPL, p = 0.6"),
        (
            *([0.9] * 5, [0.8] * 4 + [0.7]),
            "ppo-joint (centralized) is ahead of mappo (decentralized) by 10.0 .. 16.0 points of "
            "SPL (p = 0.00",
        ),
    ],
)
def test_the_result_in_words(joint, mappo, words, tmp_path):
    comparison = summarise(Results.of(make_runs(tmp_path, {"ppo-joint": joint, "mappo": mappo})))
    assert words in comparison.verdict
    caption = overall_tables(comparison)["Differences of SPL"].caption
    assert ("80 %" in caption) == (len(joint) > 3)  # 2 of the 20 ways to share six runs is 10 %
    asked = "Centralized (ppo-joint) or decentralized (mappo) on field_03, 400 env-steps a run, "
    assert comparison.question.startswith(asked)


def test_a_report_that_fails_leaves_nothing(tmp_path):
    (tmp_path / "runs").mkdir()
    make_runs(tmp_path / "runs", {"mappo": [1.0, 0.5]})
    with pytest.raises(MbnError):  # these runs have no policy to draw
        report_comparison([tmp_path / "runs"], tmp_path / "out.md", command="mbn report")
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_folder_whose_name_ends_as_a_page_is_a_folder(tmp_path, monkeypatch, capsys):
    places = []
    results = Results.of(make_runs(tmp_path, {"mappo": [1.0, 0.5]}))
    monkeypatch.setattr("baselines.compare.run.train_all_runs", lambda *_, **how: results)
    monkeypatch.setattr(
        "baselines.compare.report.write_comparison",
        lambda results, place: (places.append(place), summarise(results))[1],
    )
    train_and_compare(CompareConfig(), tmp_path / "new.md", command="mbn compare")
    assert places == [Place(tmp_path / "new.md" / "comparison.md", tmp_path / "new.md")]
    said = capsys.readouterr().out
    assert said.count("up to 1,802,240 env-steps, not 1,800,000") == 4, "once whatever the seed"


def test_the_result_changes_no_library_with_the_form(tmp_path):
    scores = {"ppo": 0.95, "ppo-joint": 0.9, "mappo": 0.8}
    runs = make_runs(tmp_path, {name: [spl] * 5 for name, spl in scores.items()})
    assert "ppo-joint (centralized) is ahead of mappo" in summarise(Results.of(runs)).verdict
    apart = [run for run in runs if run.config["algorithm"] != "ppo-joint"]
    assert "ppo (centralized) is ahead of mappo" in summarise(Results.of(apart)).verdict
