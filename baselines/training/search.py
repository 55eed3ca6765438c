"""Search for a trained team's fastest episode: change the actors' last layers, keep what is better.

A generation tries a change in each of many worlds, with mean actions. Episodes end a step before
the fastest one so far did, so that whoever succeeds is faster; if none does, the change is kept
that came nearest to success, so that the way to a faster episode has many small steps. A change is
kept only if sampled actions earn as much as before the search: the fastest episodes of all pass
walls and robots so closely that others fail.

Source: this package; a random search with one parent (an evolution strategy, Rechenberg 1973).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from mbn_marl.engine import BatchEngine
from mbn_marl.field import Field
from mbn_marl.optimum import optimal_return

WORLDS = 512
LOG_SIGMAS = (math.log(1e-3), math.log(1.0))
"""The logarithm of a change's standard deviation is uniform between these, for each actor."""
PATIENCE = 3
"""Episodes with sampled actions may last so many times as long as the first one with mean ones."""


class Actors(Protocol):
    """A team's Gaussian policy: k networks, each for all robots or one of them."""

    @property
    def last_layer(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Weights (k, inputs, outputs) and biases (k, 1, outputs) of the mean actions."""
        ...

    @property
    def log_std(self) -> torch.Tensor:
        """Logarithm of the standard deviation, to be expanded to (n, 2)."""
        ...

    def features(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the last layer's inputs (k, rows, inputs) for ``observations`` (W, n, size)."""
        ...


class Trial(NamedTuple):
    """The episodes of all worlds, (W,) each."""

    success: NDArray[np.bool_]
    returns: NDArray[np.float64]  # the team's true return
    steps: NDArray[np.int32]
    missing: NDArray[np.float64]  # units, see missing(); inf if terminated


class LastLayerSearch:
    """A search for faster episodes from a field's own starts.

    Args:
        actors: their last layers are changed in place.
        field: to search on, with the environment's ``settings``, whose starts are not random.
        seed: of the changes and the sampled actions.

    Attributes:
        env_steps: taken so far.
    """

    def __init__(
        self, actors: Actors, field: Field, settings: Mapping[str, Any], seed: int
    ) -> None:
        self.env_steps = 0
        self._actors, self._layer = actors, [part.detach() for part in actors.last_layer]
        self._engine = BatchEngine(field, WORLDS, autoreset="disabled", threads=1, **settings)
        self._optimum = optimal_return(field, self._engine.config)
        self._generator = torch.Generator().manual_seed(seed)

    def run(self, generations: int) -> None:
        """Search, at most until the proved optimum; a team that fails is left as it is."""
        same = [part.unsqueeze(1).expand(-1, WORLDS, -1, -1) for part in self._layer]
        first = self._play(same, self._engine.config.max_steps)
        if not first.success[0]:
            return
        best, steps, missing = first.returns[0], int(first.steps[0]), np.inf
        longest = PATIENCE * steps
        earned = self._play(same, longest, sampled=True).returns.mean()
        for _ in range(generations):
            if best == self._optimum:
                return
            changed = self._changes()
            trial = self._play(changed, steps - 1)
            returns = np.where(trial.success, trial.returns, -np.inf)
            faster = returns.max() > best
            kept = int(returns.argmax() if faster else trial.missing.argmin())
            if not (faster or trial.missing[kept] < missing):
                continue
            one = [part[:, kept : kept + 1].expand_as(part) for part in changed]
            if self._play(one, longest, sampled=True).returns.mean() < earned:
                continue
            for part, changes in zip(self._layer, changed, strict=True):
                part.copy_(changes[:, kept])
            missing = trial.missing[kept]
            if faster:
                best, steps, missing = returns[kept], int(trial.steps[kept]), np.inf

    def _changes(self) -> list[torch.Tensor]:
        """Draw a changed last layer for every world, as :meth:`_play` wants it."""
        low, high = LOG_SIGMAS
        sigma = torch.rand(len(self._layer[0]), WORLDS, 1, 1, generator=self._generator)
        sigma.mul_(high - low).add_(low).exp_()
        shapes = [(len(part), WORLDS, *part.shape[1:]) for part in self._layer]
        noise = [torch.randn(shape, generator=self._generator) for shape in shapes]
        return [
            part.unsqueeze(1) + sigma * one for part, one in zip(self._layer, noise, strict=True)
        ]

    @torch.no_grad()
    def _play(self, layer: Sequence[torch.Tensor], horizon: int, *, sampled: bool = False) -> Trial:
        """Play at most ``horizon`` steps in every world, with mean actions or ``sampled`` ones.

        ``layer``: a last layer for each world, weights (networks, W, inputs, outputs) and biases
        (networks, W, 1, outputs).
        """
        engine, active = self._engine, np.ones(WORLDS, np.bool_)
        success, ended = np.zeros((2, WORLDS), np.bool_)
        std = self._actors.log_std.exp().expand(engine.n_robots, 2)
        seen = engine.reset(0)
        for _ in range(horizon):
            actions = self._actions(seen, layer)
            if sampled:
                actions += std * torch.randn(actions.shape, generator=self._generator)
            seen, _, terminated, truncated = engine.step(actions.numpy(), active)
            success |= active & engine.metrics(("success",))["success"]
            ended |= terminated
            active &= ~(terminated | truncated)
            if not active.any():
                break
        measured = engine.metrics(("episode_return", "steps"))
        returns, steps = measured["episode_return"].copy(), measured["steps"].copy()
        self.env_steps += int(steps.sum())
        return Trial(success, returns, steps, np.where(ended, np.inf, missing(self._engine)))

    def _actions(self, seen: NDArray[np.float32], layer: Sequence[torch.Tensor]) -> torch.Tensor:
        """Return the mean actions (W, n, 2) of each world's own ``layer``."""
        weights, biases = layer
        features = self._actors.features(torch.from_numpy(seen))
        rows = features.view(len(features), WORLDS, -1, features.shape[-1])
        return torch.add(rows @ weights, biases).transpose(0, 1).reshape(*seen.shape[:2], 2)


def missing(engine: BatchEngine) -> NDArray[np.float64]:
    """Return how far each world of an engine with one field is from success, (W,) units.

    It is the sum over ROIs not visited of the distance to the nearest robot, and the arena's
    diagonal for every wall hit.
    """
    state = engine.state().astype(np.float64)
    positions = state[:, : 2 * engine.n_robots].reshape(len(state), -1, 1, 2)
    distance = np.linalg.norm(positions - engine.field.rois, axis=-1).min(axis=1)
    bits = np.arange(engine.n_rois)[::-1]
    left = (state[:, -1:].astype(np.int64) >> bits & 1) == 0
    hits = engine.metrics(("wall_hits",))["wall_hits"].sum(axis=1)
    far: NDArray[np.float64] = (distance * left).sum(axis=1)
    far += hits * math.hypot(*engine.field.arena)
    return far
