"""The six centralised algorithms: every setting, their hyperparameters, transfer."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from baselines.algorithms import ALGORITHMS
from baselines.cli import main
from baselines.policies.load import load_trained
from baselines.runs.files import RunError, read_json
from baselines.runs.folder import RunFolder
from baselines.runs.tensors import moments_of
from baselines.sb3.config import TUNED_IN_PAPER, accepted_arguments, load
from baselines.sb3.trainer import Learner
from baselines.training.config import TrainConfig
from baselines.training.run_logger import EpisodeWindow
from baselines.training.train import notes, prepare, train
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field
from tests.support.runs import recorded

pytestmark = pytest.mark.slow

CATALOGUE = Path(__file__).parents[3] / "envs_catalog"
NAMES = [name for name, entry in ALGORITHMS.items() if "A" in entry.settings]


def test_every_setting_trains_from_the_command_line(tmp_path: Path) -> None:
    configs: dict[str, dict[str, Any]] = {}
    for setting, words in (("A", "field_01"), ("B", "field_03 --num-envs 2"), ("N", "field_03")):
        out = tmp_path / setting
        tiny = f"--steps 105 --episodes 1 --setting {setting} --out {out}".split()
        command = ["train", "a2c", *words.split(), *tiny, "--set", "environment.max_steps=50"]
        assert main(command) == 0
        run = RunFolder(out)
        configs[setting] = run.config["hyperparameters"]
        assert int(recorded(run)["rows"][-1]["env_steps"]) == run.evaluation["env_steps"] >= 105
        shape = read_json(run.policy / "policy.json")
        assert (shape["normalization"] is not None) == (setting == "N")
        assert run.config["seed"] == (0 if setting == "N" else 33)
    plain = {"model": {}, "reward_scale": 1.0, "normalize_observation": False, "num_envs": 1}
    assert configs["A"].items() >= plain.items() and configs["N"]["normalize_observation"]
    assert configs["B"]["num_envs"] == 2 and len(configs["B"]["model"]) == 6


def test_what_the_paper_tuned_is_taken_or_skipped(tmp_path: Path) -> None:
    values = {**dict.fromkeys(TUNED_IN_PAPER, 0.5), "buffer_size": 5}
    for name in NAMES:
        config = load(name, "A", {"model": values})
        assert config.model.keys() | config.skipped.keys() == set(TUNED_IN_PAPER)
        assert config.model.keys() <= accepted_arguments(name).keys()
        with pytest.raises(ConfigError, match=r"model\.momentum"):
            load(name, "A", {"model": {"momentum": 0.5}})
    skipped = load("crossq", "B", {}).skipped
    assert skipped == {"gae_lambda": 0.959, "vf_coef": 0.531, "max_grad_norm": 0.6072}
    path = tmp_path / "b.yaml"
    path.write_text("B:\n  model: {gamma: 0.5, buffer_size: 7}\n")
    config = TrainConfig("a2c", "field_03", "B", hyperparams=path)
    assert any("buffer_size = 7" in line for line in notes(config))
    found = prepare(config)[1]
    assert (found.model, found.skipped) == ({"gamma": 0.5}, {"buffer_size": 7})


def test_a_wrong_hyperparameter_file_is_refused_by_place(tmp_path: Path) -> None:
    path, out = tmp_path / "mine.yaml", tmp_path / "run"
    for text, place in (
        ("A: {}", "N: "),
        ("N: {num_envs: 0}", "num_envs: "),
        ("N: {worlds: 1}", "worlds: "),
        ("N: {model: {tau: 0.1}}", "model.tau: "),
        ("N: {model: {gae_lambda: .nan}}", "model.gae_lambda: "),
        ("N: {model: {policy_kwargs: {log_std_init: .inf}}}", "model.policy_kwargs: "),
        ("N: {model: {n_steps: 2.5}}", "model.n_steps: "),
        ("N: {model: {learning_rate: {from: 1.0, to: -1.0}}}", "model.learning_rate"),
        ("N: {policy: Mlp}", "no learner"),
        ("N: {model: {n_steps: 1}}", "no learner"),
        ("N: {model: {policy_kwargs: {depth: 3}}}", "depth"),
        ("N: {environment: {gravity: 9.81}}", "gravity: "),
        ("N: {", "mine.yaml: line 2"),
    ):
        path.write_text(f"{text}\n")
        with pytest.raises(ConfigError) as caught:
            train(TrainConfig("ppo", "field_03", hyperparams=path), out)
        assert place in str(caught.value), text
    assert not out.exists()


@pytest.mark.parametrize(
    "name", ["a2c", "ars", "tqc", pytest.param("crossq", marks=pytest.mark.all)]
)
def test_transferred_learner_begins_with_the_policy_of_its_source(
    name: str, tmp_path: Path
) -> None:
    small: dict[str, Any] = {"normalize_observation": name == "a2c"}
    if name in ("crossq", "tqc"):
        small["model"] = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8}
    how: dict[str, Any] = {"episodes": 1, "hyperparameters": small}
    how["environment"] = {"max_steps": 20}
    run = train(TrainConfig(name, "field_01", "A", steps=120, **how), tmp_path / "source")
    config = TrainConfig(name, "field_02", "C", steps=100, transferred_from=run.path, **how)
    learner = Learner(*prepare(config), EpisodeWindow())
    learner.begin_with(run.policy)
    model = learner.model
    policy: Any = load_trained(run)
    ours, theirs = model.policy.state_dict(), policy.network.state_dict()
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)
    assert (model.num_timesteps, learner.env_steps) == (0, 0)
    if name == "ars":
        parameters = torch.nn.utils.parameters_to_vector(policy.network.parameters())
        assert torch.equal(model.weights, parameters) and model.weights.abs().max() > 0
    else:
        states = [s for part, s in model.get_parameters().items() if part.endswith("optimizer")]
        moments = [moment for state in states for moment in moments_of(state).values()]
        assert any(moment.abs().max() > 0 for moment in moments)
    if name == "a2c":
        env = model.get_vec_normalize_env()
        assert env.obs_rms.count > 120
        np.testing.assert_array_equal(env.obs_rms.mean, policy.normalization.mean)
    model.learn(30)
    assert model.num_timesteps >= 30


def test_transfer_goes_from_one_field_to_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, custom = tmp_path / "runs", shutil.copy(CATALOGUE / "field_07.yaml", tmp_path)
    tiny = ["--episodes", "1", "--out", str(out), "--steps"]
    command = ["transfer", "a2c", "--fields", "field_02", str(custom), *tiny]
    taken = out / "a2c-C-field_02-seed33"
    taken.mkdir(parents=True)
    (taken / "mine").touch()
    assert main([*command, "20"]) == 2 and str(taken) in capsys.readouterr().err
    assert [*out.iterdir()] == [taken], "the targets are looked at before the source is trained"
    shutil.rmtree(taken)
    assert main([*command, "20"]) == 0
    names = sorted(path.name for path in out.iterdir())
    assert names == ["a2c-A-field_01-seed33", taken.name, "a2c-C-field_07-seed33"]
    moved = RunFolder.open(out / names[2])
    assert moved.config["transferred_from"] == str(out / names[0])
    assert moved.field == load_field(custom)
    assert f"from: {out / names[0]}, 20 env-steps" in capsys.readouterr().out
    before = (out / names[0] / "evaluation.json").stat().st_mtime_ns
    shutil.rmtree(taken)
    assert main([*command, "20", "--resume"]) == 0
    assert RunFolder.open(taken).finished
    assert (out / names[0] / "evaluation.json").stat().st_mtime_ns == before
    command[3:5] = ["field_03"]
    assert main([*command, "25", "--source-steps", "25"]) == 2
    assert not (out / "a2c-C-field_03-seed33").exists()
    assert main([*command, "25"]) == 0
    assert f"from: {out / names[0]}, 20 env-steps" in capsys.readouterr().out


def test_only_a_finished_policy_of_the_same_learner_is_taken_over(
    tmp_path: Path,
) -> None:
    path, out = tmp_path / "source", tmp_path / "moved"
    train(TrainConfig("a2c", "field_01", "A", steps=5, episodes=1), path)
    budget: dict[str, Any] = {"steps": 5, "episodes": 1, "transferred_from": path}
    moved = TrainConfig("a2c", "field_02", "C", **budget)
    for config, place in (
        (TrainConfig("ppo", "field_02", "C", **budget), "algorithm: "),
        (replace(moved, hyperparameters={"reward_scale": 0.1}), "hyperparameters.reward_scale: "),
        (replace(moved, environment={"max_steps": 7}), "environment: "),
    ):
        with pytest.raises(ConfigError) as caught:
            train(config, out)
        assert any(problem.startswith(place) for problem in caught.value.problems)
    (path / "policy" / "learner.safetensors").unlink()
    with pytest.raises(RunError, match=r"learner\.safetensors"):
        train(moved, out)
    shutil.rmtree(out)
    (path / "evaluation.json").unlink()
    with pytest.raises(RunError, match=str(path)):
        train(moved, out)
    assert not out.exists()
