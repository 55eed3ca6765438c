"""Tuning: from the command line, interrupted, by several processes, pruned, diverged."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import optuna
import pytest
import yaml
from filelock import FileLock
from optuna.distributions import FloatDistribution
from optuna.samplers._tpe.sampler import _split_trials
from optuna.trial import TrialState, create_trial

from baselines.algorithms import find_algorithm
from baselines.cli import main
from baselines.paper import published
from baselines.runs.files import RunError, write_json
from baselines.sweep.processes import LocalEngine
from baselines.training.config import DivergenceError
from baselines.tuning import trial as trials_module
from baselines.tuning.study import begin_study, open_study
from baselines.tuning.trial import News, Space, TrialJob, TuneConfig, run_trial
from baselines.tuning.tune import tune
from mbn_marl.errors import ConfigError
from tests.baselines.conftest import Refusal

pytestmark = pytest.mark.slow

TINY = ("--field", "field_03", "--steps", "20", "--evaluate-every", "20", "--episodes", "1")
CONFIG = TuneConfig("a2c", "field_03", 33, 20, 20, 1, 1)


def table(folder: Path) -> list[dict[str, str]]:
    """The trials of a study, as its table has them."""
    with (folder / "trials.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a study of one trial of A2C."""
    out = tmp_path_factory.mktemp("studies") / "study"
    assert main(["tune", "a2c", *TINY, "--trials", "1", "--out", str(out)]) == 0
    return out


def test_what_is_tuned_is_what_the_paper_tuned_and_the_library_takes() -> None:
    spaces = {name: Space.of(name) for name in published.ALGORITHMS}
    tuned = {name: space.ranges.keys() for name, space in spaces.items()}
    on_policy = {"gamma", "gae_lambda", "learning_rate"}
    losses = {"vf_coef", "ent_coef", "max_grad_norm"}
    assert tuned == {
        "a2c": on_policy | losses,
        "ppo": on_policy | losses,
        "trpo": on_policy,
        "ars": {"learning_rate"},
        "crossq": {"gamma", "learning_rate", "ent_coef", "buffer_size"},
        "tqc": {"gamma", "learning_rate", "buffer_size"},
    }
    skipped = {name: space.skipped for name, space in spaces.items() if space.skipped}
    assert skipped == {"crossq": ("gae_lambda", "vf_coef", "max_grad_norm")}
    ranges = {name: ends for space in spaces.values() for name, ends in space.ranges.items()}
    assert ranges == {
        "learning_rate": (1e-4, 5e-2),
        "gamma": (0.9, 0.99),
        "gae_lambda": (0.9, 1.0),
        "vf_coef": (0.2, 0.7),
        "ent_coef": (0.0, 0.05),
        "max_grad_norm": (0.3, 0.99),
        "buffer_size": (1000, 100_000),
    }


def test_a_suggestion_is_of_the_right_kind() -> None:
    trial = optuna.create_study().ask()
    values = Space.of("crossq").suggest(trial)
    assert isinstance(values["buffer_size"], int)
    rate = trial.distributions["learning_rate"]
    assert isinstance(rate, FloatDistribution) and rate.log
    assert not getattr(trial.distributions["gamma"], "log", True)


def test_tune_writes_what_setting_b_reads(study: Path) -> None:
    (row,) = table(study)
    assert (row["trial"], row["state"]) == ("0", "complete")
    values = {name: float(row[name]) for name in Space.of("a2c").suggest(_fixed(row))}
    assert yaml.safe_load((study / "a2c.yaml").read_text())["B"]["model"] == values
    run = study / "trials" / "trial-0000"
    config = json.loads((run / "config.json").read_text())
    assert config["hyperparameters"]["model"] == values
    assert (run / "command.txt").read_text().startswith("mbn tune a2c --field field_03")
    final = json.loads((run / "evaluation.json").read_text())
    assert float(row["return_mean"]) == final["stochastic"]["return_mean"]
    assert (study / "study.png").read_bytes().startswith(b"\x89PNG")
    read = find_algorithm("a2c").resolve({}, setting="B", file=study / "a2c.yaml")
    assert read.model == values


def _fixed(row: dict[str, str]) -> Any:
    """A trial that can only draw what ``row`` says."""
    names = [name for name in row if name not in ("trial", "state", "return_mean")]
    return optuna.trial.FixedTrial({name: float(row[name]) for name in names})


def test_a_report_draws_the_study_and_takes_its_trials_for_no_runs(
    study: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ["report", "--paper", str(study), "-o", str(tmp_path / "out")]
    assert main(words) == 2
    assert str(study) in capsys.readouterr().err
    words[2] = str(study / "trials" / "trial-0000")
    assert main([*words, "--study", str(study)]) == 0
    assert (tmp_path / "out" / "optuna.png").is_file()
    assert "](optuna.png)" in (tmp_path / "out" / "paper.md").read_text()


def test_resume_keeps_what_there_is_and_runs_an_interrupted_trial_again(tmp_path: Path) -> None:
    out = tmp_path / "study"
    words = ["tune", "a2c", *TINY, "--seed", str(2**32 - 1), "--out", str(out)]  # the largest
    assert main([*words, "--trials", "1"]) == 0
    first = table(out)
    open_study(out).ask()  # as if the process had been killed during trial 1
    assert main([*words, "--trials", "2", "--resume"]) == 0
    rows = table(out)
    assert rows[:1] == first
    assert [row["state"] for row in rows] == ["complete", "fail", "complete"]
    assert rows[2]["learning_rate"] != first[0]["learning_rate"]
    before = open_study(out).get_trials()
    assert main([*words, "--trials", "2", "--resume"]) == 0, "nothing is left to do"
    assert open_study(out).get_trials() == before


@pytest.mark.all
def test_two_processes_share_a_study(tmp_path: Path) -> None:
    out = tmp_path / "study"
    words = ["tune", "a2c", *TINY, "--trials", "3", "--processes", "2", "--out", str(out)]
    assert main(words) == 0
    rows = table(out)
    assert [row["state"] for row in rows] == ["complete"] * 3
    assert len({row["learning_rate"] for row in rows}) == 3
    assert len(list((out / "trials").iterdir())) == 3


def test_a_study_at_work_is_left_alone(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with FileLock(study / ".lock"):
        words = ["tune", "a2c", *TINY, "--trials", "5", "--resume", "--out", str(study)]
        assert main(words) == 2
    assert "another mbn tune" in capsys.readouterr().err
    assert len(open_study(study).get_trials()) == 1


def _begin(folder: Path) -> Path:
    """A study without a trial."""
    folder.mkdir()
    (folder / "command.txt").write_text("mbn tune a2c\n")
    write_json(
        folder / "config.json",
        {"algorithm": "a2c", "field": "field_03", "steps": 20, "database": None},
    )
    begin_study(folder, None)
    return folder


def test_a_trial_below_the_median_is_pruned(tmp_path: Path) -> None:
    folder = _begin(tmp_path / "study")
    for _ in range(5):
        better = create_trial(value=1e6, intermediate_values={1: 1e6, 2: 1e6})
        open_study(folder).add_trial(better)
    config = TuneConfig("a2c", "field_03", 33, 3000, 1000, 1, 1)
    news: list[News] = []
    run_trial(TrialJob(config, folder, None, "mbn tune a2c", "job"), news.append)
    assert news[-1].state == "pruned" and 1000 <= news[-1].env_steps < 2000
    last = open_study(folder).get_trials()[-1]
    assert last.state is TrialState.PRUNED
    evaluations = folder / "trials" / "trial-0005" / "evaluations.json"
    recorded = [entry["return_mean"] for entry in json.loads(evaluations.read_text())]
    assert last.intermediate_values == {1: recorded[0]}


def test_a_trial_that_diverges_counts_as_the_worst(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverge(*_: Any, **__: Any) -> None:
        raise DivergenceError("loc is nan")

    monkeypatch.setattr(trials_module, "train", diverge)
    out = tmp_path / "study"
    with pytest.raises(RunError, match="no trial finished"):
        tune(CONFIG, out, trials=2, engine=LocalEngine(1), command="mbn tune a2c")
    assert [row["state"] for row in table(out)] == ["diverged"] * 2
    study = open_study(out)
    assert study.get_trials()[0].state is TrialState.PRUNED
    # The sampler's order: of two pruned ones, the one that diverged later is worse.
    pruned = create_trial(state=TrialState.PRUNED, intermediate_values={1: -1e9})
    study.add_trial(pruned)
    broken = create_trial(
        state=TrialState.PRUNED,
        intermediate_values={9: 1e9},
        system_attrs=study.get_trials()[0].system_attrs,
    )
    study.add_trial(broken)
    better, _ = _split_trials(study, study.get_trials(), n_below=1)
    assert [trial.number for trial in better] == [2]


def test_any_other_error_ends_the_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    error: ValueError
    for error in (RunError("the disk is full"), ValueError("the disk is full")):

        def fail(*_: Any, error: ValueError = error, **__: Any) -> None:
            raise error

        monkeypatch.setattr(trials_module, "train", fail)
        out = tmp_path / type(error).__name__
        with pytest.raises(type(error), match="the disk is full"):
            tune(CONFIG, out, trials=2, engine=LocalEngine(1), command="mbn tune a2c")


def test_wrong_options_are_refused_by_place(tmp_path: Path, refusal: Refusal) -> None:
    for words, place in (
        ("sac", "sac: "),
        ("ippo", "ippo"),
        ("ppo --field field_00", "field_00"),
        ("ppo --steps 0", "steps: "),
        ("ppo --num-envs 0", "num_envs: "),
        ("ppo --trials 0", "trials: "),
        ("ppo --processes 0", "processes: "),
        ("ppo --resume", "is not the folder of a study"),
        ("ppo --resume --force", "force and resume: "),
    ):
        assert place in refusal(["tune", *words.split()]), words
    assert not list(tmp_path.iterdir())


def test_a_study_is_neither_overwritten_nor_changed(study: Path) -> None:
    with pytest.raises(RunError, match=str(study)):
        tune(CONFIG, study, trials=1, engine=LocalEngine(1), command="")
    other = TuneConfig("a2c", "field_03", 34, 20, 20, 1, 1)
    with pytest.raises(ConfigError, match="seed: "):
        tune(other, study, trials=2, engine=LocalEngine(1), command="", resume=True)
    assert len(open_study(study).get_trials()) == 1
