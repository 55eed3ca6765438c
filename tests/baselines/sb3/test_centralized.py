"""The six centralised algorithms: every setting, their hyperparameters, and what is special."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from baselines.algorithms import ALGORITHMS
from baselines.cli import main
from baselines.evaluation.policy import load_trained
from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.runs.tensors import moments_of
from baselines.sb3.ars import PopulationSearch
from baselines.sb3.config import TUNED_IN_PAPER, accepted_arguments, load
from baselines.sb3.envs import LearnersView, make_env
from baselines.sb3.learner import Learner
from baselines.training.config import Task, TrainConfig
from baselines.training.run_logger import EpisodeWindow
from baselines.training.train import notes, train
from mbn_marl.adapters.sb3 import CentralizedVecEnv
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, load_field, save_field
from tests.baselines.conftest import Refusal

CATALOGUE = Path(__file__).parents[3] / "envs_catalog"
NAMES = [name for name, entry in ALGORITHMS.items() if "A" in entry.settings]
PAPER: dict[str, dict[str, float]] = {
    "a2c": {"gamma": 0.974, "gae_lambda": 0.938, "learning_rate": 0.0007, "vf_coef": 0.632,
            "ent_coef": 0.0001, "max_grad_norm": 0.674},
    "ppo": {"gamma": 0.968, "gae_lambda": 0.959, "learning_rate": 0.0001, "vf_coef": 0.696,
            "ent_coef": 0.015, "max_grad_norm": 0.983},
    "trpo": {"gamma": 0.989, "gae_lambda": 0.931, "learning_rate": 0.0001},
    "ars": {"learning_rate": 0.019},
    "crossq": {"gamma": 0.953, "learning_rate": 0.0013, "ent_coef": 0.0248, "buffer_size": 95_000},
    "tqc": {"gamma": 0.901, "learning_rate": 0.0001, "buffer_size": 100_000},
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_every_setting_trains_from_the_command_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(setting: str, field: str, *options: str) -> dict[str, Any]:
        out = tmp_path / setting
        tiny = ("--steps", "105", "--episodes", "1", "--set", "environment.max_steps=50")
        command = ["train", name, field, "--setting", setting, "--out", str(out), *tiny, *options]
        assert main(command) == 0
        config: dict[str, Any] = json.loads((out / "config.json").read_text())
        with (out / "progress.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        final = json.loads((out / "evaluation.json").read_text())
        assert int(rows[-1]["env_steps"]) == final["env_steps"] >= 105
        assert (config["algorithm"], config["setting"]) == (name, setting)
        assert list((out / "tensorboard").iterdir())
        return config

    raw = run("A", "field_01")
    assert raw["seed"] == 33 and raw["transferred_from"] is None
    assert raw["hyperparameters"]["model"] == {}
    assert raw["hyperparameters"]["reward_scale"] == 1.0
    assert not raw["hyperparameters"]["normalize_observation"]
    assert raw["hyperparameters"]["num_envs"] == 1
    published = run("B", "field_03", "--num-envs", "2")
    assert published["hyperparameters"]["model"] == PAPER[name]
    assert published["hyperparameters"]["num_envs"] == 2
    capsys.readouterr()
    custom = tmp_path / "mine.yaml"
    shutil.copy(CATALOGUE / "field_04.yaml", custom)
    moved = run("C", str(custom), "--from", str(tmp_path / "A"))
    assert moved["transferred_from"] == str(tmp_path / "A")
    assert moved["hyperparameters"] == raw["hyperparameters"]
    ours = run("N", "field_03", "--num-envs", "2")
    assert ours["hyperparameters"]["normalize_observation"] and ours["seed"] == 0
    for setting, normalized in (("N", True), ("A", False)):
        shape = json.loads((tmp_path / setting / "policy" / "policy.json").read_text())
        assert (shape["normalization"] is not None) == normalized
    files = {path.suffix for path in (tmp_path / "N" / "policy").iterdir()}
    assert files == {".json", ".safetensors"}


def test_values_that_a_class_does_not_take_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = load("crossq", "B", {})
    assert config.skipped == {"gae_lambda": 0.959, "vf_coef": 0.531, "max_grad_norm": 0.6072}
    assert not config.skipped.keys() & accepted_arguments("crossq").keys()
    block = "B:\n  model: {gamma: 0.5, buffer_size: 7}\n"
    (tmp_path / "b.yaml").write_text(block)
    arguments = ["--setting", "B", "--hyperparams", str(tmp_path / "b.yaml"), "--steps", "5"]
    out = tmp_path / "run"
    command = ["train", "a2c", "field_03", *arguments, "--episodes", "1", "--out", str(out)]
    assert main(command) == 0
    assert "skipped: buffer_size = 7, since a2c has no such argument" in capsys.readouterr().out
    recorded = json.loads((out / "config.json").read_text())["hyperparameters"]
    assert (recorded["model"], recorded["skipped"]) == ({"gamma": 0.5}, {"buffer_size": 7})


@pytest.mark.parametrize("name", NAMES)
def test_what_the_paper_tuned_is_taken_or_skipped(name: str) -> None:
    values = {**dict.fromkeys(TUNED_IN_PAPER, 0.5), "buffer_size": 5}
    config = load(name, "A", {"model": values})
    assert config.model.keys() | config.skipped.keys() == set(TUNED_IN_PAPER)
    assert config.model.keys() <= accepted_arguments(name).keys()
    with pytest.raises(ConfigError, match=r"model\.momentum: unknown name; known: "):
        load(name, "A", {"model": {"momentum": 0.5}})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("A: {}\n", "N: unknown block; known: A"),
        ("N: [1, 2]\n", "must be a mapping from names of blocks to mappings"),
        ("N: {num_envs: 0}\n", "num_envs: Input should be greater than or equal to 1"),
        ("N: {worlds: 1}\n", "worlds: unknown name; known: source, environment, skipped, reward"),
        ("N: {model: {tau: 0.1}}\n", r"model.tau: unknown name; known: batch_size"),
        ("N: {model: 3}\n", "model: Input should be a valid dictionary"),
        (
            "N: {model: {gamma: 2}}\n",
            "model.gamma: must be a finite number, at least 0 and at most 1",
        ),
        ("N: {model: {gae_lambda: .nan}}\n", "model.gae_lambda: must be a finite number"),
        (
            "N: {model: {policy_kwargs: {log_std_init: .inf}}}\n",
            "model.policy_kwargs: must hold finite numbers only",
        ),
        (
            "N: {model: {n_steps: 0}}\n",
            "model.n_steps: must be a finite number, at least 1 (got 0)",
        ),
        (
            "N: {model: {n_steps: 2.5}}\n",
            "model.n_steps: Input should be a valid integer (got 2.5)",
        ),
        ("N: {model: {ent_coef: auto}}\n", "model.ent_coef: Input should be a valid number"),
        (
            "N: {model: {learning_rate: fast}}\n",
            "Input should be a valid number or {from: number, to: number} (got 'fast')",
        ),
        (
            "N: {model: {learning_rate: {from: 1.0, to: -1.0}}}\n",
            "must be a finite number, at least 0",
        ),
        ("N: {policy: Mlp}\n", "no learner can be made with them: Policy Mlp unknown"),
        ("N: {model: {n_steps: 1}}\n", "no learner can be made with them: `n_steps * n_envs`"),
        ("N: {model: {policy_kwargs: {depth: 3}}}\n", "unexpected keyword argument 'depth'"),
        ("N: {model: {policy_kwargs: {net_arch: [-1]}}}\n", "no learner can be made with them: "),
        ("N: {environment: {gravity: 9.81}}\n", "gravity: unknown name; known: n_robots"),
        ("N: {\n", "mine.yaml: line 2, column 1: "),
    ],
)
def test_a_wrong_hyperparameter_file_is_one_clear_message(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "mine.yaml", tmp_path / "run"
    path.write_text(text)
    arguments = ["train", "ppo", "field_03", "--hyperparams", str(path), "--out", str(out)]
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error
    assert not out.exists()


def _task(name: str, field: str = "field_03", **changes: Any) -> Task:
    config = TrainConfig(name, field, seed=3, steps=100, episodes=1, **changes)
    return Task(config, load_field(field), {"max_steps": 20, **config.environment})


def test_the_learner_sees_scaled_rewards_and_the_window_true_returns() -> None:
    window = EpisodeWindow()
    worlds = CentralizedVecEnv("field_03", 3, threads=1, max_steps=2)
    view = LearnersView(worlds, 0.5, window)
    view.reset()
    view.watched[1] = False
    still = np.zeros((3, 3, 2), np.float32)
    rewards = [view.step(still)[1].tolist() for _ in range(2)]
    # Two of the three robots start in an ROI: 2 x 10,000 - 3 x 10, then 3 x 100 for standing still.
    assert rewards == [[9985.0] * 3, [-150.0] * 3]
    row = window.pop()
    assert (row["episodes"], row["return_mean"], row["return_std"]) == (2, 19_670.0, 0.0)


@pytest.mark.parametrize("policy", ["LinearPolicy", "MlpPolicy"])
def test_candidates_side_by_side_return_what_they_return_alone(policy: str) -> None:
    returns, steps = [], []
    for num_envs in (1, 3):
        window = EpisodeWindow()
        env = make_env(_task("ars"), load("ars", "A", {}, num_envs=num_envs), window)
        model = PopulationSearch(policy, env, n_delta=2, seed=0, zero_policy=False)
        generator = torch.Generator().manual_seed(1)
        candidates = torch.randn((4, model.n_params), generator=generator) * 0.01
        _, callback = model._setup_learn(100)
        returns.append(model.evaluate_candidates(candidates, callback, None).tolist())
        steps.append(model.num_timesteps)
        assert window.pop()["episodes"] == 4
    assert returns[0] == returns[1]
    assert len(set(returns[0])) > 1
    assert steps[0] == steps[1]


@pytest.mark.parametrize("name", NAMES)
def test_a_transferred_learner_begins_with_the_sources_policy(name: str, tmp_path: Path) -> None:
    small = {"num_envs": 1, "environment": {"max_steps": 20}}
    if name in ("ppo", "trpo"):
        small["model"] = {"n_steps": 64, "batch_size": 64}
    if name in ("crossq", "tqc"):
        small["model"] = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8}
    config = TrainConfig(name, "field_01", "A", steps=120, episodes=1, hyperparameters=small)
    run = train(config, tmp_path / "source")
    task = _task(name, "field_02", setting="C", transferred_from=run.path)
    hyperparameters = load(name, "C", small)
    learner = Learner(task, hyperparameters, EpisodeWindow())
    learner.begin_with(run)
    model = learner.model
    policy: Any = load_trained(run)
    ours, theirs = model.policy.state_dict(), policy.network.state_dict()
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)
    assert (model.num_timesteps, learner.env_steps) == (0, 0)
    if name == "ars":
        parameters = torch.nn.utils.parameters_to_vector(policy.network.parameters())
        assert torch.equal(model.weights, parameters)
        assert model.weights.abs().max() > 0
    else:
        moments = [
            tensor
            for part, state in model.get_parameters().items()
            if part.endswith("optimizer")
            for tensor in moments_of(state).values()
        ]
        assert any(moment.abs().max() > 0 for moment in moments)
    model.learn(30)
    assert model.num_timesteps >= 30


def test_transfer_goes_from_one_field_to_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "runs"
    custom = tmp_path / "mine.yaml"
    shutil.copy(CATALOGUE / "field_07.yaml", custom)
    tiny = ["--steps", "20", "--episodes", "1", "--out", str(out)]
    command = ["transfer", "a2c", "--fields", "field_02", str(custom), *tiny]
    assert main(command) == 0
    names = sorted(path.name for path in out.iterdir())
    assert names == ["a2c-A-field_01-seed33", "a2c-C-field_02-seed33", "a2c-C-mine-seed33"]
    moved = RunFolder.open(out / "a2c-C-mine-seed33")
    assert moved.config["transferred_from"] == str(out / "a2c-A-field_01-seed33")
    assert moved.field == load_field(custom)
    printed = capsys.readouterr().out
    assert f"from: {out / names[0]}, 20 env-steps" in printed
    before = (out / names[0] / "evaluation.json").stat().st_mtime_ns
    assert main(command) == 2
    assert "already exists" in capsys.readouterr().err
    shutil.rmtree(out / "a2c-C-field_02-seed33")
    assert main([*command, "--resume"]) == 0
    assert (out / "a2c-C-field_02-seed33" / "evaluation.json").is_file()
    assert (out / names[0] / "evaluation.json").stat().st_mtime_ns == before
    command[command.index("20")] = "25"
    command[command.index("field_02")] = "field_03"
    command.remove(str(custom))
    assert main([*command, "--source-steps", "25"]) == 2
    assert "a budget of 20 env-steps, not 25" in capsys.readouterr().err
    assert not (out / "a2c-C-field_03-seed33").exists()
    assert main(command) == 0
    assert f"from: {out / names[0]}, 20 env-steps" in capsys.readouterr().out


def test_targets_are_looked_at_before_the_source_is_trained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a2c-C-field_02-seed33").mkdir()
    command = ["transfer", "a2c", "--fields", "field_02", "--steps", "5", "--out", str(tmp_path)]
    assert main(command) == 2
    assert "a2c-C-field_02-seed33 already exists" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a2c-C-field_02-seed33"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["transfer", "ippo"], "settings: ippo has N"),
        (["transfer", "ppo", "--fields", "field_01"], "the field that the policy comes from"),
        (["transfer", "ppo", "--fields", "field_02", "field_02"], "fields: field_02 given twice"),
        (["transfer", "ppo", "--fields", "two.yaml"], "two.yaml: robots 2; allowed: 3"),
        (["transfer", "ppo", "--fields", "field_99"], "field_99"),
        (["transfer", "ppo", "--processes", "0"], "processes: "),
        (["transfer", "ppo", "--source-steps", "0"], "source_steps: "),
        (["train", "ppo", "field_02", "--seed", str(2**32)], "seed: must be at most 2^32 - 1"),
        (["train", "ppo", "field_02", "--setting", "C"], "--from"),
        (["train", "ppo", "field_02", "--setting", "C", "--from", "x"], "x is not a run folder"),
        (["train", "ppo", "field_02", "--from", "x"], "from: "),
        (["train", "mappo", "field_02", "--setting", "B"], "setting: mappo has N, not B"),
        (["train", "ppo", "field_02", "--num-envs", "0"], "num_envs: must be at least 1"),
        (["train", "ppo", "field_02", "--stop-at", "inf"], "stop_at: must be finite (got inf)"),
        (["train", "mappo", "field_02", "--set", "entropy=NaN"], "entropy: Input should be a fini"),
        (["train", "ppo", "field_02", "--hyperparams", "x.yaml"], "x.yaml: "),
        (["train", "ppo", "field_02", "--resume", "--force"], "force and resume"),
        (["train", "ppo", "field_02", "--resume", "--out", "x"], "x is not a run folder"),
    ],
)
def test_wrong_input_is_one_clear_message(
    arguments: list[str], message: str, tmp_path: Path, refusal: Refusal
) -> None:
    whole = load_field("field_02")
    two = Field(vertices=whole.vertices, rois=whole.rois, starts=whole.starts[:2])
    save_field(two, tmp_path / "two.yaml")
    assert message in refusal(arguments)
    assert [path.name for path in tmp_path.iterdir()] == ["two.yaml"]


def test_only_a_policy_of_the_same_learner_is_taken_over(tmp_path: Path) -> None:
    config = TrainConfig("a2c", "field_01", "A", steps=5, episodes=1)
    run = train(config, tmp_path / "source")
    moved = TrainConfig("ppo", "field_02", "C", steps=5, episodes=1, transferred_from=run.path)
    with pytest.raises(ConfigError, match="algorithm: the policy's run has a2c, this run ppo"):
        train(moved, tmp_path / "moved")
    moved = TrainConfig(
        "a2c",
        "field_02",
        "C",
        steps=5,
        episodes=1,
        transferred_from=run.path,
        hyperparameters={"reward_scale": 0.1},
    )
    with pytest.raises(ConfigError, match=r"hyperparameters\.reward_scale: the policy's run has"):
        train(moved, tmp_path / "moved")
    (run.path / "evaluation.json").unlink()
    with pytest.raises(ValueError, match="is not finished"):
        train(moved, tmp_path / "moved")
    assert not (tmp_path / "moved").exists()


def test_a_learner_that_diverges_is_one_clear_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    block = "A: {model: {learning_rate: 1.0e+30, max_grad_norm: 1.0e+30}}\n"
    (tmp_path / "wild.yaml").write_text(block)
    out = tmp_path / "run"
    chosen = ["--setting", "A", "--hyperparams", str(tmp_path / "wild.yaml"), "--steps", "100"]
    assert main(["train", "a2c", "field_03", *chosen, "--episodes", "1", "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"mbn: error: {out}: the learner diverged")
    assert error.count("\n") == 1
    assert not RunFolder.open(out).finished


def test_a_policy_of_an_older_version_is_refused_with_a_way_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = TrainConfig("a2c", "field_01", "A", steps=5, episodes=1)
    run = train(config, tmp_path / "run")
    for path in run.policy.iterdir():
        path.unlink()
    (run.policy / "model.zip").write_bytes(b"PK")
    assert main(["evaluate", str(run.path)]) == 2
    error = capsys.readouterr().err
    assert all(word in error for word in (str(run.policy), "model.zip", "--force", "versions.json"))
    moved = replace(config, field="field_02", setting="C", transferred_from=run.path)
    with pytest.raises(RunError, match=r"model\.zip"):
        train(moved, tmp_path / "moved")


@pytest.mark.parametrize(
    ("name", "changes", "said"),
    [
        ("ppo", {"model": {"n_steps": 32, "batch_size": 32}}, "takes 128 env-steps, not 100"),
        ("ppo", {"num_envs": 4, "model": {"n_steps": 25, "batch_size": 25}}, None),
        ("crossq", {"num_envs": 16}, "takes 112 env-steps, not 100"),
        ("ppo-shared", {"num_envs": 4, "model": {"n_steps": 16}}, "takes 128 env-steps, not 100"),
        # Four candidates, an episode of at most 20 steps each, the first of which begins at 99.
        ("ars", {"model": {"n_delta": 2, "n_top": 1}}, "takes up to 179 env-steps, not 100"),
        # Two env-steps a decision until half of the budget: 2 x 2 x 16, then 2 x 16.
        ("mappo", {"num_worlds": 2, "rollout_steps": 16, "action_repeat": [2, 1]}, "takes 128 env"),
    ],
)
def test_a_budget_that_is_rounded_up_is_said_before(
    name: str, changes: dict[str, Any], said: str | None, tmp_path: Path
) -> None:
    small = {"num_envs": 2, "policy": "MlpPolicy"} if ALGORITHMS[name].package == "sb3" else {}
    budget: dict[str, Any] = {"steps": 100, "episodes": 1, "environment": {"max_steps": 20}}
    config = TrainConfig(name, "field_03", **budget, hyperparameters={**small, **changes})
    lines = [line for line in notes(config) if line.startswith("steps: ")]
    assert [said in line for line in lines] == ([True] if said else [])
    taken = train(config, tmp_path / "run").evaluation["env_steps"]
    if said is None:
        assert taken == 100
    elif name == "ars":
        assert 100 < taken <= 179
    else:
        assert f"takes {taken} env-steps" in lines[0]
