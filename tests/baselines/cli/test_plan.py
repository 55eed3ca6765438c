"""A proved optimum goes into the field file, and all else in it stays as it is."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from baselines.cli.main import main
from baselines.cli.plan import write_optimum
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field
from mbn_marl.planning import Plan
from tests.baselines.conftest import Refusal

CATALOGUE = Path(__file__).parents[3] / "envs_catalog" / "field_03.yaml"


@pytest.mark.parametrize("line", ["", "optimal_makespan: 99  # guessed\n", "optimal_makespan:\n"])
def test_comments_and_layout_stay(line: str, tmp_path: Path) -> None:
    path = tmp_path / "field_03.yaml"
    rest = CATALOGUE.read_text().replace("optimal_makespan: 17\n", line) + "# the end\n"
    path.write_text(rest)
    found: Any = SimpleNamespace(field=load_field(path), makespan=17)
    write_optimum(path, found)
    assert load_field(path).optimal_makespan == 17
    kept = path.read_text().splitlines()
    assert [one for one in rest.splitlines() if one not in kept] == line.splitlines()
    assert "# the end" in kept and (("# guessed" in path.read_text()) == ("guessed" in line))


def test_a_file_without_lines_of_yaml_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    lists = "vertices: [[0, 0], [90, 0], [90, 90]], rois: [[50, 20]], starts: [[40, 10]]"
    path.write_text(f"{{format: mbn-field/1, {lists}}}")
    before = path.read_text()
    found: Any = SimpleNamespace(field=load_field(path), makespan=5)
    with pytest.raises(ConfigError, match=r"own\.yaml"):
        write_optimum(path, found)
    assert path.read_text() == before


def test_a_plan_that_is_not_proved_is_kept_but_not_in_the_field(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "own.yaml", tmp_path / "out"
    path.write_text(CATALOGUE.read_text())
    monkeypatch.setattr(Plan, "optimal", property(lambda found: False))
    assert main(["plan", str(path), "--write", "--out", str(out)]) == 2
    assert f"{path} is left as it is" in capsys.readouterr().err
    assert (out / "plan.json").exists() and path.read_text() == CATALOGUE.read_text()


def test_an_optimum_that_is_not_written(refusal: Refusal) -> None:
    for words in (["field_03"], [str(CATALOGUE), "--wind", "0.1", "0"]):
        assert "write: " in refusal(["plan", *words, "--write"])
