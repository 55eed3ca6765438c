"""Frozen fields: read from a folder, and those that are installed."""

import json
import re
from pathlib import Path
from typing import get_args

import pytest
import shapely

from baselines.runs.files import read_arrays, read_json
from benchmarks.splits import definition, instance_problems, weather
from mbn_marl import Field, FieldSampler
from mbn_marl.config import make_config
from mbn_marl.errors import FieldError
from mbn_marl.field import load_split
from mbn_marl.field.splits import (
    FOLDER,
    NAMES,
    PASSAGES,
    RADII,
    SEARCH,
    SETTINGS,
    TIERS,
    WEATHER,
    Split,
    geometry_hash,
    make_sampler,
    search_side_by_side,
)
from tests.support.frozen import write_split, write_splits
from tests.support.problems import places_of

INSTALLED = Path(str(FOLDER))
FILES = [(split, tier) for split in get_args(Split) for tier in NAMES]


def test_instances_are_fields_with_what_is_known_of_them(tmp_path):
    write_split(tmp_path, "2-sizes")
    read = load_split("test", "2-sizes", tmp_path)
    sampler = FieldSampler(("convex",), [2, 7], [3, 10], [150, 420], seed=3_000_001)
    assert [one.field for one in read] == [sampler.field(world) for world in (0, 2, 4)]
    assert [(one.makespan_lower_bound, one.best_known) for one in read] == [
        *((10, 12), (11, 13), (12, 14))
    ]
    assert {one.condition for one in read} == {"calm"}


def test_a_searched_field_is_there_at_each_radius_with_its_empty_rois(tmp_path):
    write_split(tmp_path, SEARCH, 2)
    read = load_split("test", SEARCH, tmp_path)
    assert [one.radius for one in read] == [*RADII] * 2
    assert len({one.field.name for one in read}) == 2
    trained = {"observation": "entities", "decoys": 12}
    config = make_config({**trained, **read[1].settings})
    known = config.knowledge, config.comm_radius, config.look_radius, config.max_steps
    assert known == ("own", 100.0, 60.0, 600)
    assert config.empty_rois == tuple(range(12))


def test_searched_fields_with_their_empty_rois_last_are_the_same_fields():
    frozen = [one for one in load_split("validation", SEARCH) if one.radius == "100"]
    moved = search_side_by_side("validation", 100.0)
    assert [one.field.name for one in moved] == [one.field.name for one in frozen]
    assert all(one.settings == moved[0].settings for one in moved)
    for one, other in zip(frozen[:5], moved, strict=False):
        places = [
            {tuple(each.field.rois[k].tolist()) for k in each.settings["empty_rois"]}
            for each in (one, other)
        ]
        assert places[0] == places[1] != set()
        assert {*map(tuple, one.field.rois.tolist())} == {*map(tuple, other.field.rois.tolist())}
        assert one.makespan_lower_bound == other.makespan_lower_bound
        assert one.field.polygon == other.field.polygon
        assert (one.field.starts == other.field.starts).all()


def test_passages_have_two_kinds_and_what_the_tier_fixes(tmp_path):
    write_split(tmp_path, PASSAGES, 5)
    for one in load_split("test", PASSAGES, tmp_path):
        field, config = one.field, make_config({"observation": "entities", **one.settings})
        assert (config.knowledge, config.comm_radius, config.max_steps) == ("own", 100.0, 600)
        rooms = shapely.get_parts(field.polygon.buffer(-4.0))  # doors are less than 8 wide
        assert 2 <= len(rooms) <= 3 and shapely.area(rooms).max() < 92.0**2
        starts, rois = (
            shapely.contains(rooms[:, None], shapely.points(points)).argmax(axis=0).tolist()
            for points in (field.starts, field.rois)
        )
        homes = dict(zip(field.start_kinds, starts, strict=True))
        assert homes[0] != homes[1] and starts == [homes[kind] for kind in field.start_kinds]
        assert rois == [homes[1 - kind] for kind in field.roi_kinds]
        changed = field.to_dict() | {"roi_kinds": field.roi_kinds[::-1]}
        assert geometry_hash(Field(**changed)) != geometry_hash(field)


def test_a_field_that_is_another_is_an_error_that_names_it(tmp_path):
    path = write_split(tmp_path, "1-convex")
    record = read_json(path)
    first, second, _ = record["instances"]
    first["geometry"], second["geometry"] = second["geometry"], first["geometry"]
    path.write_text(json.dumps(record))
    places = places_of(FieldError, load_split, "test", "1-convex", tmp_path)
    assert places == ["instances.0.geometry", "instances.1.geometry"]
    path.write_text(json.dumps(record | {"instances": [record["instances"][2]] * 2}))
    places = places_of(FieldError, load_split, "test", "1-convex", tmp_path)
    assert places == ["instances.1.candidate"]


def test_an_instance_that_cannot_be_is_named(tmp_path):
    write_splits(tmp_path, 2)
    for tier, changed, place in (
        ("1-convex", {"candidate": 2**70}, "candidate"),
        ("1-convex", {"makespan_lower_bound": 14}, "makespan"),
        ("1-convex", {"condition": "windy"}, "condition"),
        ("1-convex", {"tier": "2-sizes"}, "tier"),
        (WEATHER, {"condition": "calm"}, "condition"),
        (SEARCH, {"empty": [*range(11)]}, "empty"),
        (SEARCH, {"empty": [*range(11), 24]}, "empty.11"),
    ):
        path = tmp_path / f"test-{tier}.json"
        good = path.read_text()
        record = json.loads(good)
        record["instances"][1] |= changed
        path.write_text(json.dumps(record))
        places = places_of(FieldError, load_split, "test", tier, tmp_path)
        path.write_text(good)
        assert places == [f"instances.1.{place}"], changed


def test_a_file_that_is_not_valid_says_why(tmp_path):
    known = '"split": "test", "tier": "1-convex"'
    for text, place in (
        ("{", "file: "),
        ("[" * 100_000, "file: "),
        (f'{{"version": 1, {known}}}', "instances: "),
    ):
        (tmp_path / "test-1-convex.json").write_text(text)
        with pytest.raises(FieldError, match=place):
            load_split("test", "1-convex", tmp_path)


def test_what_there_is_not_is_an_error(tmp_path):
    with pytest.raises(FieldError, match=r"split: (.|\n)*tier: "):
        load_split("tset", "convex")
    with pytest.raises(FieldError):
        load_split("test", "1-convex", tmp_path)
    write_split(tmp_path, "1-convex", version=2)
    assert places_of(FieldError, load_split, "test", "1-convex", tmp_path) == ["version"]


@pytest.mark.slow
@pytest.mark.parametrize(("split", "tier"), FILES, ids=map("-".join, FILES))
def test_the_installed_splits_are_proved(split, tier):
    """Of the two whose proofs took least, plan and bound are computed again."""
    assert len(load_split(split, tier)) == (300 if tier == SEARCH else 100)
    path = INSTALLED / f"{split}-{tier}.json"
    record = read_json(path)
    if tier == WEATHER:
        assert record == weather(INSTALLED, split, 100)
        return
    assert {**record, **definition(split, tier)} == record
    plans, sampler = read_arrays(path.with_suffix(".npz")), make_sampler(split, tier)
    for one in sorted(record["instances"], key=lambda one: one.get("seconds", one["robots"]))[:2]:
        actions = plans[str(one["candidate"])]
        assert [*instance_problems(sampler, one, actions, 60.0)] == []


def test_the_names_of_tiers_are_those_of_the_page():
    page = (Path(__file__).parents[2] / "docs" / "fields.md").read_text(encoding="utf-8")
    section = page.split("### Frozen fields")[1]
    found = tuple(re.findall(r"(?m)^\| `([\w-]+)` \|", section))
    assert found == NAMES == (*TIERS, WEATHER, *SETTINGS)
