"""Field files: the catalogue, the formats, and hostile input."""

import json
import math
import time
from importlib.resources import files
from pathlib import Path
from unittest.mock import Mock

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mbn_marl.errors import FieldError
from mbn_marl.field import (
    FORMAT,
    Field,
    FieldSampler,
    catalogue_names,
    json_schema,
    load_field,
    load_fields,
    sampler_names,
    save_field,
)
from mbn_marl.field.files import MAX_BYTES, MAX_DEPTH
from tests.golden import FIELDS
from tests.support.field_cases import VALID_FILE, circle, square, write
from tests.support.problems import places_of

# "Returns 160000 - 30 T*" of the ten fields, proved; the field with index k is field_{k+1:02d}.
OPTIMAL_MAKESPANS = [40, 40, 17, 29, 31, 39, 25, 35, 83, 71]


def places_in(folder: Path, text: str, name: str = "user.yaml") -> list[str]:
    """The places of the problems of a file that holds ``text``."""
    return places_of(FieldError, load_field, write(folder, text, name))


def test_catalogue_is_the_files_on_disk():
    entries = [one for one in files("envs_catalog").iterdir() if one.name.endswith(".yaml")]
    on_disk = sorted(Path(entry.name).stem for entry in entries)
    assert catalogue_names() == on_disk == [f"field_{k:02d}" for k in range(1, 11)]
    for entry in entries:
        first = entry.read_text(encoding="utf-8").splitlines()[0]
        assert first == "# yaml-language-server: $schema=field.schema.json"
    for name, makespan in zip(catalogue_names(), OPTIMAL_MAKESPANS, strict=True):
        other = {"name": name, "optimal_makespan": makespan, "holes": [], "arena": [1000.0] * 2}
        assert load_field(name).to_dict() == other | FIELDS[name]
    for name in sampler_names():
        sampler = load_fields(name)
        assert isinstance(sampler, FieldSampler) and sampler.field().rois.shape[1] == 2


def test_committed_schema_is_the_models():
    text = files("envs_catalog").joinpath("field.schema.json").read_text(encoding="utf-8")
    assert json.loads(text) == (schema := json_schema())
    assert schema["required"] == ["format", "vertices", "rois", "starts"]


def test_unknown_name_suggests_and_lists():
    with pytest.raises(FieldError, match="field_3") as caught:
        load_field("field_3")
    assert all(known in str(caught.value) for known in catalogue_names())
    assert str(caught.value).count("field_03") == 2


def test_samplers_are_files_too(tmp_path):
    sampler = FieldSampler(("farm", "convex"), (2, 5), 4, (200, 300), weights=(1, 3), seed=9)
    save_field(sampler, tmp_path / "copy.yaml")
    assert load_fields(tmp_path / "copy.yaml") == sampler
    for source in ("random_convex", str(tmp_path / "copy.yaml")):
        with pytest.raises(FieldError, match="load_fields") as caught:
            load_field(source)
        assert len(caught.value.problems) == 1
    wrong = write(tmp_path, "format: mbn-sampler/1\nrobots: 0\nsides: 3\n")
    assert sorted(places_of(FieldError, load_fields, wrong)) == ["robots", "sides"]


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=10,
)
KEYS = st.sampled_from(["field", "init_positions", "infected_locations", "grid_size", "format"])
DOCUMENTS = st.dictionaries(KEYS, VALUES, min_size=1)


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    content = bytearray(VALID_FILE.encode())
    for place in draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=4)):
        content[place] = draw(st.integers(0, 255))
    return bytes(content[: draw(st.integers(0, len(content)))])


TEXTS = st.text(max_size=400) | DOCUMENTS.map(yaml.dump)
CONTENTS = TEXTS.map(lambda text: text.encode("utf-8", "surrogatepass")) | damaged()


class TestFiles:
    @pytest.mark.parametrize(
        "field",
        [
            square(rois=[(1e-7, 0.1 + 0.2), (100 / 3, math.pi)], name="123", optimal_makespan=24),
            square(roi_kinds=[1], start_kinds=(0, 1)),
            Field(circle(500), [(x / 1.5 + 10, y / 1.5 + 10) for x, y in circle(24)], [(50, 50)]),
        ],
    )
    def test_round_trip(self, tmp_path, field):
        save_field(field, tmp_path / "custom.yaml")
        assert load_field(str(tmp_path / "custom.yaml")) == field
        document = {"format": FORMAT, **field.to_dict()}
        del document["optimal_makespan"]
        loaded = load_field(write(tmp_path, json.dumps(document), "field.json"))
        assert loaded.to_dict() == {**field.to_dict(), "optimal_makespan": None}
        assert load_field(field) is field

    def test_names_that_could_be_numbers(self, tmp_path):
        for name in ("1e5", "7e2", "1e-7", "12", "0x1f", "yes", "null"):
            save_field(square(name=name), tmp_path / "field.yaml")
            assert load_field(tmp_path / "field.yaml") == square(name=name)

    def test_optional_keys(self, tmp_path):
        plain = load_field(write(tmp_path, VALID_FILE, "my field.yaml"))
        assert plain.name == "my_field"
        text = VALID_FILE + "holes:\narena:\noptimal_makespan:\n"
        assert load_field(write(tmp_path, text, "my field.yaml")) == plain

    def test_a_failed_save_leaves_the_old_file(self, tmp_path, monkeypatch):
        path = tmp_path / "field.yaml"
        save_field(square(name="newer"), path)
        monkeypatch.setattr("os.fsync", Mock(side_effect=OSError(28, "No space left on device")))
        with pytest.raises(OSError, match="28"):
            save_field(square(name="newest"), path)
        assert load_field(path) == square(name="newer")
        assert list(tmp_path.iterdir()) == [path]

    def test_structure_and_geometry_are_reported_together(self, tmp_path):
        places = places_in(
            tmp_path,
            "format: mbn-field/9\ncolour: red\nvertices: [[0, 0], [100, 0], [100, 100], [0, x]]\n"
            "starts: [[10, 10], [10, 10]]\n",
        )
        assert sorted(places) == ["colour", "format", "rois", "starts[1]", "vertices[3].y"]
        for key in ("a.b.c", "x.1.7", "rois.1.7", "a.b"):
            assert places_in(tmp_path, f"{VALID_FILE}{key}: 1\n") == [key]

    @pytest.mark.parametrize(
        ("text", "place"),
        [
            ("", "format"),
            ("POLYGON ((0 0, 1 0, 1 1))", "format"),
            ("format: [1\n", "line 2, column 1"),
            ("format: a\nformat: b\n", "line 2, column 1"),
            ("{1: 2}\n", "line 1, column 2"),
            ("<<: {format: a}\n", "line 1, column 1"),
            ("a: *anchor\n", "line 1, column 4"),
            ("--- 1\n--- 2\n", "line 2, column 1"),
            ("a: !!bool maybe\n", "file"),
            ("a: 2020-99-99\n", "file"),
            ("\x00", "file"),
            (f"{VALID_FILE}name: {'9' * 5000}", "file"),
            ("[" * (MAX_DEPTH + 1), f"line 1, column {MAX_DEPTH + 1}"),
            (f"{VALID_FILE}name: !!python/object/apply:os.system [pwd]\n", "line 5, column 7"),
        ],
    )
    def test_unreadable_text(self, tmp_path, text, place):
        assert places_in(tmp_path, text) == [place]

    def test_unreadable_sources(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\xfa")
        paths = ["missing.yaml", "no/such/file", "", ".", "\x00", "a" * 5000, "\ud800", "x#y"]
        paths += [tmp_path, "/dev/zero", "binary.yaml", f"{write(tmp_path, VALID_FILE)}#a"]
        for source in paths:
            with pytest.raises(FieldError):
                load_field(source)
        with pytest.raises(FieldError, match="source: "):
            load_field({"vertices": []})

    def test_no_hang(self, tmp_path):
        aliases = ["a0: &a0 [1, 1]"]
        aliases += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 30)]
        for text in (
            *("[" * 60_000, "- " * 30_000, "\n".join(aliases)),
            f"{VALID_FILE}holes: [" + "[[1,1],[2,1],[2,2]]," * 3_200 + "]",
            *(" " * MAX_BYTES, "#" * (10 * MAX_BYTES)),
        ):
            path = write(tmp_path, text)
            started = time.process_time()
            with pytest.raises(FieldError):
                load_field(path)
            assert time.process_time() - started < 3.0, text[-20:]

    @settings(max_examples=300)
    @given(content=CONTENTS)
    @example(content=b"!!binary x")
    @example(content=b"a: 1" + b":59" * 60)
    def test_any_content_is_a_field_or_a_field_error(self, tmp_path_factory, content):
        path = tmp_path_factory.getbasetemp() / "fuzz.yaml"
        path.write_bytes(content)
        try:
            field = load_field(path)
        except FieldError:
            return
        assert Field(**field.to_dict()) == field


# The authors' own files: tens of units, tuples as tags, one or several sets in a file.
TAGGED = yaml.dump(
    {
        "grid_size": 50,
        "field": [(4.5, 2.0), (30, 2), [30, 40.25]],
        "infected_locations": [(28, 20), [20, 10]],
        "init_positions": [(25, 15)],
    }
)
SETS = """\
{"set1": {"field": [[0.0, 0.0], [90.0, 0.0], [0.0, 90.0]],
          "init_positions": [[10.0, 10.0], [10.0, 12.5]], "infected_locations": [[20.0, 20.0]]},
 "set2": {"grid_size": 95, "field": [[0, 0], [90, 0], [90, 95]],
          "init_positions": [[50, 10]], "infected_locations": [[60, 10], [70, 10]]}}
"""


class TestAuthorsSets:
    def test_a_set_is_read_in_arena_units(self, tmp_path):
        outline, rois = [(45, 20), (300, 20), (300, 402.5)], [(280, 200), (200, 100)]
        own = Field(outline, rois, [(250, 150)], arena=(500, 500), name="set_1")
        assert "!!python/tuple" in TAGGED
        assert load_field(write(tmp_path, TAGGED, "set#1.yaml")) == own

    def test_one_of_several_sets(self, tmp_path):
        path = write(tmp_path, SETS, "sets.json")
        first, second = load_field(f"{path}#set1"), load_field(f"{path}#set2")
        assert (first.name, first.arena) == ("set1", (1000, 1000))
        assert first.starts.tolist() == [[100, 100], [100, 125]]
        assert (second.name, second.arena) == ("set2", (950, 950))
        for source in (path, f"{path}#set3"):
            with pytest.raises(FieldError, match="set1, set2"):
                load_field(source)

    def test_problems_use_the_words_of_the_file(self, tmp_path):
        text = (
            "grid_size: 50\ncolour: red\nfield: [[0, 0], [40, 0], [40, 60], [0, 0]]\n"
            "init_positions: [[30, 10], [30, 10], [x, 1]]\n"
        )
        assert places_in(tmp_path, text) == [
            *("colour", "infected_locations", "init_positions[2].x"),
            *("field[2]", "field[3]", "init_positions[1]"),
        ]
        for grid in ("big", "[50, 50]", "0", ".nan", "1.0e+9", "true"):
            text = TAGGED.replace("grid_size: 50", f"grid_size: {grid}")
            assert places_in(tmp_path, text) == ["grid_size"], grid
