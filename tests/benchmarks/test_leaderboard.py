"""``python -m benchmarks leaderboard``, on a split with one field a tier."""

import copy
import shutil
from pathlib import Path
from typing import Any

import pytest

from baselines.compare.benchmark import load_protocol, load_tiers, run_benchmark
from baselines.runs.files import read_json, write_json
from benchmarks.__main__ import main
from benchmarks.leaderboard import SPLIT, _problems, leaderboard
from mbn_marl.errors import ConfigError
from mbn_marl.field import splits
from tests.support.frozen import write_split, write_splits
from tests.support.pages import ROOT

pytestmark = pytest.mark.slow
Results = dict[str, dict[str, Any]]


@pytest.mark.all
def test_the_committed_page_is_that_of_the_committed_results():
    page = ROOT / "docs" / "results" / "leaderboard.md"
    assert page.read_text(encoding="utf-8") == leaderboard(page.with_suffix(""))


@pytest.mark.all
def test_the_committed_searches_are_of_the_fields_of_today():
    frozen = load_tiers(SPLIT, [splits.SEARCH])
    paths = [*(ROOT / "docs" / "results" / "search").glob("*.json")]
    assert paths
    for path in paths:
        assert not [*_problems(read_json(path), frozen)], path


@pytest.fixture(scope="module")
def frozen(tmp_path_factory):
    folder = tmp_path_factory.mktemp("splits")
    shutil.copy(Path(str(splits.FOLDER)) / "protocol.json", folder)
    write_splits(folder, 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(splits, "FOLDER", folder)
        yield folder


@pytest.fixture(scope="module")
def results(frozen, tmp_path_factory):
    # Random is made as if it were behind the shield and did not fit the second tier.
    out, tiers = tmp_path_factory.mktemp("out"), load_tiers("test", load_protocol().tiers)
    made = {
        name: run_benchmark(name, "test", tiers, out / name, command=f"mbn benchmark {name}")
        for name in ("greedy", "random")
    }
    made["random"] |= {"shield": True}
    made["random"]["tiers"]["2-sizes"] = {"misfit": "robots: 4", "instances": []}
    return made


def write(results: Results, folder: Path) -> None:
    for name, record in results.items():
        write_json(folder / f"{name}.json", record)


def rows_of(text: str) -> dict[tuple[str, str], tuple[str, ...]]:
    lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    return {(name, way): tuple(cells) for name, way, _, *cells in lines[2:]}


def test_a_table_for_each_tier_with_the_best_first(results, tmp_path):
    write(results, tmp_path / "board")
    assert main(["leaderboard", "--folder", str(tmp_path / "board")]) == 0
    page = (tmp_path / "board.md").read_text()
    parts = {part.splitlines()[0]: part for part in page.split("\n## ")[1:]}
    assert [*parts] == ["All tiers", *load_protocol().tiers, "Commands"]
    greedy, name = ("greedy", "mean"), "random + shield"
    assert [*rows_of(parts["All tiers"])] == [greedy]
    assert [*rows_of(parts["2-sizes"])] == [greedy, (name, "does not fit")]
    for tier in ("1-convex", "5-weather"):
        assert [*rows_of(parts[tier])] == [greedy, (name, "mean")], tier
    (one,) = results["greedy"]["tiers"]["1-convex"]["instances"]
    assert rows_of(parts["1-convex"])[greedy][0] == f"{one['mean']['spl']:.1%}"
    assert f"- {name}: `mbn benchmark random`" in parts["Commands"]


def test_results_of_other_splits_are_refused(results, frozen, tmp_path, monkeypatch):
    now = tmp_path / "now"
    shutil.copytree(frozen, now)
    write_split(now, "1-convex", 1, lambda k, field: (11, 12))
    monkeypatch.setattr(splits, "FOLDER", now)
    with pytest.raises(ConfigError, match="folder: "):
        leaderboard(tmp_path / "board")
    write({"stale": results["greedy"]}, tmp_path / "board")
    with pytest.raises(ConfigError, match=r"stale.json: 1-convex: fields or bounds"):
        leaderboard(tmp_path / "board")


def test_every_damage_of_results_is_listed(results, tmp_path):
    names = ("bare", "both", "nameless", "old", "part")
    changed = {name: copy.deepcopy(results["greedy"]) for name in names}
    del changed["bare"]["tiers"]["2-sizes"]["instances"][0]["mean"]
    changed["both"]["tiers"]["2-sizes"]["misfit"] = "robots: 4"
    del changed["nameless"]["command"]
    changed["old"]["protocol"] = 0
    del changed["part"]["tiers"]["3-shapes"]
    write(changed, tmp_path)
    (tmp_path / "cut.json").write_text("{")
    (tmp_path / "list.json").write_text("[]")
    with pytest.raises(ConfigError) as error:
        leaderboard(tmp_path)
    cut, *others = error.value.problems
    assert cut.startswith(str(tmp_path / "cut.json"))
    assert [": ".join(one.split(": ")[:2]) for one in others] == [
        *("bare.json: 2-sizes", "both.json: 2-sizes"),
        "list.json: is no result of mbn benchmark",
        *("nameless.json: command", "old.json: protocol", "part.json: tiers"),
    ]
