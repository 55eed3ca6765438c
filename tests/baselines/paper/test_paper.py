"""The report on the paper's experiments: cells by hand, what is missing, and how it says no."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from pandas.testing import assert_frame_equal

from baselines.cli import main
from baselines.paper import tables
from baselines.paper.report import mean_panels, panels
from baselines.paper.studies import Study
from baselines.paper.trainings import find_trainings, first_reach, read_progress
from baselines.runs.files import RunError, write_json
from baselines.runs.folder import RunFolder
from mbn_marl.field import load_field, save_field

pytestmark = pytest.mark.slow

NOTHING = (0, np.nan, np.nan, np.nan, np.nan)
Row = tuple[float, float, float, float, float]
"""Episodes, mean, SD, smallest and largest return of a window of training."""


def make_run(
    folder: Path,
    rows: Sequence[Row],
    *,
    algorithm: str = "ppo",
    setting: str = "A",
    field: str = "field_01",
    seed: int = 33,
    finished: bool = True,
    every: int = 1000,
) -> Path:
    path = folder / f"{algorithm}-{setting}-{Path(field).stem}-seed{seed}"
    config = {"algorithm": algorithm, "setting": setting, "field": field, "seed": seed}
    run = RunFolder.create(path, config, load_field(field), f"mbn train {algorithm} {field}")
    names = ("episodes", "return_mean", "return_std", "return_min", "return_max")
    for index, row in enumerate(rows, start=1):
        known = {"env_steps": index * every, "seconds": 1.0, **dict(zip(names, row, strict=True))}
        run.append_progress({**known, "success_rate": 0.0})
    if finished:
        stochastic = {"success_rate": 0.25, "return_mean": -1234.0}
        write_json(path / "evaluation.json", {"stochastic": stochastic})
    return path


def report(folder: Path) -> str:
    assert main(["report", "--paper", str(folder), "-o", str(folder / "out")]) == 0
    return (folder / "out" / "paper.md").read_text()


def cells(path: Path, *key: str) -> list[list[str]]:
    lines = csv.reader(io.StringIO(path.read_text()))
    return [line[len(key) :] for line in lines if line[: len(key)] == list(key)]


def test_a_cell_is_the_mean_sd_max_and_range_of_all_its_episodes(tmp_path):
    # Episodes of 0, 1, 4 and -9 million: mean -1; squares 1 + 4 + 25 + 64, so SD sqrt(23.5).
    # Their moving means, a row each: 0.5, 0.5 and 5/3 in field_01, -9 in field_03.
    half = (2, 0.5e6, 0.5e6, 0.0, 1e6)
    make_run(tmp_path, [half, NOTHING, (1, 4e6, 0.0, 4e6, 4e6)])
    make_run(tmp_path, [(1, -9e6, 0.0, -9e6, -9e6)], field="field_03")
    page = report(tmp_path)
    assert "| PPO | mean | -0.2128 | -1.5833 |" in page
    algorithms = tmp_path / "out" / "algorithms.csv"
    (shown,) = cells(algorithms, "PPO", "A", "here", "single episodes", "1e6 reward")
    assert [float(word) for word in shown] == pytest.approx([-1.0, 23.5**0.5, 4.0, 13.0])
    means = [0.5, 0.5, 5 / 3, -9.0]
    (shown,) = cells(algorithms, "PPO", "A", "here", "moving means of 100 episodes", "1e6 reward")
    by_hand = [np.mean(means), np.std(means), 5 / 3, 5 / 3 + 9.0]
    assert [float(word) for word in shown] == pytest.approx(by_hand, rel=1e-6)
    fields = tmp_path / "out" / "fields.csv"
    (shown,) = cells(fields, "field_01", "A", "here", "single episodes", "reward")
    by_hand = [5e6 / 3, np.std([0.0, 1e6, 4e6]), 4e6, 4e6]
    assert [float(word) for word in shown] == pytest.approx(by_hand)


def test_the_moving_mean_is_over_the_latest_hundred_episodes(tmp_path):
    rows = [NOTHING, (60, 10, 0, 10, 10), (60, 20, 0, 20, 20), NOTHING, (100, 50, 0, 50, 50)]
    progress = read_progress(make_run(tmp_path, rows) / "progress.csv")
    begun = progress[progress.moving_mean.notna()]
    assert begun.env_steps.tolist() == [2000, 3000, 4000, 5000]
    assert begun.moving_mean.tolist() == [10.0, 15.0, 15.0, 50.0]
    assert first_reach(progress, 15.0) == 3000
    assert first_reach(progress, 10.0) == 3000, "not before a hundred episodes have ended"
    assert np.isnan(first_reach(progress, 51.0))


def test_missing_cells_say_so_and_setting_n_is_marked_as_ours(tmp_path):
    for algorithm in ("ppo", "mappo"):
        make_run(tmp_path, [(1, 5e5, 0, 5e5, 5e5)], setting="N", algorithm=algorithm)
    page = report(tmp_path)
    heading = "| A paper | A here | B paper | B here | C paper | C here | N here, ours |"
    assert page.count(heading) == 2, "by algorithm and by field"
    assert "| field_01 | mean | -223,295.0 | missing | -297,279.0 | missing |" in page
    assert (
        "| PPO | mean | -0.2128 | missing | -0.1807 | missing | -0.3310 | missing | 0.5000 |"
    ) in page
    runs, table = (f"| MAPPO {'| - ' * 3}| 1 x 1k |", f"| MAPPO | mean {'| - ' * 6}| 0.5000 |")
    shown = page.replace(tables.DASH, "-")
    assert runs in shown and table in shown, "the paper has no MAPPO"
    assert "curves_N.png" in page and not (tmp_path / "out" / "curves_A.png").exists()
    table = tmp_path / "out" / "algorithms.csv"
    assert cells(table, "TQC", "A", "here", "single episodes") == [["1e6 reward", "", "", "", ""]]


def test_rankings_are_compared_by_kendalls_tau(tmp_path):
    # The paper under A: CrossQ, TRPO, PPO. Here PPO, CrossQ, TRPO: one pair of three agrees.
    for algorithm, mean in {"ppo": 3e6, "crossq": 2e6, "trpo": 1e6}.items():
        make_run(tmp_path, [(1, mean, 0, mean, mean)], algorithm=algorithm)
        make_run(tmp_path, [NOTHING], algorithm=algorithm, field="field_03", seed=7)
    make_run(tmp_path, [(1, -9e6, 0, -9e6, -9e6)], algorithm="ppo", field="field_03")
    for field in ("field_01", "field_02", "field_03"):
        make_run(tmp_path, [(1, 0, 0, 0, 0)], algorithm="ars", setting="B", field=field)
    make_run(tmp_path, [(1, 9e6, 0, 9e6, 9e6)], algorithm="tqc", setting="B")  # one of three
    lines = tables.ranking(find_trainings([tmp_path])).lines
    paper = "CrossQ > TRPO > TQC > PPO > ARS > A2C"
    assert lines[0] == ("A", paper, "PPO > CrossQ > TRPO", "-0.33", "1.00", "field_01")
    assert lines[1][2:] == ("ARS", "missing", "missing", "field_01, field_02, field_03")
    assert lines[2][2:] == ("missing",) * 4


def test_the_mean_over_fields_is_of_those_that_all_algorithms_have(tmp_path):
    for algorithm, field, mean in (
        ("ppo", "field_01", 1e6),
        ("ppo", "field_03", 4e6),
        ("trpo", "field_01", 2e6),
        ("trpo", "field_03", 3e6),
        ("trpo", "field_04", 9e6),  # ppo has none
    ):
        rows = [(1, mean, 0, mean, mean)] * 2
        for seed, more in (33, 0.0), (34, 2e6):
            run = [(1, one[1] + more, 0, one[1] + more, one[1] + more) for one in rows]
            make_run(tmp_path, run, algorithm=algorithm, field=field, seed=seed)
    runs = find_trainings([tmp_path])
    ((title, panel),) = mean_panels(runs).items()
    assert title == "setting A, 2 fields"
    found = {name: [means.tolist() for _, means in of] for name, of in panel.curves.items()}
    assert found == {"PPO": [[2e6] * 2, [5e6] * 2], "TRPO": [[3e6] * 2, [4e6] * 2]}
    assert panel.optimum == (runs.optimum("field_01") + runs.optimum("field_03")) / 2
    assert [len(panel.curves["TRPO"]) for panel in panels(runs, "A").values()] == [2, 2, 2]


def test_a_page_can_stand_beside_its_folder_with_notes_on_top(tmp_path):
    make_run(tmp_path / "runs", [(1, 0, 0, 0, 0)])
    notes = tmp_path / "notes.md"
    notes.write_text("CrossQ was not run.\n")
    page = tmp_path / "docs" / "paper.md"
    words = ["report", "--paper", str(tmp_path / "runs"), "-o", str(page), "--notes", str(notes)]
    assert main(words) == 0
    text = page.read_text()
    assert text.splitlines()[2] == "CrossQ was not run."
    assert "](paper/curves_A.png)" in text and "](paper/algorithms.csv)" in text
    names = {file.name for file in (tmp_path / "docs" / "paper").iterdir()}
    assert names >= {"algorithms.tex", "runs.csv", "progress.csv.xz", "versions.json"}
    assert main(words) == 2, "nothing is overwritten"


def test_a_report_holds_its_runs_for_the_next_one(tmp_path, capsys):
    file = tmp_path / "orchard.yaml"
    save_field(load_field("field_03"), file)
    good = (100, 123_456, 7, -28_524_165, 123_456)
    old, new = tmp_path / "old", tmp_path / "new"
    make_run(old, [NOTHING, (2, 1e6 / 3, 1, 1, 2), NOTHING, good], every=300_000)
    make_run(old, [(1, 2, 0, 2, 2)], field=str(file), seed=7)
    make_run(old, [NOTHING], algorithm="tqc", finished=False)
    make_run(new, [(1, 5, 0, 5, 5)], algorithm="tqc")
    both, first, again = (tmp_path / name for name in ("both", "first", "again"))
    for sources, out in (((old, new), both), ((old,), first), ((first, first, new), again)):
        assert main(["report", "--paper", *map(str, sources), "-o", str(out)]) == 0
    assert "tqc-A-field_01-seed33 is the same, finished" in capsys.readouterr().out
    for part in ("runs", "rows"):
        recorded, read = (getattr(find_trainings([path]), part) for path in (old, first))
        assert_frame_equal(recorded, read)
    for name in ("algorithms.csv", "fields.tex", "runs.csv"):
        lines = [(folder / name).read_text().splitlines() for folder in (both, again)]
        assert sorted(lines[0]) == sorted(lines[1])
    packed, table = first / "progress.csv.xz", first / "runs.csv"
    packed.write_bytes(packed.read_bytes()[:-40])
    with pytest.raises(RunError, match=r"progress\.csv\.xz"):
        find_trainings([first])
    table.write_text(table.read_text().replace("env_steps", "steps"))
    with pytest.raises(RunError, match=r"runs\.csv.*env_steps"):
        find_trainings([first])


def make_study(folder: Path) -> Path:
    folder.mkdir()
    rows = ("0,COMPLETE,-5,0.9,1000", "1,COMPLETE,-3,0.95,95000", "2,PRUNED,-1,0.96,1", "3,FAIL,,,")
    table = ("number,state,value,params_gamma,params_buffer_size", *rows)
    (folder / "trials.csv").write_text("\n".join(table))
    write_json(folder / "config.json", {"algorithm": "crossq", "field": "a/b.yaml", "steps": 1500})
    (folder / "history.png").write_bytes(b"picture")
    return folder


def test_a_report_shows_and_keeps_studies(tmp_path):
    run = make_run(tmp_path / "runs", [(1, 0, 0, 0, 0)])
    study, out = make_study(tmp_path / "tuned"), tmp_path / "out"
    words = ["report", "--force", "-o", str(out), "--paper"]
    assert main([*words, str(run), "--study", str(study)]) == 0
    first = (out / "paper.md").read_text().split("## Hyperparameters")[1]
    paper = (
        "| CrossQ on b | paper | 0.0013 | 0.953 | 0.959 | 0.531 | 0.0248 | 0.6072 | 95,000 | 20 |"
    )
    none = f"{tables.DASH} | {tables.DASH}"
    assert f"{paper} 1,000,000 | {none} |" in first
    here = f"|  | here | {tables.DASH} | 0.95 | {none} | {none} | 95,000 | 3 | 1,500 | 1 | -3 |"
    assert here in first and "](tuned/history.png)" in first
    # The report is an input of the one that replaces it.
    assert main([*words, str(out), "--study", str(out / "tuned")]) == 0
    assert (out / "paper.md").read_text().split("## Hyperparameters")[1] == first
    for file in study.iterdir():
        assert (out / "tuned" / file.name).read_bytes() == file.read_bytes()


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("config.json", "crossq", "mappo"),
        ("config.json", "1500", '"many"'),
        ("trials.csv", "COMPLETE", "FAIL"),
        ("trials.csv", "state", "ending"),
        ("trials.csv", "-3", "three"),
        ("trials.csv", None, None),
        ("history.png", None, None),
    ],
)
def test_a_broken_study_is_refused_by_place(name, old, new, tmp_path):
    study = make_study(tmp_path / "tuned")
    if old is None:
        (study / name).unlink()
    else:
        (study / name).write_text((study / name).read_text().replace(old, new))
    with pytest.raises(RunError, match=str(study)):
        Study.read(study)


def test_all_broken_studies_are_named_before_anything_moves(tmp_path, refusal):
    run = make_run(tmp_path / "runs", [(1, 0, 0, 0, 0)])
    for name in ("one", "two"):
        (make_study(tmp_path / name) / "trials.csv").unlink()
    page = tmp_path / "out" / "paper.md"
    page.parent.mkdir()
    page.touch()
    error = refusal(
        ["report", "--force", "--paper", str(run), "-o", "out", "--study", "one", "good", "two"]
    )
    assert all(f"{name} has no" in error for name in ("one", "good", "two")) and page.is_file()


def test_comparisons_and_what_was_moved_aside_are_left_out(tmp_path, capsys):
    run = make_run(tmp_path / "runs", [(1, 3e6, 0, 3e6, 3e6)])
    make_run(tmp_path / "old", [(1, 9e6, 0, 9e6, 9e6)]).rename(run.with_name(f"{run.name}.1"))
    demo = tmp_path / "runs" / "demo"
    make_run(demo, [(1, 9e6, 0, 9e6, 9e6)])
    make_run(demo, [(1, 9e6, 0, 9e6, 9e6)], seed=34)
    write_json(demo / "config.json", {"variants": []})
    page = tmp_path / "page.md"
    words = ["report", "--paper", str(tmp_path / "runs"), "-o", str(page)]
    assert main(words) == 0
    assert "| PPO | mean | -0.2128 | 3.0000 |" in page.read_text()
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == [
        f"left out: {demo}, a comparison; name it to report on its runs",
        f"left out: {run}.1, moved aside by --force",
    ]
    assert find_trainings([demo]).runs.seed.tolist() == [33, 34]


def test_runs_that_are_not_their_settings_are_left_out(tmp_path, capsys):
    make_run(tmp_path, [(1, 3e6, 0, 3e6, 3e6)])
    wrong = [{"environment": {"tau": 0.5}}, {"hyperparameters": {"reward_scale": 0.5}}]
    wrong += [{**wrong[1], "hyperparams": "own.yaml"}]
    for seed, changes in enumerate(wrong):
        other = make_run(tmp_path, [(1, 9e6, 0, 9e6, 9e6)], seed=seed)
        write_json(other / "config.json", {**RunFolder.open(other).config, **changes})
    assert "| PPO | mean | -0.2128 | 3.0000 |" in report(tmp_path)
    lines = capsys.readouterr().out.splitlines()[:3]
    ends = ("environment", "hyperparameters", "hyperparameters")
    assert all(line.startswith("left out: ") for line in lines)
    assert sorted(line.split("setting's ")[1] for line in lines) == sorted(ends)
    with pytest.raises(RunError, match="no run of a setting as it is"):
        find_trainings([other])
    write_json(other / "config.json", {**RunFolder.open(other).config, "setting": "B"})
    assert find_trainings([other]).runs.setting.tolist() == ["B"], "tuned values are of a file"


def test_of_two_runs_of_a_cell_the_finished_one_is_taken(tmp_path):
    killed = make_run(tmp_path / "a", [(1, 9e6, 0, 9e6, 9e6)], finished=False)
    whole = make_run(tmp_path / "b", [(1, 3e6, 0, 3e6, 3e6)])
    notes = []
    found = find_trainings([tmp_path], notes.append)
    assert found.rows.return_mean.tolist() == [3e6] and found.runs.finished.tolist() == [True]
    (note,) = notes
    assert note.startswith(f"left out: {killed}, unfinished") and str(whole) in note
    for finished in (True, False):
        make_run(tmp_path / f"c{finished}", [(1, 1, 0, 1, 1)], seed=7, finished=finished)
        make_run(tmp_path / f"d{finished}", [(1, 1, 0, 1, 1)], seed=7, finished=finished)
        with pytest.raises(RunError, match=rf"c{finished}.* and .*d{finished}"):
            find_trainings([tmp_path / f"c{finished}", tmp_path / f"d{finished}"])


@pytest.mark.parametrize("kind", ["--comparison", "--paper"])
def test_a_report_never_moves_its_runs_aside(kind, tmp_path, refusal):
    run = make_run(tmp_path / "all" / "one", [(1, 0, 0, 0, 0)])
    for given, out in ((run, run.parent), (run.parent, run.parent), (run.parent, run)):
        words = ["report", kind, str(given), "-o", str(out), "--force"]
        assert "would replace a RUN" in refusal(words) and run.is_dir()


@pytest.mark.parametrize(
    ("words", "place"),
    [
        ("", "RUN: "),
        ("runs", "kind: "),
        ("--force --comparison runs ./out", "would replace a RUN"),
        ("--paper runs --study empty", "empty"),
        ("--paper runs --notes latin.md", "latin.md"),
        ("--paper runs copy", "copy"),
        ("--paper old", "config.json"),
        ("--comparison runs --marl-eval out", "marl_eval: "),
    ],
)
def test_wrong_input_is_refused_by_place(words, place, tmp_path, refusal):
    for name in ("runs", "copy", "old"):
        run = make_run(tmp_path / name, [(1, 0, 0, 0, 0)])
    write_json(run / "config.json", {"algorithm": "ppo", "field": "field_01", "seed": 0})
    (tmp_path / "latin.md").write_bytes("très".encode("latin-1"))
    assert place in refusal(["report", *words.split(), "-o", "out"])
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("return_std", "deviation", "return_std"),
        ("1000,", "many,", "line 2"),
        ("2000,1,1,0,0,0,0", "2000,1,1,0,0", "line 3"),
        ("2000,1,1,0", "2000,1,1,nan", "line 3"),
    ],
)
def test_progress_that_cannot_be_read_names_the_place(old, new, place, tmp_path):
    path = make_run(tmp_path, [(1, 0, 0, 0, 0)] * 2) / "progress.csv"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(RunError, match=f"progress.csv.*{place}"):
        read_progress(path)


@pytest.mark.parametrize("rows", [[], [NOTHING]], ids=["no row yet", "no episode yet"])
def test_a_run_without_an_ended_episode_is_missing(rows, tmp_path):
    make_run(tmp_path, rows, finished=False)
    runs = find_trainings([tmp_path])
    assert tables.coverage(runs).lines[1][1] == f"1 x {len(rows)}k, 1 unfinished"
    assert {table.text().lines[4][3] for table in tables.paper_tables(runs)[:2]} == {"missing"}
    assert panels(runs, "A") == mean_panels(runs) == {}
    assert np.isnan(runs.runs.reach).all()
