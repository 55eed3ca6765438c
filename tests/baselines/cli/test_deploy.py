"""``mbn deploy``: the table, the files, and what is refused before anything is touched."""

import json

import numpy as np
import pytest

from baselines.cli import main
from baselines.cli.deploy import parse_speeds
from mbn_marl.config import make_config
from mbn_marl.episode import play, save_episode
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field, save_field
from tests.support.missions import SMALL

pytestmark = pytest.mark.slow


@pytest.fixture
def small_file(tmp_path):
    path = tmp_path / "bend.yaml"
    save_field(SMALL, path)
    return str(path)


def test_the_command_compares_and_writes(small_file, tmp_path, capsys, refusal):
    numbers, figure = tmp_path / "numbers.json", tmp_path / "paths.png"
    outputs = ["--json", str(numbers), "--figure", str(figure)]
    command = ["deploy", "greedy", "--field", small_file, "--compare", *outputs]
    assert main(command) == 0
    rows = json.loads(numbers.read_text())["deployments"]
    assert [row["sim"] for row in rows] == ["plane", "mujoco"]
    assert all(row["success"] for row in rows)
    ratio = rows[1]["makespan"] / rows[0]["makespan"]
    assert f"{ratio:.2f}" in capsys.readouterr().out
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert "already exists" in refusal(command)


def test_the_command_sweeps_the_wind(small_file, tmp_path):
    numbers, figure = tmp_path / "numbers.json", tmp_path / "panels.png"
    command = ["deploy", "greedy", "--field", small_file, "--wind-speeds", "0.1,0.2"]
    assert main([*command, "--json", str(numbers), "--figure", str(figure)]) == 0
    rows = json.loads(numbers.read_text())["deployments"]
    assert [(row["wind_speed"], row["wind_angle"]) for row in rows] == [(0.1, 30.0), (0.2, 30.0)]
    assert rows[0]["strongest_wind"] == 0.2
    assert figure.stat().st_size > 10_000
    command = ["deploy", "zoo:field_03", "--sim", "plane", "--wind-speeds", "0.5,0.1,0.3,0.1"]
    assert main([*command, "--json", str(numbers), "--force"]) == 0  # from the weakest, until lost
    rows = json.loads(numbers.read_text())["deployments"]
    assert [(row["wind_speed"], row["success"]) for row in rows] == [(0.1, True), (0.3, False)]
    assert {row["strongest_wind"] for row in rows} == {0.1}


def test_wind_speeds_are_listed_or_in_even_steps():
    assert parse_speeds("0, 0.25,1") == [0.0, 0.25, 1.0]
    assert parse_speeds("0.4,0.3,..,0.1,0") == [0.4, 0.3, 0.2, 0.1, 0.0]
    assert len(parse_speeds("0,1,..,99")) == 100
    ends = ("0,fast", "-0.1", "0,inf", "nan", "0,..,0.5", "0,0.1,..", "0,0.1,..,inf")
    for wrong in (*ends, "0,0.2,..,0.5", "0,0,..,0.5", "0,0.1,..,0", "0,1,..,100"):
        with pytest.raises(ConfigError, match=f"wind_speeds '{wrong}'"):
            parse_speeds(wrong)


@pytest.mark.parametrize(
    ("options", "place"),
    [
        ("greedy", "field: greedy"),
        ("zoo:field_03 --sim plane --compare", "compare: "),
        ("zoo:field_03 --sim coppeliasim --vehicle balancer", "vehicle: "),
        ("zoo:field_03 --figure x.png", "figure: "),
        ("zoo:field_03 --video x.avi", "video: x.avi"),
        ("zoo:field_03 --condition windy --wind-speeds 0.1", "windy"),
        ("zoo:field_03 --sim plane --vehicle balancer", "vehicle: "),
        ("zoo:field_03 --camera top", "camera: "),
        ("zoo:field_03 --wind-angle 90", "wind_angle: "),
        ("zoo:field_03 --port 1 --timeout 1", "timeout: "),
    ],
)
def test_wrong_options_are_refused_by_place(options, place, refusal):
    assert place in refusal(["deploy", *options.split()])


COMMANDS = """
deploy greedy --field field_03 --sim plane --json old --video a.mp4
deploy greedy --field field_03 --compare --json old --figure a.txt
deploy greedy --field field_03 --video old.mp4 --json folder
deploy greedy --field field_03 --json old --wind-speeds 0.1,x
deploy greedy --field field_03 --json old --sim coppeliasim --port 1 --timeout 0.1
render field_03 -o old
evaluate greedy --field field_03 --json old --record file
render nowhere -o old.gif
replay broken.json -o old.html
plan nowhere --out file
report nowhere --comparison -o old.md
report nowhere --paper -o old.md
watch nowhere -o old.json
"""


def test_with_force_nothing_is_moved_aside_before_all_is_checked(tmp_path, refusal):
    names = ("old", "old.mp4", "old.html", "old.gif", "old.md", "old.json", "file")
    for name in names:
        (tmp_path / name).write_text(name)
    (tmp_path / "folder").mkdir()
    still = play(load_field("field_03"), make_config({}), np.zeros((3, 3, 2)))
    broken = save_episode(still, tmp_path / "broken.json")
    broken.write_text(broken.read_text().replace('"tau":1.0', '"tau":-1.0'))
    for command in COMMANDS.strip().splitlines():
        refusal([*command.split(), "--force"])
        assert {path.name for path in tmp_path.iterdir()} == {*names, "folder", "broken.json"}
        assert all((tmp_path / name).read_text() == name for name in names), command
