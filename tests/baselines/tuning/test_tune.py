"""Tuning: from the command line, interrupted, by several processes, pruned, diverged."""

import csv
import json
import shutil
from pathlib import Path
from unittest.mock import Mock

import optuna
import pytest
import yaml
from filelock import FileLock
from optuna.distributions import FloatDistribution
from optuna.trial import TrialState, create_trial

from baselines.algorithms import find_algorithm
from baselines.cli import main
from baselines.paper import published
from baselines.runs.files import RunError
from baselines.sweep.processes import LocalEngine
from baselines.training.config import DivergenceError, TrainConfig
from baselines.tuning import tune as tuning
from baselines.tuning.tune import TrialJob, begin_study, load_study, run_trial, search_space, tune
from mbn_marl.errors import ConfigError

pytestmark = pytest.mark.slow

TINY = ("--field", "field_03", "--steps", "20", "--evaluate-every", "20", "--episodes", "1")
CONFIG = TrainConfig("a2c", "field_03", "A", 33, 20, 20, 1, num_envs=1)


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "trials.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    out = tmp_path_factory.mktemp("studies") / "study"
    assert main(["tune", "a2c", *TINY, "--trials", "1", "--out", str(out)]) == 0
    return out


def test_the_paper_and_the_library_decide_what_is_tuned():
    spaces = {name: search_space(name) for name in published.ALGORITHMS}
    on_policy = {"gamma", "gae_lambda", "learning_rate"}
    losses = {"vf_coef", "ent_coef", "max_grad_norm"}
    assert {name: space.keys() for name, space in spaces.items()} == {
        "a2c": on_policy | losses,
        "ppo": on_policy | losses,
        "trpo": on_policy,
        "ars": {"learning_rate"},
        "crossq": {"gamma", "learning_rate", "ent_coef", "buffer_size"},
        "tqc": {"gamma", "learning_rate", "buffer_size"},
    }
    assert spaces["tqc"]["learning_rate"] == (1e-4, 5e-2)
    assert spaces["tqc"]["buffer_size"] == (1000, 100_000)
    trial = optuna.create_study().ask()
    assert isinstance(tuning.suggest(trial, "crossq")["buffer_size"], int)
    rate = trial.distributions["learning_rate"]
    assert isinstance(rate, FloatDistribution) and rate.log
    assert not getattr(trial.distributions["gamma"], "log", True)


def test_tune_writes_what_setting_b_reads(study, tmp_path, refusal):
    (row,) = table(study)
    assert (row["number"], row["state"]) == ("0", "COMPLETE")
    values = {name: float(row[f"params_{name}"]) for name in search_space("a2c")}
    block = yaml.safe_load((study / "a2c.yaml").read_text())["B"]
    assert block["model"] == values
    run = study / "trials" / "trial-0000"
    config = json.loads((run / "config.json").read_text())
    assert config["hyperparameters"]["model"] == values
    assert (run / "command.txt").read_text().startswith("mbn tune a2c --field field_03")
    final = json.loads((run / "evaluation.json").read_text())
    assert float(row["value"]) == final["stochastic"]["return_mean"]
    assert f"return of {final['stochastic']['episodes']} fresh episodes" in block["source"]
    read = find_algorithm("a2c").resolve({}, setting="B", file=study / "a2c.yaml")
    assert read.model == values
    # A report copies the figure, and does not take the trials for runs of a setting.
    words = ["report", "--paper", str(study), "-o", str(tmp_path / "out")]
    for words[2] in (str(study), str(run)):
        assert words[2] in refusal(words)
    words[2] = str(shutil.copytree(run, tmp_path / "plain"))
    del config["hyperparameters"]
    (tmp_path / "plain" / "config.json").write_text(json.dumps(config))
    assert main([*words, "--study", str(study)]) == 0
    page = (tmp_path / "out" / "paper.md").read_text()
    assert "](study/history.png)" in page
    best = " | ".join(f"{values[name]:.4g}" for name in published.RANGES if name in values)
    assert f"|  | here | {best} | 1 | {CONFIG.steps:,} | 0 | {float(row['value']):,.0f} |" in page
    same = str(tmp_path / "out" / "study")
    assert "another study has this name" in refusal(
        [*words, "--force", "--study", str(study), same]
    )


def test_resume_keeps_finished_trials_and_replaces_an_interrupted_one(tmp_path):
    out = tmp_path / "study"
    words = ["tune", "a2c", *TINY, "--seed", str(2**32 - 1), "--out", str(out)]  # the largest
    assert main([*words, "--trials", "1"]) == 0
    first = table(out)
    load_study(out).ask()  # as if the process had been killed during trial 1
    with (out / "study.log").open("ab") as journal:
        journal.write(b'{"op_code": 4, "worker')  # and while it wrote
    assert main([*words, "--trials", "2", "--resume"]) == 0
    rows = table(out)
    assert [row["state"] for row in rows] == ["COMPLETE", "FAIL", "COMPLETE"]
    assert rows[0] == first[0]
    assert rows[2]["params_learning_rate"] != first[0]["params_learning_rate"]
    before = load_study(out).get_trials()
    assert main([*words, "--trials", "2", "--resume"]) == 0, "nothing is left to do"
    assert load_study(out).get_trials() == before


def test_a_study_is_neither_shared_overwritten_nor_changed(study, refusal):
    with FileLock(study / ".lock"):
        words = ["tune", "a2c", *TINY, "--trials", "5", "--resume", "--out", str(study)]
        assert "another mbn tune" in refusal(words)
    with pytest.raises(RunError, match=str(study)):
        tune(CONFIG, study, trials=1, engine=LocalEngine(1), command="")
    other = TrainConfig("a2c", "field_03", "A", 34, 20, 20, 1, num_envs=1)
    with pytest.raises(ConfigError, match="seed: "):
        tune(other, study, trials=2, engine=LocalEngine(1), command="", resume=True)
    assert len(load_study(study).get_trials()) == 1


def test_a_damaged_journal_is_named(tmp_path):
    begin_study(tmp_path)
    journal = tmp_path / "study.log"
    whole = journal.read_bytes()
    for damaged in (b"", b"[1]\n", b'{"op_code": 0}\n', b"\xff\n" + whole, whole[5:]):
        journal.write_bytes(damaged)
        with pytest.raises(RunError, match=r"study\.log"):
            load_study(tmp_path)
    journal.write_bytes(whole)
    (tmp_path / "trials" / "trial-0000").mkdir(parents=True)
    with pytest.raises(RunError, match=r"study\.log"):
        load_study(tmp_path)


def test_a_trial_below_the_median_is_pruned(tmp_path):
    begin_study(tmp_path)
    for _ in range(5):
        better = create_trial(value=1e6, intermediate_values={1: 1e6, 2: 1e6})
        load_study(tmp_path).add_trial(better)
    config = TrainConfig("a2c", "field_03", "A", 33, 3000, 1000, 1, num_envs=1)
    last = run_trial(TrialJob(config, tmp_path, "mbn tune a2c"), print)
    assert last.state is TrialState.PRUNED
    evaluations = tmp_path / "trials" / "trial-0005" / "evaluations.json"
    (recorded,) = json.loads(evaluations.read_text())
    assert last.intermediate_values == {1: recorded["return_mean"]}
    assert 1000 <= recorded["env_steps"] < 2000


def test_a_trial_that_diverges_counts_as_the_worst(tmp_path, monkeypatch):
    monkeypatch.setattr(tuning, "train", Mock(side_effect=DivergenceError("loc is nan")))
    out = tmp_path / "study"
    with pytest.raises(RunError, match="no trial finished"):
        tune(CONFIG, out, trials=2, engine=LocalEngine(1), command="mbn tune a2c")
    assert [row["user_attrs_diverged"] for row in table(out)] == ["loc is nan"] * 2
    for trial in load_study(out).get_trials():
        assert trial.state is TrialState.PRUNED and trial.constraints == {"diverged": 1.0}
