"""Run folders: what they hold, and what they refuse."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from baselines.runs.files import RunError, alone, claim_folder, read_json, write_json
from baselines.runs.folder import RunFolder
from baselines.training.config import TrainConfig
from baselines.training.progress_bar import Report
from mbn_marl.errors import ConfigError, MbnError
from mbn_marl.field import load_field

# Storage


def test_claim_folder_refuses_to_overwrite(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "result").write_text("dear")
    with pytest.raises(RunError, match="--force"):
        claim_folder(tmp_path / "run")
    assert (tmp_path / "run" / "result").read_text() == "dear"


def test_claim_folder_with_force_loses_nothing(tmp_path: Path) -> None:
    for content in ("first", "second"):
        folder = claim_folder(tmp_path / "run", force=True)
        (folder / "result").write_text(content)
    claim_folder(tmp_path / "run", force=True)
    assert not list((tmp_path / "run").iterdir())
    assert (tmp_path / "run.1" / "result").read_text() == "first"
    assert (tmp_path / "run.2" / "result").read_text() == "second"


def test_claim_folder_accepts_an_empty_one_and_refuses_a_file(tmp_path: Path) -> None:
    assert claim_folder(tmp_path) == tmp_path
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="is a file"):
        claim_folder(tmp_path / "file", force=True)


def test_write_json_leaves_the_old_file_when_it_fails(tmp_path: Path) -> None:
    path = tmp_path / "value.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"a": float("nan")})
    assert read_json(path) == {"a": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["value.json"]


def test_read_json_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"missing\.json is missing"):
        read_json(tmp_path / "missing.json")
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(RunError, match=r"bad\.json is not valid JSON"):
        read_json(tmp_path / "bad.json")


def test_a_folder_at_work_is_not_moved_aside(tmp_path: Path) -> None:
    inner = tmp_path / "comparison" / "run"
    inner.mkdir(parents=True)
    with (
        alone(inner, "mbn train"),
        pytest.raises(RunError, match=r"run: another mbn train .*is running"),
    ):
        claim_folder(tmp_path / "comparison", force=True)
    claim_folder(tmp_path / "comparison", force=True)
    assert (tmp_path / "comparison.1" / "run").is_dir()


# Runs


def _run_folder(path: Path) -> RunFolder:
    """A run that has just begun."""
    return RunFolder.create(path / "run", {"algorithm": "mappo"}, load_field("field_03"), "mbn")


def test_progress_has_the_columns_of_its_first_row(tmp_path: Path) -> None:
    run = _run_folder(tmp_path)
    run.append_progress({"env_steps": 8.0, "loss": 0.25})
    run.append_progress({"env_steps": 16.0, "loss": float("nan")})
    with pytest.raises(ValueError, match="differ"):
        run.append_progress({"env_steps": 24.0})
    assert (run.path / "progress.csv").read_text().split() == ["env_steps,loss", "8,0.25", "16,nan"]


def test_a_run_records_field_command_and_versions(tmp_path: Path) -> None:
    run = RunFolder.create(
        tmp_path / "run", {"algorithm": "ppo"}, load_field("field_07"), "mbn train it"
    )
    assert run.field == load_field("field_07")
    assert (run.path / "command.txt").read_text() == "mbn train it\n"
    assert json.loads((run.path / "versions.json").read_text())["packages"]["torch"]
    with pytest.raises(RunError, match="not a run folder"):
        RunFolder.open(tmp_path)


def test_train_config_lists_every_number_out_of_range() -> None:
    with pytest.raises(ConfigError) as caught:
        TrainConfig("ppo", "field_03", seed=-1, steps=0)
    assert [line.split(":")[0] for line in caught.value.problems] == ["seed", "steps"]


def test_train_config_names_unknown_algorithms_and_fields() -> None:
    with pytest.raises(MbnError, match="sac: unknown algorithm"):
        TrainConfig("sac", "field_03")
    with pytest.raises(MbnError, match="field_99"):
        TrainConfig("ppo", "field_99")


def test_the_speed_of_a_slow_learner_is_shown() -> None:
    speeds = (42.4, 9_960.0, 123_456.0)
    words = [Report("run", 1, False, speed, None, None).speed for speed in speeds]
    assert words == ["  42/s", "9,960/s", "123k/s"]
