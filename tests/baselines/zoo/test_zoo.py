"""The zoo: its entries, what their cards say, and how an entry is made."""

import json
import re
import shutil
import tomllib
from pathlib import Path
from typing import Any

import pytest

from baselines import load_policy
from baselines.cli import main
from baselines.evaluation.evaluate import EVALUATION_SEED, evaluate_both, unseen
from baselines.policies import load
from baselines.policies.load import CARD, ENTRIES, entry_names
from baselines.runs.files import RunError, read_json, write_json
from baselines.runs.folder import RunFolder
from baselines.zoo.make import LARGEST, make_entry
from mbn_marl.field import FieldSampler, catalogue_names, load_field, save_field

ROOT = Path(__file__).parents[3]
ANYWHERE = ("generalist", "generalist-hint", "search")
"""The policies that were trained on random fields."""
IN_THE_GATE = ("field_03", "field_07")
pytestmark = pytest.mark.slow


@pytest.fixture
def run(tiny_runs, tmp_path):
    shutil.copytree(tiny_runs.finished("mappo").path, tmp_path / "source")
    command = "mbn train mappo field_03 --seed 4 --out '/home/me/my runs' --force --out=x --resume"
    (tmp_path / "source" / "command.txt").write_text(command)
    return RunFolder.open(tmp_path / "source")


@pytest.fixture
def zoo(run, tmp_path, monkeypatch):
    folder = tmp_path / "baselines" / "zoo"
    make_entry(run, folder / "tiny")
    monkeypatch.setattr(load, "ENTRIES", folder)
    return folder


def evaluation_of(name: str, out: Path) -> dict[str, Any]:
    if name in ANYWHERE:
        loaded, fields = load_policy(f"zoo:{name}"), RunFolder.open(ENTRIES / name).fields
        where = unseen(fields, EVALUATION_SEED), loaded.settings
        both = evaluate_both(loaded.policy, *where, episodes=100)
        return {kind: evaluation.summary() for kind, evaluation in both.items()}
    assert main(["evaluate", f"zoo:{name}", "--episodes", "100", "--json", str(out)]) == 0
    result = json.loads(out.read_text())
    return {
        kind: {key: value for key, value in result[kind].items() if key != "per_episode"}
        for kind in ("stochastic", "deterministic")
    }


def test_an_entry_is_a_small_run_that_acts_as_its_card_says(zoo, run, tmp_path, capsys):
    entry, files = RunFolder.open(zoo / "tiny"), {*zoo.rglob("*.*")}
    weights = ("policy/policy.json", "policy/policy.safetensors")
    names = ("card.json", "config.json", "field.yaml", *weights)
    assert files == {entry.path / name for name in names}
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    patterns = settings["package-data"]["baselines"]
    assert files <= {path for pattern in patterns for path in zoo.parent.glob(pattern)}
    assert (entry.config, entry.field) == (run.config, run.field)
    card = json.loads((entry.path / "card.json").read_text())
    assert evaluation_of("tiny", tmp_path / "out.json").items() <= card.items()
    assert (card["name"], card["algorithm"], card["seed"]) == ("tiny", "mappo", 0)
    assert card["env_steps"] >= 400 and card["stochastic"]["episodes"] == 100
    assert card["command"] == "mbn train mappo field_03 --seed 4"
    capsys.readouterr()
    assert main(["zoo"]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"zoo:tiny +all +sampled ", printed)


def test_an_entry_is_made_again_and_nothing_else_is_replaced(zoo, run, tmp_path, refusal):
    entry, mine = zoo / "tiny", tmp_path / "mine"
    (entry / "field.yaml").unlink()
    again = ["zoo", "--add", str(run.path), "--out", str(entry)]
    assert "--force" in refusal(again)
    assert main([*again, "--force"]) == 0
    assert (entry / "field.yaml").is_file() and (zoo / "tiny.1" / "card.json").is_file()
    shutil.copytree(entry, zoo / "gamma-0.9")
    assert load.entry_names() == ["gamma-0.9", "tiny"]
    shutil.rmtree(zoo / "gamma-0.9")
    mine.mkdir()
    (mine / "dear").touch()
    with pytest.raises(RunError, match="mine"):
        make_entry(run, mine)
    assert [path.name for path in mine.iterdir()] == ["dear"]
    shutil.copytree(zoo / "tiny", zoo / "other")
    for command in (["evaluate"], ["render", "-o", "a.gif"], ["watch"]):
        error = refusal([*command, "zoo:../tiny"])
        assert "zoo:../tiny: " in error and "zoo:other, zoo:tiny" in error


def test_what_makes_no_entry(run, tmp_path, refusal):
    def refused(place: str) -> None:
        assert place in refusal(["zoo", "--add", str(run.path), "--out", "entry"])
        assert not (tmp_path / "entry").exists()

    config = run.config
    evaluation = (run.path / "evaluation.json").read_bytes()
    (run.path / "evaluation.json").unlink()
    refused(str(run.path))
    write_json(run.path / "evaluation.json", {})
    refused("evaluation.json")
    (run.path / "evaluation.json").write_bytes(evaluation)
    save_field(load_field("field_03"), tmp_path / "mine.yaml")
    write_json(run.path / "config.json", {**config, "field": str(tmp_path / "mine.yaml")})
    refused("mine.yaml")
    write_json(run.path / "config.json", {**config, "padding": " " * LARGEST})
    refused("1,000,000")


def test_there_is_an_entry_for_every_field():
    assert {*entry_names()} == {*catalogue_names(), *ANYWHERE}


@pytest.mark.parametrize(
    "name",
    [
        name if name in IN_THE_GATE else pytest.param(name, marks=pytest.mark.all)
        for name in entry_names()
    ],
)
def test_a_shipped_entry_does_what_its_card_says(name, tmp_path):
    card, run = read_json(ENTRIES / name / CARD), RunFolder.open(ENTRIES / name)
    files = [path for path in run.path.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= LARGEST
    assert {path.suffix for path in files} == {".json", ".safetensors", ".yaml"}
    assert card["name"] == name
    if name in ANYWHERE:
        assert isinstance(run.fields, FieldSampler)
    else:
        assert run.field == load_field(name) and card["field"] == name
    for kind, found in evaluation_of(name, tmp_path / "out.json").items():
        said = card[kind]
        # Another processor may round otherwise, and an episode may go another way.
        assert found["success_rate"] == pytest.approx(said["success_rate"], abs=0.02)
        assert found["makespan"] == pytest.approx(said["makespan"], rel=0.02)
        assert (said["gap"] is None) == (name in ANYWHERE)
        if name not in ANYWHERE:  # where one team that is stuck outweighs all others
            assert found["return_mean"] == pytest.approx(said["return_mean"], rel=0.02)
