"""Every trainer learns: small fields with a known optimum, within a small budget."""

from __future__ import annotations

from pathlib import Path

import pytest

from baselines.algorithms import ALGORITHMS
from baselines.policies.trained import load_trained
from baselines.training.config import TrainConfig
from baselines.training.train import train
from mbn_marl.field import Field, save_field

pytestmark = pytest.mark.slow

EASY = Field([(0, 0), (100, 0), (100, 100), (0, 100)], rois=[(50, 50)], starts=[(30, 50)])


@pytest.mark.parametrize("algorithm", ["ppo", "ars", "tqc", "mappo", "ppo-joint", "ppo-shared"])
def test_an_easy_field_is_solved_and_then_the_run_stops(algorithm: str, tmp_path: Path) -> None:
    save_field(EASY, tmp_path / "easy.yaml")
    config = TrainConfig(
        algorithm,
        str(tmp_path / "easy.yaml"),
        steps=200_000,
        evaluate_every=1024 if algorithm == "tqc" else 16_384,
        episodes=20,
        stop_at=100_000.0,
        environment={"max_steps": 100},
    )
    run = train(config, tmp_path / "run")
    *earlier, passed, final = run.evaluations
    assert passed["env_steps"] == final["env_steps"] < config.steps
    assert passed["return_mean"] >= 100_000.0 and passed["success_rate"] >= 0.99
    assert passed["deterministic_return_mean"] == final["deterministic_return_mean"]
    assert all(entry["success_rate"] < 0.99 for entry in earlier[:1])
    assert run.finished and not (run.path / "checkpoints").exists()
    single_mdp = "A" in ALGORITHMS[algorithm].settings
    assert load_trained(run).observes == ("state" if single_mdp else "observations")


TINY = Field(
    vertices=[(0, 0), (160, 0), (160, 100), (0, 100)],
    rois=[(70, 50)],
    starts=[(20, 50), (140, 50)],
)
OPTIMUM = 110_000.0 - 2 * 10 * 13
"""Full thrust covers t (t + 1) / 4 units in t steps; robot 0 needs 40 (50 less the ROI's radius):
45.5 at t = 13, and robot 1 needs 60. Two robots pay 10 a step each."""


@pytest.mark.all
@pytest.mark.parametrize("algorithm", ALGORITHMS.keys() - {"crossq", "tqc", "ppo-supersuit"})
def test_a_field_of_two_robots_is_solved_to_the_optimum(algorithm: str, tmp_path: Path) -> None:
    save_field(TINY, tmp_path / "tiny.yaml")
    config = TrainConfig(
        algorithm,
        str(tmp_path / "tiny.yaml"),
        steps=196_608,
        evaluate_every=98_304,
        episodes=50,
        environment={"max_steps": 200},
    )
    run = train(config, tmp_path / "run")
    sampled, mean = run.evaluation["stochastic"], run.evaluation["deterministic"]
    assert sampled["success_rate"] == 1.0
    assert 0.99 * OPTIMUM < sampled["return_mean"] <= OPTIMUM
    assert 0.999 * OPTIMUM < mean["return_mean"] <= OPTIMUM
