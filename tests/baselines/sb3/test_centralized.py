"""The six centralised algorithms: every setting, their hyperparameters, transfer."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from baselines.algorithms import ALGORITHMS
from baselines.cli import main
from baselines.evaluation.evaluate import evaluate
from baselines.policies.load import load_trained
from baselines.runs.files import RunError, read_json
from baselines.runs.folder import RunFolder
from baselines.runs.tensors import moments_of
from baselines.sb3.config import TUNED_IN_PAPER, accepted_arguments, load
from baselines.sb3.trainer import Learner, TrainingWorlds, make_env
from baselines.training import aids, run_logger
from baselines.training.aids import RoiCurriculum
from baselines.training.config import TrainConfig
from baselines.training.run_logger import EpisodeWindow
from baselines.training.train import notes, prepare, train
from mbn_marl.adapters.sb3 import CentralizedVecEnv, NavigationVecEnv, SharedPolicyVecEnv
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field
from tests.support.problems import places_of
from tests.support.runs import recorded

pytestmark = pytest.mark.slow

CATALOGUE = Path(__file__).parents[3] / "envs_catalog"
NAMES = [name for name, entry in ALGORITHMS.items() if "A" in entry.settings]


def test_every_setting_trains_from_the_command_line(tmp_path):
    configs = {}
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


def test_what_the_paper_tuned_is_taken_or_skipped(tmp_path):
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


def test_a_wrong_hyperparameter_file_is_refused_by_place(tmp_path):
    path, out = tmp_path / "mine.yaml", tmp_path / "run"
    for text, place in (
        ("A: {}", "N: "),
        ("N: {num_envs: 0}", "num_envs: "),
        ("N: {worlds: 1}", "worlds: "),
        ("N: {model: {tau: 0.1}}", "model.tau: "),
        ("N: {model: {gae_lambda: .nan}}", "model.gae_lambda: "),
        ("N: {model: {policy_kwargs: {log_std_init: .inf}}}", "model.policy_kwargs: "),
        ("N: {model: {learning_rate: {from: 1.0, to: -1.0}}}", "model.learning_rate"),
        ("N: {policy: Mlp}", "no learner"),
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
def test_transferred_learner_begins_with_the_policy_of_its_source(name, tmp_path):
    small = {"normalize_observation": name == "a2c"}
    if name in ("crossq", "tqc"):
        small["model"] = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8}
    how = {"episodes": 1, "hyperparameters": small}
    how["environment"] = {"max_steps": 20}
    run = train(TrainConfig(name, "field_01", "A", steps=120, **how), tmp_path / "source")
    config = TrainConfig(name, "field_02", "C", steps=100, transferred_from=run.path, **how)
    learner = Learner(*prepare(config), EpisodeWindow())
    learner.begin_with(run.policy)
    model = learner.model
    policy = load_trained(run)
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


def test_transfer_goes_from_one_field_to_others(tmp_path, capsys):
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


def test_only_a_finished_policy_of_the_same_learner_is_taken_over(tmp_path):
    path, out = tmp_path / "source", tmp_path / "moved"
    train(TrainConfig("a2c", "field_01", "A", steps=5, episodes=1), path)
    budget = {"steps": 5, "episodes": 1, "transferred_from": path}
    moved = TrainConfig("a2c", "field_02", "C", **budget)
    for config, place in (
        (TrainConfig("ppo", "field_02", "C", **budget), "algorithm"),
        (replace(moved, hyperparameters={"reward_scale": 0.1}), "hyperparameters.reward_scale"),
        (replace(moved, environment={"max_steps": 7}), "environment"),
    ):
        assert place in places_of(ConfigError, train, config, out)
    (path / "policy" / "learner.safetensors").unlink()
    with pytest.raises(RunError, match=r"learner\.safetensors"):
        train(moved, out)
    shutil.rmtree(out)
    (path / "evaluation.json").unlink()
    with pytest.raises(RunError, match=str(path)):
        train(moved, out)
    assert not out.exists()


WORLDS = 64
LIVELY = {"safety_distance": 50.0, "random_starts": True, "max_steps": 10, "seed": 2, "threads": 1}
"""Settings under which some worlds have a collision while others still run."""
AIDS = {"episode_steps": 24, "roi_radius": 4.0}


@pytest.fixture
def two_stages(monkeypatch):
    monkeypatch.setattr(aids, "STAGES", 2)
    monkeypatch.setattr(aids, "SUCCESS", (0.0, 0.0))


def config_of(name: str, **changes: Any) -> TrainConfig:
    model = {"n_steps": 8, "policy_kwargs": {"net_arch": [8]}}
    if name != "a2c":
        model["batch_size"] = 32
    how = {"steps": 256, "evaluate_every": 100, "episodes": 2}
    how["hyperparameters"] = {"num_envs": 4, "model": model, **AIDS, **changes}
    return TrainConfig(name, "field_03", environment={"safety_distance": 0.0}, **how)


@pytest.mark.usefixtures("two_stages")
@pytest.mark.parametrize("kind", [CentralizedVecEnv, SharedPolicyVecEnv])
def test_change_of_size_truncates_the_episodes_that_run(kind):
    made = []

    def make(curriculum: RoiCurriculum) -> NavigationVecEnv:
        made.append(kind("field_03", WORLDS, roi_radius=10.0 * curriculum.radius, **LIVELY))
        return made[-1]

    plain = kind("field_03", WORLDS, roi_radius=40.0, **LIVELY)
    curriculum = RoiCurriculum(4.0, window=WORLDS)
    env = TrainingWorlds(make, curriculum, EpisodeWindow())
    env.every = 11
    np.testing.assert_array_equal(env.reset(), plain.reset())
    shape = (11, env.num_envs, *env.action_space.shape)
    for actions in np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32):
        # Every world's episode has ended after ten steps, but a rollout has eleven.
        assert len(made) == 1 and curriculum.radius == 4.0
        observations, rewards, dones, infos = env.step(actions)
        last, expected, ended, others = plain.step(actions)
        np.testing.assert_array_equal(rewards, expected)
    assert [one.engine.config.roi_radius for one in made] == [40.0, 20.0]
    assert env.unwrapped is made[1] and curriculum.radius == 2.0
    np.testing.assert_array_equal(observations, make(curriculum).reset())
    assert dones.all() and 0 < ended.sum() < len(ended)
    for row, info in enumerate(infos):
        if ended[row]:  # by itself: what it was is left
            assert info["TimeLimit.truncated"] == others[row]["TimeLimit.truncated"]
            assert info["success"] == others[row]["success"]
            last_seen = others[row]["terminal_observation"]
        else:
            assert info["TimeLimit.truncated"] and "episode" not in info
            last_seen = last[row]
        np.testing.assert_array_equal(info["terminal_observation"], last_seen)
    assert not all(info["TimeLimit.truncated"] for info in infos)


@pytest.mark.usefixtures("two_stages")
@pytest.mark.parametrize("name", ["ppo", "ppo-shared"])
def test_rois_become_smaller_over_the_budget(name, tmp_path, monkeypatch):
    monkeypatch.setattr(run_logger, "ROW_STEPS", 1)
    config = config_of(name)
    run = train(config, tmp_path / "run")
    rows = recorded(run)["rows"]
    assert [int(row["env_steps"]) for row in rows] == [32, 64, 96, 128, 160, 192, 224, 256]
    assert run.evaluation["env_steps"] == 256 and notes(config) == []
    # Four worlds, rollouts of 8 steps: episodes of 24 steps end in every third rollout.
    assert [int(row["episodes"]) for row in rows] == [0, 0, 4, 0, 0, 4, 0, 0]
    assert [float(row["roi_radius"]) for row in rows] == [4.0, 4.0, 2.0, 2.0, 2.0, 1.0, 1.0, 1.0]
    assert run.config["environment"]["roi_radius"] == 10.0
    assert min(run.evaluation["deterministic"]["per_episode"]["steps"]) > 24


def test_policy_of_all_robots_observations_is_kept_and_evaluated(tmp_path):
    run = train(config_of("ppo", joint_observation=True), tmp_path / "run")
    policy = load_trained(run)
    assert policy.observes == "observations"
    how = {"episodes": 1, "deterministic": True}
    again = evaluate(policy, run.field, run.config["environment"], **how)
    assert again.to_json() == run.evaluation["deterministic"]
    with pytest.raises(ConfigError, match="observation: "):
        evaluate(policy, run.field, {"observation": "lidar"}, **how)


def test_other_learners_refuse_aids():
    aids = {"roi_radius": 2.0, "scattered": 0.5, "episode_steps": 5}
    for name in ("ars", "tqc"):
        assert sorted(places_of(ConfigError, load, name, "N", aids)) == sorted(aids)
        load(name, "N", {"roi_radius": 1.0, "episode_steps": None})
    with pytest.raises(ConfigError, match="joint_observation: "):  # of a central learner alone
        load("ppo-shared", "N", {"joint_observation": True})


@pytest.mark.parametrize("name", ["a2c", "ars"])
def test_evaluation_is_of_the_policy_after_the_update(name, tmp_path):
    how = {"evaluate_every": 100, "episodes": 1}
    how |= {"hyperparameters": {"model": {"learning_rate": 1.0}}, "environment": {"max_steps": 50}}
    runs = [
        train(TrainConfig(name, "field_03", "A", steps=steps, **how), tmp_path / str(steps))
        for steps in (1000, 100)
    ]
    during, (last,) = runs[0].evaluations[0], runs[1].evaluations
    assert during["env_steps"] == last["env_steps"]
    assert during["deterministic_return_mean"] == last["deterministic_return_mean"]


ROBOTS = 3


def test_learner_sees_scaled_rewards_and_the_window_true_team_returns():
    changes = {"num_envs": 2, "normalize_observation": False}
    rows = []
    for settings in ({"max_steps": 2}, {"roi_radius": 1000.0}):
        window, rewards = EpisodeWindow(), []
        config = TrainConfig(
            "ppo-shared", "field_03", environment=settings, hyperparameters=changes
        )
        env, _ = make_env(*prepare(config), window)
        env.reset()
        for _ in range(settings.get("max_steps", 1)):
            rewards.append(env.step(np.zeros((2 * ROBOTS, 2), np.float32))[1])
        row = window.pop()
        rows.append((row["episodes"], row["success_rate"], row["return_mean"], row["return_std"]))
        if "max_steps" in settings:
            # Two of three robots start in an ROI: 10,000 - 10 each; then 100 for standing still.
            assert sorted(rewards[0][:ROBOTS]) == pytest.approx([-0.0005, 0.4995, 0.4995])
            assert rewards[1] == pytest.approx([-0.005] * 2 * ROBOTS)
    assert rows[0] == (2, 0.0, 19_670.0, 0.0) and rows[1][:2] == (2, 1.0)
