"""A proved optimum goes into the field file, and all else in it stays as it is."""

from pathlib import Path

import pytest

from baselines.cli.main import main
from baselines.cli.plan import write_optimum
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field
from mbn_marl.planning import Plan

CATALOGUE = Path(__file__).parents[3] / "envs_catalog" / "field_03.yaml"


@pytest.mark.parametrize("line", ["", "optimal_makespan: 99  # guessed\n", "optimal_makespan:\n"])
def test_comments_and_layout_stay(line, tmp_path):
    path = tmp_path / "field_03.yaml"
    rest = CATALOGUE.read_text().replace("optimal_makespan: 17\n", line) + "# the end\n"
    path.write_text(rest)
    write_optimum(path, 17)
    assert load_field(path).optimal_makespan == 17
    kept = path.read_text().splitlines()
    assert [one for one in rest.splitlines() if one not in kept] == line.splitlines()
    assert "# the end" in kept and (("# guessed" in path.read_text()) == ("guessed" in line))


def test_a_link_its_mode_and_its_ends_of_lines_stay(tmp_path):
    path, link = tmp_path / "field_03.yaml", tmp_path / "link.yaml"
    path.write_bytes(CATALOGUE.read_bytes().replace(b"\n", b"\r\n"))
    path.chmod(0o600)
    link.symlink_to(path)
    write_optimum(link, 18)
    assert link.is_symlink() and load_field(path).optimal_makespan == 18
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.read_bytes().count(b"\r\n") == CATALOGUE.read_bytes().count(b"\n")


def test_a_file_without_lines_of_yaml_is_refused(tmp_path):
    path = tmp_path / "own.yaml"
    lists = "vertices: [[0, 0], [90, 0], [90, 90]], rois: [[50, 20]], starts: [[40, 10]]"
    path.write_text(f"{{format: mbn-field/1, {lists}}}")
    before = path.read_text()
    with pytest.raises(ConfigError, match=r"own\.yaml"):
        write_optimum(path, 5)
    assert path.read_text() == before


def test_a_plan_that_is_not_proved_is_kept_but_not_in_the_field(tmp_path, monkeypatch, refusal):
    path, out = tmp_path / "own.yaml", tmp_path / "out"
    path.write_text(CATALOGUE.read_text())
    monkeypatch.setattr(Plan, "optimal", property(lambda found: False))
    error = refusal(["plan", str(path), "--write", "--out", str(out)])
    assert f"{path} is left as it is" in error
    assert (out / "plan.json").exists() and path.read_text() == CATALOGUE.read_text()


@pytest.mark.slow
def test_an_optimum_is_written_from_the_plan_that_is_there(tmp_path, monkeypatch, refusal):
    path, out = tmp_path / "own.yaml", ["--out", str(tmp_path / "plan")]
    path.write_text(CATALOGUE.read_text().replace("optimal_makespan: 17\n", ""))
    assert main(["plan", str(path), *out]) == 0
    other = tmp_path / "other.yaml"
    other.write_text(path.read_text().replace("field_03", "other"))
    monkeypatch.setattr("mbn_marl.planning.plan", None)  # nothing is planned again
    assert "already exists" in refusal(["plan", str(other), "--write", *out])
    assert main(["plan", str(path), "--write", *out]) == 0
    assert load_field(path).optimal_makespan == 17
