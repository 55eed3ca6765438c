"""A run: it is resumed as if nothing had happened, logged, and learns."""

import resource
import subprocess
import sys
import time
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from baselines.algorithms import ALGORITHMS
from baselines.cli import main
from baselines.compare.records import RunRecord
from baselines.evaluation.evaluate import EVALUATION_SEED, Evaluation, evaluate
from baselines.evaluation.intervals import passes
from baselines.policies.load import load_trained
from baselines.runs.files import RunError, read_json
from baselines.runs.folder import RunFolder
from baselines.training import run_logger as recorder
from baselines.training.aids import RoiCurriculum
from baselines.training.config import TrainConfig
from baselines.training.run_logger import Report
from baselines.training.train import notes, prepare, train
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, load_field, save_field
from tests.support.pages import MBN
from tests.support.problems import places_of
from tests.support.runs import SHORT, STAGES, interrupted, recorded, same_policies, small_config

pytestmark = pytest.mark.slow

FAMILIES = ("ppo", "ars", "tqc", "crossq", "mappo", "ppo-shared")
"""An algorithm of each kind, CrossQ for raw observations; the others share their trainers."""
SMALL = small_config("ppo")


def assert_equal(run: RunFolder, other: RunFolder) -> None:
    assert recorded(run) == recorded(other)
    assert same_policies(run, other)


@pytest.mark.parametrize(
    "name",
    [*FAMILIES, *(pytest.param(k, marks=pytest.mark.all) for k in ALGORITHMS if k not in FAMILIES)],
)
def test_a_resumed_run_equals_an_uninterrupted_one(name, tmp_path, tiny_runs):
    config, stopped = small_config(name), tiny_runs.stopped(name, tmp_path / "run")
    torch.manual_seed(99)
    np.random.seed(99)
    resumed = train(config, stopped.path, resume=True)
    (history,) = read_json(resumed.path / "resumed.json")
    assert 0 < history["env_steps"] < config.steps
    assert_equal(resumed, tiny_runs.finished(name))
    budget = ALGORITHMS[name].trainer.budget(*prepare(config))
    least = budget.env_steps if budget.exact else config.steps
    assert least <= resumed.evaluation["env_steps"] <= budget.env_steps
    if STAGES.items() <= config.hyperparameters.items():
        sizes = [float(row["roi_radius"]) for row in recorded(resumed)["rows"]]
        assert sizes[0] > sizes[-1]  # they may grow in between
    assert not (resumed.path / "checkpoints").exists()
    # Two event files of one second have no order, so that a purge could drop what counts.
    folder = str(resumed.path / "tensorboard")
    events = EventAccumulator(folder, purge_orphaned_data=False).Reload()
    shown = {event.step: event.value for event in events.Scalars("evaluation/return_mean")}
    evaluated = {entry["env_steps"]: entry["return_mean"] for entry in resumed.evaluations}
    assert shown == pytest.approx(evaluated)
    assert name != "tqc" or "train/critic_loss" in events.Tags()["scalars"]


def test_killed_process_is_resumed(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    words = "train ppo-shared field_03 --episodes 2 --steps 4000 --evaluate-every 500 --num-envs 2 "
    words += "--set roi_radius=20.0 episode_steps=50 model.n_steps=32 "
    arguments = [*f"{words} model.batch_size=64 --out".split()]
    assert main([*arguments, str(whole)]) == 0
    command = [*MBN, *arguments, str(killed)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 600.0
    while not list(killed.glob("checkpoints/[0-9]*")) and time.monotonic() < deadline:
        assert process.poll() is None, "the run ended before it could be interrupted"
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert RunFolder.open(killed).unfinished is not None
    assert main([*arguments, str(killed), "--resume"]) == 0
    assert_equal(RunFolder.open(killed), RunFolder.open(whole))
    assert read_json(killed / "resumed.json")[0]["command"].endswith("--resume")
    assert not list(killed.glob(".*"))


def test_a_run_killed_before_its_first_checkpoint_begins_again(tmp_path, tiny_runs):
    out = tmp_path / "run"
    with pytest.raises(InterruptedError):
        train(SMALL, out, listener=MagicMock(side_effect=InterruptedError))
    (out / ".policy.abc").mkdir()
    assert (out / "progress.csv").exists() and not (out / "checkpoints").exists()
    for name in ("field.yaml", "versions.json"):
        (out / name).unlink()
    assert_equal(train(SMALL, out, resume=True), tiny_runs.finished("ppo"))
    assert RunFolder.open(out).field == load_field("field_03") and (out / "versions.json").exists()
    assert not list(out.glob(".*"))


def test_slow_training_is_saved_between_evaluations(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(recorder, "ROW_STEPS", 64)
    stopped = interrupted(replace(SMALL, evaluate_every=100_000), tmp_path / "run")
    assert stopped.checkpoint is not None and int(stopped.checkpoint.name) == 64
    assert stopped.evaluations == []


def test_a_policy_can_be_looked_at_before_the_run_is_finished(tmp_path, tiny_runs, capsys):
    stopped = tiny_runs.stopped("mappo", tmp_path / "run")
    load_trained(stopped)
    assert stopped.unfinished and "of 400 env-steps" in stopped.unfinished
    assert main(["evaluate", str(stopped.path), "--episodes", "1"]) == 0
    assert stopped.unfinished in capsys.readouterr().out
    with pytest.raises(RunError):
        _ = stopped.evaluation


def test_interrupted_run_says_where_it_can_be_resumed_and_gives_threads_back(tmp_path, monkeypatch):
    threads = [3]
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads[-1])
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    with pytest.raises(KeyboardInterrupt, match=rf"{tmp_path}.*--resume"):
        train(SMALL, tmp_path / "run", listener=MagicMock(side_effect=KeyboardInterrupt))
    assert threads == [3, 1, 3]


def test_only_the_same_run_can_be_resumed(tmp_path, tiny_runs):
    stopped = tiny_runs.stopped("ppo", tmp_path / "run")
    before = stopped.progress.read_bytes()
    other = replace(SMALL, seed=5, steps=500)
    assert places_of(ConfigError, train, other, stopped.path, resume=True) == ["seed", "steps"]
    with pytest.raises(RunError):
        train(SMALL, tmp_path / "nothing", resume=True)
    save_field(load_field("field_04"), stopped.path / "field.yaml")
    with pytest.raises(ConfigError, match="field"):
        train(SMALL, stopped.path, resume=True)
    assert stopped.progress.read_bytes() == before and stopped.checkpoint is not None


@pytest.mark.parametrize("name", ["mappo", "ppo"])
def test_a_full_disk_leaves_the_checkpoint_before(name, tmp_path, tiny_runs):
    run = tiny_runs.stopped(name, tmp_path / "run")
    kept = run.checkpoint
    before = {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in (0, 300, 3_000):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
        try:
            with pytest.raises(RunError, match=str(run.path)):
                train(small_config(name), run.path, resume=True)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert run.checkpoint == kept
        assert {path: path.read_bytes() for path in kept.rglob("*") if path.is_file()} == before
    assert_equal(train(small_config(name), run.path, resume=True), tiny_runs.finished(name))
    assert not list(run.path.glob(".*"))


def test_resumed_run_is_logged_to_the_same_one(tmp_path, monkeypatch):
    config, out, wandb = small_config("ppo"), tmp_path / "run", MagicMock()
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    logging = wandb.init.return_value
    interrupted(config, out, wandb="robots")
    assert not logging.finish.called
    first_logged = list(logging.log.call_args_list)
    run = train(config, out, wandb="robots", resume=True)
    assert logging.finish.called
    logged = logging.log.call_args_list[len(first_logged) :]
    for calls in (first_logged, logged):
        steps = [one.kwargs["step"] for one in calls]
        assert steps and steps == sorted(steps)
    first, second = (one.kwargs for one in wandb.init.call_args_list)
    assert (first["project"], first["name"], first["config"]) == ("robots", config.name, run.config)
    assert first["id"] == second["id"] == read_json(out / "wandb.json")["id"]
    assert second["resume"] == "allow"
    values = {name: value for one in logged for name, value in one.args[0].items()}
    assert values["evaluation/return_mean"] == run.evaluations[-1]["return_mean"]


@pytest.mark.parametrize("command", ["train ippo field_03", "compare"])
def test_without_the_package_nothing_is_begun(command, monkeypatch, tmp_path, refusal):
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert "wandb: " in refusal([*command.split(), "--wandb", "robots", "--out", "out"])
    assert not (tmp_path / "out").exists()


EASY = Field([(0, 0), (100, 0), (100, 100), (0, 100)], rois=[(50, 50)], starts=[(30, 50)])


def train_on(field: Field, algorithm: str, out: Path, **how: Any) -> RunFolder:
    out.mkdir()
    save_field(field, out / "field.yaml")
    return train(TrainConfig(algorithm, str(out / "field.yaml"), **how), out / "run")


@pytest.mark.parametrize(
    ("algorithm", "steps"),
    [("ppo", 131_072), ("ars", 65_536), ("tqc", 4096), ("mappo", 131_072), ("ppo-shared", 196_608)],
)
def test_easy_field_is_solved(algorithm, steps, tmp_path):
    how = {"steps": steps, "episodes": 20, "environment": {"max_steps": 100}}
    run = train_on(EASY, algorithm, tmp_path / "easy", evaluate_every=steps // 4, **how)
    final = run.evaluation
    assert passes(*(final[kind]["success_rate"] for kind in ("stochastic", "deterministic")))
    assert run.finished and not (run.path / "checkpoints").exists()
    single_mdp = "A" in ALGORITHMS[algorithm].settings
    assert load_trained(run).observes == ("state" if single_mdp else "observations")


TINY = Field(
    [(0, 0), (160, 0), (160, 100), (0, 100)], rois=[(70, 50)], starts=[(20, 50), (140, 50)]
)
# Full thrust covers t (t + 1) / 4 units in t steps; robot 0 needs 40 (50 less the ROI's radius):
# 45.5 at t = 13, and robot 1 needs 60. Two robots pay 10 a step each.
OPTIMUM = 110_000.0 - 2 * 10 * 13


@pytest.mark.all
@pytest.mark.parametrize("algorithm", ALGORITHMS.keys() - {"crossq", "crossq-sbx", "tqc"})
def test_field_of_two_robots_is_solved_to_the_optimum(algorithm, tmp_path):
    how = {"steps": 196_608, "evaluate_every": 98_304, "episodes": 50}
    run = train_on(TINY, algorithm, tmp_path / "tiny", environment={"max_steps": 200}, **how)
    sampled, mean = run.evaluation["stochastic"], run.evaluation["deterministic"]
    assert sampled["success_rate"] == 1.0
    assert 0.99 * OPTIMUM < sampled["return_mean"] <= OPTIMUM
    assert 0.999 * OPTIMUM < mean["return_mean"] <= OPTIMUM


@pytest.fixture
def small_learners(monkeypatch):
    monkeypatch.setattr(recorder, "ROW_STEPS", 1)
    for module in ("train", "run_logger"):
        monkeypatch.setattr(f"baselines.training.{module}.LEAST_STEPS", 128)


@pytest.fixture
def perfect(monkeypatch):
    def succeeding(*policy_and_place: Any, **how: Any) -> Evaluation:
        found = evaluate(*policy_and_place, **how)
        return replace(found, successes=[True] * len(found.returns))

    monkeypatch.setattr(recorder, "evaluate", succeeding)


@pytest.fixture
def begun(monkeypatch):
    """The learners that have begun."""
    begin, learners = recorder.Recorder.begin, list[Any]()
    monkeypatch.setattr(recorder.Recorder, "begin", lambda *of: (learners.append(of), begin(*of)))
    return learners


@pytest.mark.usefixtures("small_learners", "perfect")
@pytest.mark.parametrize("name", ["trpo", "mappo"])
def test_a_run_of_two_learners_resumes_in_the_second(name, tmp_path, monkeypatch, begun):
    config = small_config(name)
    config = replace(config, hyperparameters={**config.hyperparameters, "learners": 2})
    whole = train(config, tmp_path / "whole")
    steps = [int(entry["env_steps"]) for entry in whole.evaluations]
    half, taken = steps[1], whole.evaluation["env_steps"]
    assert half < 400 <= taken == steps[-1] < 2 * half and steps == sorted(set(steps))

    interrupted(config, tmp_path / "run", after=half)
    assert_equal(train(config, tmp_path / "run", resume=True), whole)
    assert notes(config)[-1].endswith("takes up to 512 env-steps, not 400")
    # Without a perfect policy the first learner takes all, unless its curriculum has not begun.
    monkeypatch.setattr(recorder, "evaluate", evaluate)
    for shrinking, count in ((True, 1), (False, 2)):
        monkeypatch.setattr(RoiCurriculum, "begun", shrinking)
        begun.clear()
        train(config, tmp_path / f"{shrinking}")
        assert len(begun) == count


@pytest.mark.usefixtures("small_learners", "perfect")
def test_each_learner_takes_its_part_and_no_step_more(tmp_path, monkeypatch, begun):
    monkeypatch.setattr("baselines.sb3.trainer.ROW_STEPS", 1)  # each update is logged
    falling = {"clip_range": {"from": 0.4, "to": 0.0}, "learning_rate": {"from": 0.004, "to": 0.0}}
    models = {"ppo": {**SHORT, **falling}, "ars": {"n_delta": 1, "n_top": 1}}
    for name, worlds, steps in (("ppo", 2, 384), ("ars", 1, 900)):
        config = replace(small_config(name), steps=steps)
        changes = {"num_envs": worlds, "model": models[name], "learners": 2}
        run = train(replace(config, hyperparameters=changes), tmp_path / name)
        assert len(begun) == 2
        begun.clear()
        if name == "ppo":
            assert [entry["env_steps"] for entry in run.evaluations] == [192, 320, 384]
            events = EventAccumulator(str(run.path / "tensorboard")).Reload()
            rates, clips = map(events.Scalars, ("train/learning_rate", "train/clip_range"))
            assert [100 * one.value for one in rates] == pytest.approx([one.value for one in clips])


@pytest.mark.usefixtures("small_learners")
def test_the_last_policy_of_each_learner_is_measured_with_its_gain(tmp_path, monkeypatch):
    seen = []

    def perfect(policy: Any, *place: Any, **how: Any) -> Evaluation:
        if not how["deterministic"]:
            seen.append({name: one.clone() for name, one in policy.network.state_dict().items()})
        found = evaluate(policy, *place, **how)
        won = how["seed"] - EVALUATION_SEED >= 4  # after the first learner's half of the budget
        return replace(found, successes=[won] * len(found.returns))

    monkeypatch.setattr(recorder, "evaluate", perfect)
    config = small_config("mappo")
    more = {**config.hyperparameters, "roi_radius": 1.0, "scattered": 0.0}
    more |= {"learners": 2, "final_gain": 3.0}
    asked = replace(config, evaluate_every=64, hyperparameters=more)
    run = train(asked, tmp_path / "run")
    steps = [entry["env_steps"] for entry in run.evaluations]
    assert steps[:5] == [64, 128, 192, 256, 320]
    RunRecord.read(run, finished=True)
    before, after = seen[3:5]
    changed = [name for name in before if not torch.equal(before[name], after[name])]
    assert len(changed) == 2  # weights and biases of the last layer
    for name in changed:
        torch.testing.assert_close(after[name], 3.0 * before[name])


@pytest.mark.parametrize("best", [1, 2, 3])
def test_the_best_policy_on_the_way_is_kept_and_measured_again(best, tmp_path, monkeypatch):
    seen = {}

    def made_up(policy: Any, *place: Any, **how: Any) -> Evaluation:
        found = evaluate(policy, *place, **how)
        number = how["seed"] - EVALUATION_SEED
        seen[number] = {name: one.clone() for name, one in policy.network.state_dict().items()}
        return replace(found, successes=[number == best] * len(found.returns))

    monkeypatch.setattr(recorder, "evaluate", made_up)
    config = small_config("mappo")
    interrupted(config, tmp_path / "run")
    run = train(config, tmp_path / "run", resume=True)
    final, steps = run.evaluation, [entry["env_steps"] for entry in run.evaluations]
    assert len(steps) == 3 and final["policy_env_steps"] == steps[best - 1]
    assert final["stochastic"]["episodes"] == 20 and final["stochastic"]["seed"] == EVALUATION_SEED
    kept = load_trained(run)
    assert all(
        torch.equal(one, seen[best][name]) for name, one in kept.network.state_dict().items()
    )
    others = (seen[number] for number in (1, 2, 3) if number != best)
    assert not any(torch.equal(seen[best]["log_std"], one["log_std"]) for one in others)


def test_a_bar_of_progress_is_that_of_its_run(monkeypatch):
    screen = Console(width=80, force_terminal=True, file=StringIO())
    monkeypatch.setattr(recorder, "console", lambda: screen)
    runs = [replace(SMALL, steps=steps, label=f"{steps}") for steps in (100, 200)]
    with recorder.progress_bars(runs) as show:
        show(Report(runs[1].name, 100))
    assert " 50%" in screen.file.getvalue() and "100%" not in screen.file.getvalue()
