"""The zoo: its entries, what their cards say, and how an entry is made."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import pytest

from baselines import load_policy
from baselines.cli import main
from baselines.evaluation.evaluate import EVALUATION_SEED, evaluate_both, unseen
from baselines.runs.folder import RunFolder
from baselines.training.config import TrainConfig
from baselines.training.train import train
from baselines.zoo import entries
from baselines.zoo.entries import FOLDER, entry_names, read_card
from baselines.zoo.make import LARGEST, make_entry, plain_command, readme
from mbn_marl.field import FieldSampler, catalogue_names, load_field, save_field

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run of one update."""
    small = {"num_worlds": 2, "rollout_steps": 8, "hidden": [8], "action_repeat": [1, 1]}
    config = TrainConfig(
        "mappo",
        "field_03",
        seed=4,
        steps=16,
        episodes=1,
        environment={"max_steps": 30},
        hyperparameters=small,
    )
    command = "mbn train mappo field_03 --seed 4 --out '/home/me/my runs' --force"
    return train(config, tmp_path_factory.mktemp("runs") / "run", command=command)


@pytest.fixture
def zoo(run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A zoo with the run as its only entry, ``zoo:tiny``."""
    folder = tmp_path / "baselines" / "zoo"
    make_entry(run, folder / "tiny")
    monkeypatch.setattr(entries, "FOLDER", folder)
    return folder


ANYWHERE = ("generalist", "generalist-hint")
"""The policies that were trained on random fields."""


def evaluation_of(name: str, out: Path) -> dict[str, Any]:
    """What ``mbn evaluate`` writes about ``zoo:<name>``, but for the single episodes."""
    if name in ANYWHERE:
        loaded, fields = load_policy(f"zoo:{name}"), RunFolder.open(FOLDER / name).fields
        where = unseen(fields, EVALUATION_SEED), loaded.settings
        both = evaluate_both(loaded.policy, *where, episodes=100)
        return {kind: evaluation.summary() for kind, evaluation in both.items()}
    assert main(["evaluate", f"zoo:{name}", "--episodes", "100", "--json", str(out)]) == 0
    result = json.loads(out.read_text())
    return {
        kind: {key: value for key, value in result[kind].items() if key != "per_episode"}
        for kind in ("stochastic", "deterministic")
    }


def test_evaluate_says_what_the_card_says(zoo: Path, tmp_path: Path) -> None:
    card = json.loads((zoo / "tiny" / "card.json").read_text())
    assert evaluation_of("tiny", tmp_path / "out.json").items() <= card.items()
    assert (card["name"], card["algorithm"], card["seed"]) == ("tiny", "mappo", 4)
    assert (card["env_steps"], card["stochastic"]["episodes"]) == (16, 100)
    assert card["command"] == "mbn train mappo field_03 --seed 4"


def test_an_entry_holds_what_its_run_was_and_no_pickle(zoo: Path, run: RunFolder) -> None:
    files = {str(path.relative_to(zoo)) for path in zoo.rglob("*") if path.is_file()}
    names = ("README.md", "card.json", "checksums.json", "config.json", "field.yaml")
    weights = ("policy/checksums.json", "policy/policy.json", "policy/policy.safetensors")
    assert files == {f"tiny/{name}" for name in (*names, *weights)}
    entry = RunFolder.open(zoo / "tiny")
    assert (entry.config, entry.field) == (run.config, run.field)
    text = (zoo / "tiny" / "README.md").read_text()
    stochastic = json.loads((zoo / "tiny" / "card.json").read_text())["stochastic"]
    assert "mappo on field_03, trained with seed 4 for 16 env-steps" in text
    assert f"| sampled | {stochastic['return_mean']:,.0f} |" in text


def test_render_and_the_list_know_it(
    zoo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gif, png = tmp_path / "episode.gif", tmp_path / "paths.png"
    assert main(["render", "zoo:tiny", "-o", str(gif), "--steps", "3"]) == 0
    assert main(["render", "zoo:tiny", "-o", str(png), "--steps", "3"]) == 0
    assert (gif.read_bytes()[:6], png.read_bytes()[:4]) == (b"GIF89a", b"\x89PNG")
    capsys.readouterr()
    assert main(["zoo"]) == 0
    printed = capsys.readouterr().out
    assert "zoo:tiny" in printed and "mappo" in printed


def test_an_entry_is_made_anew_and_nothing_else_is_replaced(
    zoo: Path, run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entry, mine = zoo / "tiny", tmp_path / "mine"
    (entry / "README.md").unlink()
    assert main(["zoo", "--add", str(run.path), "--out", str(entry)]) == 0
    assert (entry / "README.md").is_file()
    mine.mkdir()
    (mine / "dear").touch()
    assert main(["zoo", "--add", str(run.path), "--out", str(mine)]) == 2
    assert "is no entry of the zoo" in capsys.readouterr().err
    assert [path.name for path in mine.iterdir()] == ["dear"]


@pytest.mark.parametrize("command", [["evaluate"], ["render", "-o", "a.gif"], ["watch"]])
def test_an_unknown_name_lists_the_known_ones(
    command: list[str], zoo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(zoo / "tiny", zoo / "other")
    assert main([*command, "zoo:../tiny"]) == 2
    error = capsys.readouterr().err
    assert (
        error
        == "mbn: error: zoo:../tiny: unknown policy (did you mean tiny?); known: other, tiny\n"
    )


def test_the_package_is_not_written_to(zoo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "zoo:tiny", "--wind-speeds", "0", "--json", "x.json"]) == 2
    assert (
        "json, figure: of a policy without a run folder in wind, name both"
        in capsys.readouterr().err
    )


def test_what_makes_no_entry(
    run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(path: Path) -> str:
        assert main(["zoo", "--add", str(path), "--out", str(tmp_path / "entry")]) == 2
        assert not (tmp_path / "entry").exists()
        return capsys.readouterr().err

    changed = tmp_path / "run"
    shutil.copytree(run.path, changed)
    evaluation = (changed / "evaluation.json").read_bytes()
    (changed / "evaluation.json").unlink()
    assert "is not finished" in refused(changed)
    (changed / "evaluation.json").write_bytes(evaluation)
    save_field(load_field("field_03"), tmp_path / "mine.yaml")
    config = {**run.config, "field": str(tmp_path / "mine.yaml")}
    (changed / "config.json").write_text(json.dumps(config))
    assert "mine.yaml; allowed: field_01" in refused(changed)
    padded = {**run.config, "padding": " " * LARGEST}
    (changed / "config.json").write_text(json.dumps(padded))
    assert "allowed: up to 1,000,000" in refused(changed)


def test_a_command_loses_where_its_files_went() -> None:
    command = "mbn train ppo field_01 -o 'my run' --seed 3 --out=x --resume"
    assert plain_command(command) == "mbn train ppo field_01 --seed 3"


# The zoo of the package


def test_there_is_an_entry_for_every_field() -> None:
    assert {*entry_names()} == {*catalogue_names(), *ANYWHERE}


@pytest.mark.parametrize("name", entry_names())
def test_a_shipped_entry_is_small_and_does_what_its_card_says(name: str, tmp_path: Path) -> None:
    card, run = read_card(name), RunFolder.open(FOLDER / name)
    files = [path for path in run.path.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= LARGEST
    assert {path.suffix for path in files} == {".json", ".md", ".safetensors", ".yaml"}
    assert card["name"] == name
    if name in ANYWHERE:
        assert isinstance(run.fields, FieldSampler) and card["optimum"] is None
    else:
        assert run.field == load_field(name) and card["field"] == name
    assert (run.path / "README.md").read_text() == readme(card)
    for kind, found in evaluation_of(name, tmp_path / "out.json").items():
        said = card[kind]
        # Another processor may round otherwise, and an episode may go another way.
        assert found["success_rate"] == pytest.approx(said["success_rate"], abs=0.02)
        assert found["makespan"] == pytest.approx(said["makespan"], rel=0.02)
        if name not in ANYWHERE:  # where one team that is stuck outweighs all others
            assert found["return_mean"] == pytest.approx(said["return_mean"], rel=0.02)


def test_every_file_of_the_zoo_is_package_data(zoo: Path) -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    patterns = settings["package-data"]["baselines"]
    installed = {path for pattern in patterns for path in zoo.parent.glob(pattern)}
    files = {path for path in zoo.rglob("*") if path.is_file()}
    assert len(files) == 8 and files <= installed
