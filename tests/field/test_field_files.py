"""Field files: the catalogue, the format, and hostile input."""

from __future__ import annotations

import json
import math
import time
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
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
from mbn_marl.field.safe_yaml import MAX_BYTES, MAX_DEPTH
from tests.golden import FIELDS
from tests.support.field_cases import VALID_FILE, problems_of_file, square, write

# "Returns 160000 - 30 T*" of the ten fields, proved; the field with index k is field_{k+1:02d}.
OPTIMAL_MAKESPANS = [40, 40, 17, 29, 31, 39, 25, 35, 83, 71]


class TestCatalogue:
    def test_registry_is_the_files_on_disk(self) -> None:
        on_disk = sorted(Path(entry.name).stem for entry in _catalogue_files())
        assert catalogue_names() == on_disk == [f"field_{k:02d}" for k in range(1, 11)]

    def test_fields_are_the_golden_ones(self) -> None:
        for name, makespan in zip(catalogue_names(), OPTIMAL_MAKESPANS, strict=True):
            other = {"name": name, "optimal_makespan": makespan, "holes": [], "arena": [1000.0] * 2}
            assert load_field(name).to_dict() == other | FIELDS[name]

    def test_files_name_their_schema(self) -> None:
        for entry in _catalogue_files():
            first = entry.read_text(encoding="utf-8").splitlines()[0]
            assert first == "# yaml-language-server: $schema=field.schema.json"

    def test_committed_schema_is_the_models(self) -> None:
        text = files("envs_catalog").joinpath("field.schema.json").read_text(encoding="utf-8")
        assert json.loads(text) == json_schema()

    def test_schema_holds_the_limits(self) -> None:
        schema = json_schema()
        assert schema["required"] == ["format", "vertices", "rois", "starts"]
        assert schema["additionalProperties"] is False
        assert schema["properties"]["format"]["const"] == FORMAT
        assert schema["properties"]["rois"]["maxItems"] == 24
        assert schema["properties"]["starts"]["maxItems"] == 64

    def test_unknown_name_suggests_and_lists(self) -> None:
        counts = {}
        for name in ("field_3", "zebra"):
            with pytest.raises(FieldError, match=name) as caught:
                load_field(name)
            assert all(known in str(caught.value) for known in catalogue_names())
            counts[name] = str(caught.value).count("field_03")
        assert counts == {"field_3": 2, "zebra": 1}, "once in the list, once as what may be meant"


def _catalogue_files() -> list[Any]:
    return [entry for entry in files("envs_catalog").iterdir() if entry.name.endswith(".yaml")]


class TestSamplers:
    def test_samplers_of_the_catalogue_load_and_make_fields(self) -> None:
        for name in sampler_names():
            sampler = load_fields(name)
            assert isinstance(sampler, FieldSampler) and sampler.field().rois.shape[1] == 2

    def test_round_trip(self, tmp_path: Path) -> None:
        sampler = FieldSampler(("farm", "convex"), (2, 5), 4, (200, 300), weights=(1, 3), seed=9)
        save_field(sampler, tmp_path / "copy.yaml")
        assert load_fields(tmp_path / "copy.yaml") == sampler

    def test_a_field_is_loaded_too(self) -> None:
        assert load_fields("field_03") == load_field("field_03")

    def test_what_is_neither_is_refused_as_a_field_is(self) -> None:
        for source in ("x" * 300, None, b"field_03"):
            with pytest.raises(FieldError) as caught:
                load_fields(source)
            with pytest.raises(FieldError) as expected:
                load_field(source)
            assert str(caught.value) == str(expected.value)

    def test_wrong_arguments_are_named_together(self, tmp_path: Path) -> None:
        path = tmp_path / "wrong.yaml"
        path.write_text("format: mbn-sampler/1\nrobots: 0\nfamilies: [round]\nsides: 3\n")
        with pytest.raises(FieldError) as caught:
            load_fields(path)
        assert {problem.split(":")[0] for problem in caught.value.problems} == {
            *("robots", "families.0", "sides")
        }

    def test_where_one_field_is_wanted_a_sampler_is_refused(self, tmp_path: Path) -> None:
        save_field(FieldSampler(), tmp_path / "copy.yaml")
        for source in ("random_convex", str(tmp_path / "copy.yaml")):
            with pytest.raises(FieldError):
                load_field(source)


class TestFiles:
    def test_round_trip_of_everything(self, tmp_path: Path) -> None:
        field = square(
            rois=[(1e-7, 0.1 + 0.2), (100 / 3, math.pi)],
            arena=(100.0, 123.456),
            name="123",
            optimal_makespan=24,
        )
        save_field(field, tmp_path / "copy.yaml")
        assert load_field(str(tmp_path / "copy.yaml")) == field

    def test_a_field_loads_as_itself(self) -> None:
        field = square()
        assert load_field(field) is field

    def test_name_defaults_to_the_stem(self, tmp_path: Path) -> None:
        assert load_field(write(tmp_path, VALID_FILE, "my field.yaml")).name == "my_field"
        assert load_field(write(tmp_path, VALID_FILE + "name: given")).name == "given"

    def test_empty_optional_keys_are_absent(self, tmp_path: Path) -> None:
        path = write(tmp_path, VALID_FILE + "holes:\narena:\noptimal_makespan:\n")
        assert load_field(path) == load_field(write(tmp_path, VALID_FILE))

    def test_json_and_its_numbers(self, tmp_path: Path) -> None:
        field = square(rois=[(1e-7, 50.0)])
        document = {"format": FORMAT, **field.to_dict()}
        assert load_field(write(tmp_path, json.dumps(document), "field.json")) == field

    def test_a_failed_save_leaves_the_old_file(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = tmp_path / "field.yaml"
        save_field(square(), path)

        def disk_full(descriptor: int) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("os.fsync", disk_full)
        with pytest.raises(OSError, match="28"):
            save_field(square(name="newer"), path)
        assert load_field(path) == square()
        assert list(tmp_path.iterdir()) == [path]

    def test_a_save_replaces_the_file_in_one_step(self, tmp_path: Path) -> None:
        """A reader of the old file reads all of it and nothing of the new one."""
        path = tmp_path / "field.yaml"
        save_field(square(), path)
        old = path.read_text(encoding="utf-8")
        with path.open(encoding="utf-8") as reader:
            save_field(square(name="newer"), path)
            assert reader.read() == old
        assert load_field(path) == square(name="newer")

    def test_structure_and_geometry_are_reported_together(self, tmp_path: Path) -> None:
        problems = problems_of_file(
            tmp_path,
            "format: mbn-field/9\ncolour: red\nvertices: [[0, 0], [100, 0], [100, 100], [0, x]]\n"
            "starts: [[10, 10], [10, 10]]\n",
        )
        places = [problem.split(": ")[0] for problem in problems]
        assert places == ["format", "colour", "vertices[3].y", "rois", "starts[1]"]

    def test_unreadable_text(self, tmp_path: Path) -> None:
        for text, place in (
            ("", "format: "),
            ("- 1\n- 2\n", "format: "),
            ("vertices: []\n", "format: "),
            ("format: [1\n", "line 2, column 1: "),
            ("format: a\nformat: b\n", "line 2, column 1: "),
            ("{1: 2}\n", "line 1, column 2: "),
            ("{[a, b]: 2}\n", "line 1, column 2: "),
            ("<<: {format: a}\n", "line 1, column 1: "),
            ("a: &anchor 1\n", "line 1, column 4: "),
            ("a: *anchor\n", "line 1, column 4: "),
            ("--- 1\n--- 2\n", "line 2, column 1: "),
            ("a: !!map [1]\n", "line 1, column 4: "),
            ("a: !!seq {b: 1}\n", "line 1, column 4: "),
            ("a: !!bool maybe\n", "file: "),
            ('a: !!int ""\n', "file: "),
            ("a: !!float x\n", "file: "),
            ("a: 2020-99-99\n", "line 1, column 4: "),
            ("\x00", "file: "),
            ("a: " + "9" * 201, "line 1, column 4: "),
            ("[" * (MAX_DEPTH + 1), f"line 1, column {MAX_DEPTH + 1}: "),
        ):
            (problem,) = problems_of_file(tmp_path, text)
            assert problem.startswith(place), text

    def test_unreadable_sources(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        paths = ["missing.yaml", "no/such/file", "", ".", "\x00", "a" * 5000, "\ud800", "x#y"]
        others: list[Any] = [None, 3, b"field_01", ["field_01"], {"vertices": []}]
        for source in (*paths, *others):
            with pytest.raises(FieldError, match=None if source in paths else "source: "):
                load_field(source)

    def test_folders_devices_and_binary_files(self, tmp_path: Path) -> None:
        (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\xfa")
        for source in (tmp_path, "/dev/zero", tmp_path / "binary.yaml"):
            with pytest.raises(FieldError, match="file: ") as caught:
                load_field(source)
            assert caught.value.source == str(source)
        with pytest.raises(FieldError, match="'a'"):
            load_field(f"{write(tmp_path, VALID_FILE)}#a")


class TestHostileFiles:
    def test_tags_run_no_code(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def forbidden(command: str) -> int:
            raise AssertionError(f"ran {command}")

        monkeypatch.setattr("os.system", forbidden)
        python = ("object/apply", "object/new", "name", "module", "object")
        for tag in (*(f"!!python/{kind}:os.system" for kind in python), "!custom"):
            (problem,) = problems_of_file(tmp_path, f"{VALID_FILE}name: {tag} [touch gone]\n")
            assert problem.startswith("line 5, column 7: "), tag

    def test_alias_bomb(self, tmp_path: Path) -> None:
        lines = ["a0: &a0 [1, 1]"]
        lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 30)]
        assert "anchors" in problems_of_file(tmp_path, "\n".join(lines))[0]

    def test_no_hang(self, tmp_path: Path) -> None:
        for text in (
            *("[" * 60_000, "{a: " * 15_000, "- " * 30_000, "? " * 30_000),
            "a:\n" + "- [1, 2]\n" * 7_000,
            f"{VALID_FILE}holes: [" + "[1, 1]," * 9_000 + "]",
            f"{VALID_FILE}holes: [" + "[[1,1],[2,1],[2,2]]," * 3_200 + "]",
            *(" " * MAX_BYTES, "#" * (10 * MAX_BYTES)),
        ):
            path = write(tmp_path, text)
            started = time.process_time()
            with pytest.raises(FieldError):
                load_field(path)
            assert time.process_time() - started < 3.0, text[-20:]

    @settings(max_examples=100)
    @given(text=st.text(max_size=400))
    @example(text="!!timestamp x")
    @example(text="!!binary x")
    @example(text="!!set {a}")
    @example(text="!!omap [a: 1]")
    @example(text="a: 1" + ":59" * 60)
    def test_any_text_is_a_field_error(
        self, tmp_path_factory: pytest.TempPathFactory, text: str
    ) -> None:
        path = tmp_path_factory.getbasetemp() / "fuzz.yaml"
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        with pytest.raises(FieldError):
            load_field(path)

    @settings(max_examples=100)
    @given(data=st.data())
    def test_a_damaged_file_is_a_field_or_a_field_error(
        self, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
    ) -> None:
        content = bytearray(VALID_FILE.encode())
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        path = tmp_path_factory.getbasetemp() / "damaged.yaml"
        path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
        try:
            field = load_field(path)
        except FieldError:
            return
        assert Field(**field.to_dict()) == field
