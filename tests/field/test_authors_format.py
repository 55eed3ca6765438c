"""The authors' own field sets: tens of units, tuples as tags, one or several sets in a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from mbn_marl.errors import FieldError
from mbn_marl.field import Field, load_field
from tests.golden import FIELDS
from tests.support.field_cases import write

TAGGED = """\
grid_size: 50
field:
- !!python/tuple
  - 4.5
  - 2.0
- !!python/tuple
  - 30
  - 2
- [30, 40.25]
infected_locations:
- !!python/tuple [28, 20]
- [20, 10]
init_positions:
- !!python/tuple [25, 15]
"""

SETS = """\
{
  "set1": {
    "field": [[0.0, 0.0], [90.0, 0.0], [0.0, 90.0]],
    "init_positions": [[10.0, 10.0], [10.0, 12.5]],
    "infected_locations": [[20.0, 20.0]]
  },
  "set2": {
    "grid_size": 95,
    "field": [[0, 0], [90, 0], [90, 95]],
    "init_positions": [[50, 10]],
    "infected_locations": [[60, 10], [70, 10]]
  }
}
"""


def problems_of(path: Path | str) -> list[str]:
    with pytest.raises(FieldError) as caught:
        load_field(path)
    return caught.value.problems


def test_a_set_is_read_in_arena_units(tmp_path: Path) -> None:
    field = load_field(write(tmp_path, TAGGED, "set1.yaml"))
    assert field == Field(
        vertices=[(45, 20), (300, 20), (300, 402.5)],
        rois=[(280, 200), (200, 100)],
        starts=[(250, 150)],
        arena=(500, 500),
        name="set1",
    )


def test_golden_fields_as_the_authors_dump_them(tmp_path: Path) -> None:
    names = {"field": "vertices", "init_positions": "starts", "infected_locations": "rois"}
    for name, ours in FIELDS.items():
        theirs: dict[str, Any] = {"grid_size": 100}
        for key, list_name in names.items():
            theirs[key] = [(x / 10, y / 10) for x, y in ours[list_name]]
        text = yaml.dump(theirs)
        assert "!!python/tuple" in text
        assert load_field(write(tmp_path, text, f"{name}.yaml")) == Field(**ours, name=name)


def test_one_of_several_sets(tmp_path: Path) -> None:
    path = write(tmp_path, SETS, "sets.json")
    first, second = load_field(f"{path}#set1"), load_field(f"{path}#set2")
    assert (first.name, first.arena) == ("set1", (1000, 1000))
    assert first.starts.tolist() == [[100, 100], [100, 125]]
    assert (second.name, second.arena) == ("set2", (950, 950))


def test_the_names_of_several_sets_are_listed(tmp_path: Path) -> None:
    path = write(tmp_path, SETS, "sets.json")
    for source in (path, f"{path}#set3"):
        (problem,) = problems_of(source)
        assert problem.startswith("file: ") and "set1, set2" in problem


def test_the_only_set_needs_no_name(tmp_path: Path) -> None:
    text = "only:\n" + "".join(f"  {line}\n" for line in TAGGED.splitlines())
    assert load_field(write(tmp_path, text)).name == "only"


def test_a_file_whose_name_holds_a_hash(tmp_path: Path) -> None:
    assert load_field(write(tmp_path, TAGGED, "set#1.yaml")).name == "set_1"


def test_problems_use_the_words_of_the_file(tmp_path: Path) -> None:
    problems = problems_of(
        write(
            tmp_path,
            "grid_size: 50\ncolour: red\nfield: [[0, 0], [40, 0], [40, 60], [0, 0]]\n"
            "init_positions: [[30, 10], [30, 10], [x, 1]]\n",
        )
    )
    assert [problem.split(": ")[0] for problem in problems] == [
        *("colour", "infected_locations", "init_positions[2].x"),
        *("field[3]", "field[2]", "init_positions[1]"),
    ]
    assert "field[0]" in problems[3] and "init_positions[0]" in problems[5]
    for grid in ("big", "[50, 50]", "-5", "0", ".nan", "1.0e+9", "true", "null"):
        text = TAGGED.replace("grid_size: 50", f"grid_size: {grid}")
        (problem,) = problems_of(write(tmp_path, text))
        assert problem.startswith("grid_size: "), grid


@pytest.mark.parametrize("pick", ["", "#env1", "#other"])
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("wheeled.json", '{"env1": {"screen": {"width": 9}, "robots": {}, "goals": {}}}'),
        ("one.json", '{"screen": {"width": 9}, "robots": {}, "obstacles": []}'),
        ("env1.ini", "[SCREEN]\nWIDTH = 400\n\n[ROBOTS]\nLENGTH = 20\n"),
    ],
)
def test_their_wheeled_robots_are_another_format(
    tmp_path: Path, name: str, text: str, pick: str
) -> None:
    (problem,) = problems_of(f"{write(tmp_path, text, name)}{pick}")
    assert problem.startswith("format: ")


def test_other_tags_run_no_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(command: str) -> int:
        raise AssertionError(f"ran {command}")

    monkeypatch.setattr("os.system", forbidden)
    text = TAGGED.replace("!!python/tuple", "!!python/object/apply:os.system")
    (problem,) = problems_of(write(tmp_path, text))
    assert problem.startswith("line ")


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=10,
)
keys = st.sampled_from(["field", "init_positions", "infected_locations", "grid_size", "other"])


@settings(max_examples=100)
@given(document=st.dictionaries(keys, values, min_size=1))
def test_any_document_is_a_field_error(
    tmp_path_factory: pytest.TempPathFactory, document: dict[str, Any]
) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed_set.yaml"
    path.write_text(yaml.dump(document), encoding="utf-8")
    with pytest.raises(FieldError):
        load_field(path)
