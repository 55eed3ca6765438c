"""Behaviour cloning, as an example of the use of the planner's demonstrations.

``mbn plan field_03 --export demos.npz --episodes 100 --noise 0.2`` records demonstrations, and
``python -m baselines.classical.cloning demos.npz field_03`` trains one network for the whole team
on them and evaluates it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import nn
from tyro.conf import Positional

from baselines.evaluation.evaluate import evaluate
from baselines.runs.files import read_arrays
from mbn_marl.field import load_field
from mbn_marl.optimum import optimal_return, optimality_gap


class ClonedPolicy:
    """One network with two hidden layers from all robots' observations to all robots' actions.

    Its inputs are normalised as ``observations`` (K, n, obs_size) are.
    """

    observes: Literal["observations", "state"] = "observations"

    def __init__(self, observations: torch.Tensor, hidden: int) -> None:
        rows = observations.flatten(1)
        self.mean, self.scale = rows.mean(0), rows.std(0) + 1e-3
        self.network = nn.Sequential(
            nn.Linear(rows.shape[1], hidden),
            nn.Tanh(),
            nn.Linear(hidden, hidden),
            nn.Tanh(),
            nn.Linear(hidden, 2 * observations.shape[1]),
        )

    def __call__(self, observations: torch.Tensor) -> torch.Tensor:
        """Return actions (K, n, 2), not clipped."""
        rows = (observations.flatten(1) - self.mean) / self.scale
        actions: torch.Tensor = self.network(rows)
        return actions.view(len(rows), -1, 2)

    def act(self, seen: NDArray[np.float32], *, deterministic: bool) -> NDArray[np.float32]:
        """Return the cloned actions; ``deterministic`` has no effect."""
        with torch.no_grad():
            actions: NDArray[np.float32] = self(torch.from_numpy(seen)).numpy()
        return actions


def clone(
    observations: NDArray[np.float32],
    actions: NDArray[np.float32],
    *,
    updates: int = 3000,
    hidden: int = 256,
    seed: int = 0,
) -> ClonedPolicy:
    """Fit actions (K, n, 2) to observations (K, n, obs_size) by least squares."""
    torch.manual_seed(seed)
    inputs, targets = torch.from_numpy(observations), torch.from_numpy(actions)
    policy = ClonedPolicy(inputs, hidden)
    optimizer = torch.optim.Adam(policy.network.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    for _ in range(updates):
        batch = torch.randint(len(inputs), (256,))
        loss = nn.functional.mse_loss(policy(inputs[batch]), targets[batch])
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    return policy


def main(
    demonstrations: Positional[Path],
    field: Positional[str],
    updates: int = 3000,
    episodes: int = 20,
) -> None:
    """Train on demonstrations, evaluate, print the result.

    Args:
        demonstrations: the file of `mbn plan --export`.
        field: the field of the demonstrations.
        updates: steps of the optimiser, each on 256 samples.
        episodes: episodes of the evaluation.
    """
    arrays, place = read_arrays(demonstrations), load_field(field)
    policy = clone(arrays["observations"], arrays["actions"], updates=updates)
    result = evaluate(policy, place, {}, episodes=episodes, deterministic=True).summary()
    gap = optimality_gap(result["return_mean"], optimal_return(place))
    print(
        f"success {result['success_rate']:.0%}, return {result['return_mean']:,.0f}, "
        f"makespan {result['makespan']}, gap {'unknown' if gap is None else f'{gap:.2%}'}"
    )


if __name__ == "__main__":
    tyro.cli(main)
