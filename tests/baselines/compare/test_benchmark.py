"""``mbn benchmark`` on small splits made here."""

import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from baselines import load_policy
from baselines.cli.main import main
from baselines.compare.benchmark import (
    METRICS,
    check_settings,
    load_protocol,
    load_tiers,
    numbers,
    prices,
    rank,
    result_page,
    result_tables,
    run_benchmark,
)
from baselines.evaluation.evaluate import Evaluation, evaluate, is_one_episode
from baselines.policies import load
from baselines.policies.load import Source, load_trained
from baselines.policies.policy import Policy, RandomPolicy, TrainedPolicy
from baselines.policies.shielded import Shielded, information_of
from baselines.runs.files import RunError, alone
from baselines.runs.folder import RunFolder
from mbn_marl import Field
from mbn_marl.errors import ConfigError
from mbn_marl.field import splits
from mbn_marl.planning import plan
from tests.support.frozen import write_split, write_splits

pytestmark = pytest.mark.slow

COUNT = 2
OWN = """
import numpy as np

class Small:
    settings = {"observation": "lidar", "n_robots": 3, "max_steps": 40, "wind": (0.3, 0.0)}

    def __init__(self, field):
        pass

    def act(self, observations, deterministic=True):
        return np.zeros((*observations.shape[:2], 2))

class Fussy(Small):
    def __init__(self, field):
        self.team = len(field.starts)

    settings = {}

    def act(self, observations, deterministic=True):
        if self.team != 3:
            raise LookupError("no such robot")
        return np.zeros((*observations.shape[:2], 2))

class Fixed(Fussy):
    settings = {"n_robots": 3}
"""
FAR = (
    OWN
    + """
class Far(Small):
    settings = {"observation": "entities", "knowledge": "own", "sensing_radius": 300.0,
                "comm_radius": 500.0, "comm_loss": 0.5}
"""
)


def proved(k: int, field: Field) -> tuple[int, int]:
    found = plan(field, time_limit=20.0)
    assert found.optimal
    return found.makespan_lower_bound, found.makespan


@pytest.fixture(autouse=True, scope="module")
def frozen(tmp_path_factory):
    folder = tmp_path_factory.mktemp("splits")
    shutil.copy(Path(str(splits.FOLDER)) / "protocol.json", folder)
    write_splits(folder, COUNT)
    write_split(folder, "1-convex", COUNT, proved)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(splits, "FOLDER", folder)
        yield folder


@pytest.fixture(scope="module")
def greedy(frozen, tmp_path_factory):
    return run("greedy", ["1-convex"], tmp_path_factory.mktemp("greedy"))


def run(source: str, tiers: Sequence[str], out: Path, **how: Any) -> dict[str, Any]:
    return run_benchmark(source, "test", load_tiers("test", tiers), out, command="c", **how)


def timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: timeless(one) for name, one in value.items() if name != "times"}
    return [timeless(one) for one in value] if isinstance(value, list) else value


def test_the_numbers_of_an_instance_worked_out_by_hand():
    lists = {"returns": [0.0] * 4, "rois_visited": [0] * 4}
    ends = {
        "successes": [True, True, False, False],
        "collisions": [False, False, True, False],
        "steps": [24, 36, 7, 1000],
        "wall_hits": [0, 3, 0, 1],
    }
    found = numbers(Evaluation(True, 0, **lists, **ends, bounds=[20] * 4))
    assert found == pytest.approx(
        {
            **{"spl": (20 / 24 + 20 / 36) / 4, "success_rate": 0.5, "gap": 0.5, "makespan": 30.0},
            **{"clean_rate": 0.25, "collision_rate": 0.25, "wall_hits": 1.0},
        }
    )
    in_wind = numbers(Evaluation(True, 0, **lists, **ends, bounds=[None] * 4))
    ends["successes"] = [False] * 4
    lost = numbers(Evaluation(True, 0, **lists, **ends, bounds=[20] * 4))
    assert (lost["spl"], lost["gap"], lost["makespan"]) == (0.0, None, None)
    assert [name for name in METRICS if in_wind[name] is None] == ["spl", "gap"]
    assert rank(found) > rank(lost)
    changes = {"makespan": 31.0}, {"success_rate": 0.4, "makespan": 10.0}, {"success_rate": 0.0}
    ranks = [rank(in_wind | change) for change in ({}, *changes)]
    assert ranks == sorted(ranks, reverse=True) and len({*ranks}) == 4


def test_weights_are_loaded_once(tmp_path, monkeypatch):
    loads = []

    def counted(folder: RunFolder) -> TrainedPolicy:
        loads.append(folder.path.name)
        return load_trained(folder)

    monkeypatch.setattr(load, "load_trained", counted)
    found = run("zoo:generalist", ["1-convex", "2-sizes"], tmp_path)
    assert sum(len(tier["instances"]) for tier in found["tiers"].values()) == 2 * COUNT
    assert loads == ["generalist"]


@pytest.mark.parametrize("source", ["random", "zoo:generalist-hint"])
def test_each_instance_is_evaluated_with_its_own_seed(source, tmp_path):
    found = run(source, ["1-convex", "5-weather"], tmp_path)["tiers"]
    for tier, first in (("1-convex", 4_000_000), ("5-weather", 4_004_000)):
        for k, one in enumerate(load_tiers("test", [tier])[tier]):
            policy = load_policy(source, one.field, seed=first + k, condition=one.condition)
            where, row = (policy, [one], policy.settings), found[tier]["instances"][k]
            same = is_one_episode(policy, policy.settings, deterministic=True)
            mean = evaluate(*where, episodes=1 if same else 10, deterministic=True, seed=first + k)
            assert row["mean"] == numbers(mean)
            if source == "random":
                assert row["sampled"] is None
            else:
                assert row["sampled"] == numbers(evaluate(*where, episodes=10, seed=first + k))
            assert row["times"]["decision_ms"] > 0.0
            assert (row["mean"]["spl"] is None) == (tier == "5-weather")


@pytest.mark.parametrize(
    ("policy", "settings", "word"),
    [
        (Policy(), {"observation": "lidar_local"}, "own sight"),
        (RandomPolicy(), {}, "-"),
        (Shielded(Policy()), {"observation": "local", "knowledge": "own"}, "own"),
        (Shielded(Policy()), {"observation": "local"}, "state"),
        (Shielded(RandomPolicy()), {}, "state"),
    ],
)
def test_what_a_policy_acts_on(policy, settings, word):
    assert information_of(policy, settings, None) == word


def test_an_interrupted_run_goes_on_and_gives_the_same(tmp_path, monkeypatch):
    tiers = ["1-convex", "2-sizes"]
    whole = run("greedy", tiers, tmp_path / "whole")
    calls, true = [], Source.make

    def stopping(source: Source, field: Field, **how: Any) -> Any:
        calls.append(field.name)
        if len(calls) == COUNT + 2:
            raise KeyboardInterrupt
        return true(source, field, **how)

    monkeypatch.setattr(Source, "make", stopping)
    with pytest.raises(KeyboardInterrupt):
        run("greedy", tiers, tmp_path / "cut")
    kept = json.loads((tmp_path / "cut" / "result.json").read_text())
    assert [*kept["tiers"]] == tiers[:1]
    with pytest.raises(RunError, match="policy: "):
        run("random", tiers, tmp_path / "cut", resume=True)
    again = run("greedy", tiers, tmp_path / "cut", resume=True)
    assert len(calls) == COUNT + 2 + COUNT
    assert timeless(again) == timeless(whole)
    assert again == json.loads((tmp_path / "cut" / "result.json").read_text())
    names = {path.name for path in (tmp_path / "cut" / "episodes").iterdir()}
    assert names == {f"{tier}-{name}.json" for tier in tiers for name in ("median", "worst")}


@pytest.mark.parametrize(
    ("damage", "place"),
    [
        ("{", "result.json"),
        ({"tiers": {"1-convex": {}}}, "1-convex: "),
        ({"tiers": {"1-convex": {"misfit": None, "instances": [{}]}}}, "1-convex: "),
        ({"tiers": {"1-convex": {"misfit": None, "instances": [{"mean": "x"}]}}}, "1-convex: "),
        ({"versions": {"packages": {"mbn-marl": "0.0.1"}}}, "mbn-marl: "),
        ({"shield": True}, "shield: "),
    ],
)
def test_what_is_not_to_be_resumed_is_named(damage, place, tmp_path, greedy):
    record = {**greedy, **damage} if isinstance(damage, dict) else damage
    text = record if isinstance(record, str) else json.dumps(record)
    (tmp_path / "result.json").write_text(text)
    with pytest.raises(RunError, match=place):
        run("greedy", ["1-convex"], tmp_path, resume=True)


def test_what_does_not_fit_has_no_number_and_says_why(tmp_path):
    found = run("zoo:field_03", ["1-convex", "2-sizes"], tmp_path)
    assert found["tiers"]["1-convex"]["misfit"] is None
    misfit = found["tiers"]["2-sizes"]
    assert "robots: the policy was trained with 3" in misfit["misfit"]
    assert misfit["instances"] == []
    for table in result_tables(found).values():
        assert table.lines[1] == ("2-sizes", *["-"] * (len(table.headings) - 1))
        assert "2-sizes does not fit: convex-3000001: robots" in table.caption
    assert "Does not fit" in result_page(found, tmp_path)


def test_policies_of_your_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.py").write_text(OWN)
    with pytest.raises(RunError, match=r"2-sizes, convex-3000001: LookupError.*small\.py, line"):
        run("small:Fussy", ["1-convex", "2-sizes"], tmp_path / "fussy")
    kept = json.loads((tmp_path / "fussy" / "result.json").read_text())
    assert [*kept["tiers"]] == ["1-convex"] and len(kept["tiers"]["1-convex"]["instances"]) == 2
    fixed = run("small:Fixed", ["2-sizes", "1-convex"], tmp_path / "fixed")["tiers"]
    assert "n_robots: 3" in fixed["2-sizes"]["misfit"] and fixed["1-convex"]["misfit"] is None
    with pytest.raises(ConfigError, match="max_steps: ") as error:
        run("small:Small", ["1-convex"], tmp_path / "own")
    assert len(error.value.problems) == 1
    assert not (tmp_path / "own" / "result.json").exists()
    chosen = {"observation": "local", "dtype": "float64", "n_robots": 3, "condition": "noisy"}
    check_settings(chosen, "noisy", load_protocol())


def test_a_search_has_rows_and_prices_at_each_radius(tmp_path):
    found = run("greedy-local", ["6-search"], tmp_path)
    rows = found["tiers"]["6-search"]["instances"]
    assert [row["comm_radius"] for row in rows] == ["0", "100", "inf"] * COUNT
    assert {row["information"] for row in rows} == {"own"}
    none, _, every = ([row["mean"]["makespan"] for row in rows[k::3]] for k in range(3))
    ratios = [a / b for a, b in zip(none, every, strict=True)]
    known = prices(rows)
    assert known["price of decentralisation, 0"].mean == pytest.approx(sum(ratios) / COUNT)
    bounds = [row["makespan_lower_bound"] for row in rows[::3]]
    ratios = [a / b for a, b in zip(every, bounds, strict=True)]
    assert known["price of information"].mean == pytest.approx(sum(ratios) / COUNT)
    means, priced = result_tables(found).values()
    assert [line[0] for line in means.lines] == [f"6-search, {name}" for name in splits.RADII]
    assert len(priced.lines) == 3
    told = rows[0] | {"mean": None}
    assert "price of decentralisation, 0" not in prices([told])
    assert '"knowledge":{"empty":[' in result_page(found, tmp_path)


def test_robots_of_two_kinds_pass_doors_by_turns(tmp_path):
    rows = run("greedy-local", ["7-passages"], tmp_path)["tiers"]["7-passages"]["instances"]
    assert [row["information"] for row in rows] == ["own"] * COUNT
    assert all(row["mean"]["success_rate"] == 1.0 and "comm_radius" not in row for row in rows)


def test_the_radii_of_a_field_have_the_same_seed(tmp_path):
    rows = run("random", ["6-search"], tmp_path)["tiers"]["6-search"]["instances"]
    one, other = ([row["mean"] for row in rows[k : k + 3]] for k in (0, 3))
    assert one == one[:1] * 3 and other == other[:1] * 3 and one != other


def test_what_the_tier_fixes_is_no_choice(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "far.py").write_text(FAR)
    with pytest.raises(ConfigError, match="comm_loss: ") as error:
        run("far:Far", ["6-search"], tmp_path / "out")
    assert len(error.value.problems) == 1
    (one, *_) = load_tiers("test", ["6-search"])["6-search"]
    settings = Source("far:Far").make(one.field, **one.settings).settings
    assert (settings["sensing_radius"], settings["comm_radius"]) == (100.0, 0.0)


def test_the_command(tmp_path, capsys, refusal):
    out = tmp_path / "out"
    words = ["benchmark", "greedy", "--tiers", "1-convex", "-o", str(out)]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert re.search(r"1-convex +state +2 +\d\d\.\d%", said) and f"written to {out}" in said
    page = (out / "page.html").read_text()
    for part in ('data-replay="episodes-1-convex"', "median: convex-3000000", "mean actions"):
        assert part in page, part
    assert "already exists" in refusal(words)
    (out / "episodes" / "1-convex-median.json").unlink()
    with alone(out, "mbn benchmark"):
        assert "another mbn benchmark" in refusal([*words, "--resume"])
    assert main([*words, "--resume"]) == 0
    assert "1-convex-median.json" in (out / "page.html").read_text()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "page.html").write_text("mine")
    assert "already exists" in refusal([*words[:-1], str(tmp_path / "mine"), "--resume"])
    assert main([*words, "--force"]) == 0 and (tmp_path / "out.1" / "result.json").exists()
    wrong = refusal(["benchmark", "greedy", "--tiers", "convex", "2-size"])
    assert "convex" in wrong and "2-size" in wrong
