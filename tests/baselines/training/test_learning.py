"""Every trainer learns: a tiny field with a known optimum, within a small budget."""

from __future__ import annotations

from pathlib import Path

import pytest

from baselines.algorithms import ALGORITHMS
from baselines.evaluation.policy import load_trained
from baselines.training.config import TrainConfig
from baselines.training.train import train
from mbn_marl.field import Field, save_field

TINY = Field(
    vertices=[(0, 0), (160, 0), (160, 100), (0, 100)],
    rois=[(70, 50)],
    starts=[(20, 50), (140, 50)],
    name="tiny",
)
OPTIMUM = 110_000.0 - 2 * 10 * 13
"""Full thrust covers t (t + 1) / 4 units in t steps; robot 0 needs 40 (50 less the ROI's radius):
45.5 at t = 13, and robot 1 needs 60. Two robots pay 10 a step each."""


QUICK = [name for name in ALGORITHMS if name not in ("crossq", "tqc", "ppo-supersuit")]
"""The off-policy ones solve it too, in one to two minutes of a core (16,384 env-steps).
``ppo-supersuit`` is the same learner as ``ppo-shared``, on rows that come one at a time."""


@pytest.mark.parametrize("algorithm", QUICK)
def test_a_tiny_field_is_solved(algorithm: str, tmp_path: Path) -> None:
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
    half, all_steps = (entry["env_steps"] for entry in run.evaluations)
    assert 98_304 <= half < 196_608 <= all_steps
    single_mdp = "A" in ALGORITHMS[algorithm].settings
    assert load_trained(run).observes == ("state" if single_mdp else "observations")
