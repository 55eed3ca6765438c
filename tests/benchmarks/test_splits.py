"""``python -m benchmarks splits``, in small."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from baselines.runs.files import read_arrays, read_json, write_arrays, write_json
from benchmarks import splits
from benchmarks.splits import Splits
from mbn_marl import Field, FieldSampler
from mbn_marl.errors import ConfigError
from mbn_marl.field.splits import CONDITIONS, TIERS, geometry_hash
from mbn_marl.planning import Plan, plan
from mbn_marl.planning.planner import WORK_LIMIT

pytestmark = pytest.mark.slow
CONVEX = Splits(tier=("1-convex",), split=("test",), count=3, seconds=60.0)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("splits")
    assert dataclasses.replace(CONVEX, out=folder).run("command")
    return folder / "test-1-convex.json"


def test_instances_are_proved_and_an_interrupted_run_goes_on(made, tmp_path, monkeypatch):
    record = read_json(made)
    sampler = FieldSampler(("convex",), seed=3_000_000)
    for number, one in enumerate(record["instances"]):
        found = plan(sampler.field(number), time_limit=60.0)
        assert one["candidate"] == number and one["geometry"] == geometry_hash(found.field)
        assert (one["makespan_lower_bound"], one["makespan"]) == (found.makespan,) * 2
    calls = []

    def stopping(field: Field, **how: Any) -> Plan:
        calls.append(field)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return plan(field, **how)

    monkeypatch.setattr(splits, "plan", stopping)
    again = dataclasses.replace(CONVEX, out=tmp_path)
    with pytest.raises(KeyboardInterrupt):
        again.run("command")
    assert len(read_json(tmp_path / made.name)["instances"]) == 1
    assert again.run("command") and len(calls) == 4
    again_made = read_json(tmp_path / made.name)["instances"]
    for one, other in zip(again_made, record["instances"], strict=True):
        assert one == {**other, "seconds": one["seconds"]}


def test_rejected_candidates_are_counted_with_the_reason(tmp_path, monkeypatch):
    fields = [FieldSampler(seed=3_000_000).field(number) for number in (0, 0, 1, 2, 3)]
    monkeypatch.setattr(FieldSampler, "field", lambda self, world: fields[world])

    def worse(field: Field, **how: Any) -> Plan:
        found = plan(field, **how)
        if field == fields[2]:
            return dataclasses.replace(found, makespan=None)
        return dataclasses.replace(found, actions=found.actions / (1 + (field == fields[3])))

    monkeypatch.setattr(splits, "plan", worse)
    dataclasses.replace(CONVEX, out=tmp_path, count=2).run("command")
    record = read_json(tmp_path / "test-1-convex.json")
    assert [one["candidate"] for one in record["instances"]] == [0, 4]
    reasons = [one["reason"] for one in record["rejected"]]
    assert reasons[:2] == ["the same as candidate 0", "no plan was found"]
    assert reasons[2].startswith("plan: ") and "not success" in reasons[2]
    assert record["candidates"] == 5


def test_passages_are_of_robots_that_wait(tmp_path, monkeypatch, capsys):
    steps = iter([11, 12, 15])

    def waiting(field: Field, **how: Any) -> SimpleNamespace:
        assert how == {"visited": (), "work_limit": WORK_LIMIT}
        actions = np.zeros((12, len(field.starts), 2), np.float32)
        return SimpleNamespace(makespan=next(steps), makespan_lower_bound=10, actions=actions)

    monkeypatch.setattr(splits, "plan", waiting)
    monkeypatch.setattr(splits, "plan_problem", lambda *plan: None)
    assert Splits((splits.PASSAGES,), ("test",), count=2, out=tmp_path).run("command")
    record = read_json(tmp_path / "test-7-passages.json")
    assert record["rejected"] == [{"candidate": 0, "reason": "index 1.10"}]
    assert [one["makespan"] for one in record["instances"]] == [12, 15]
    assert "nan" not in capsys.readouterr().out


def test_verifying_finds_what_was_changed(made, tmp_path, capsys):
    check = dataclasses.replace(CONVEX, out=tmp_path, verify=True)
    record, plans = read_json(made), read_arrays(made.with_suffix(".npz"))
    path = tmp_path / made.name
    first, second, third = record["instances"]
    first["geometry"] = second["geometry"]
    second["makespan_lower_bound"] += 1
    plans[str(third["candidate"])] = np.zeros((4, 3, 2), np.float32)
    record["sampler"]["robots"] = 4
    write_json(path, record)
    write_arrays(path.with_suffix(".npz"), plans)
    assert dataclasses.replace(check, out=made.parent).run("command")
    assert not check.run("command")
    said = capsys.readouterr().out
    for problem in (
        *("sampler: is another", "two instances have the same", "instances[0]: geometry"),
        *("instances[1]: makespan_lower_bound", "instances[2]: plan: its hash"),
        "instances[2]: plan: unfinished after 4 steps",
    ):
        assert problem in said
    with pytest.raises(ConfigError, match="sampler: "):
        dataclasses.replace(check, verify=False).run("command")


def test_weather_is_made_of_the_first_three_tiers(made, tmp_path):
    record, names = read_json(made), [*TIERS][:3]
    for tier in names[:2]:
        write_json(tmp_path / f"test-{tier}.json", {**record, "tier": tier})
    with pytest.raises(ConfigError, match=r"test-3-shapes\.json: "):
        splits.weather(tmp_path, "test", 3)
    write_json(tmp_path / "test-3-shapes.json", record)
    instances = splits.weather(tmp_path, "test", 3)["instances"]
    assert [one["tier"] for one in instances] == names
    assert [one["condition"] for one in instances] == list(CONDITIONS[:3])
    assert all(
        one["geometry"] == two["geometry"]
        for one, two in zip(instances, record["instances"], strict=True)
    )


def test_wrong_options_are_listed():
    with pytest.raises(ConfigError, match=r"tier: (.|\n)*count: (.|\n)*seconds: "):
        Splits(tier=("1-convx",), count=0, seconds=0.0).run("command")
