"""Policies: trained policies and the random one."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from baselines.algorithms import find_algorithm
from baselines.runs.files import RunError, reading
from baselines.runs.folder import RunFolder
from mbn_marl.config import NavigationConfig, make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.field import Field, FieldSampler


class Policy(Protocol):
    """A policy for a batch of worlds.

    Attributes:
        observes: ``"observations"``, the robots' own, (worlds, n, obs_size), or ``"state"``, the
            paper's vector, (worlds, 4n+1).
    """

    observes: Literal["observations", "state"]

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Actions (worlds, n, 2) for what ``observes`` names; the engine clips them to [-1, 1].

        They are the mean ones if ``deterministic``, otherwise sampled from torch's generator.
        """
        ...


def restart(policy: Policy, worlds: np.ndarray | None = None) -> None:
    """Tell a policy, if it has a memory (``reset``), that episodes begin.

    They do in the ``worlds``, (worlds,) bool; ``None``: in all.
    """
    reset = getattr(policy, "reset", None)
    if reset is not None:
        reset(worlds)


def show(policy: Policy, engine: BatchEngine) -> None:
    """Tell a policy, if it wants to know (``watch``), in which engine it will act."""
    watch = getattr(policy, "watch", None)
    if watch is not None:
        watch(engine)


class TrainedPolicy(Policy, Protocol):
    """A policy that can be kept."""

    def save(self, folder: Path) -> None:
        """Write the policy's files into ``folder``, each one atomically."""
        ...


class Origin(NamedTuple):
    """Where a policy was trained."""

    field: Field | FieldSampler
    config: NavigationConfig


class RandomPolicy:
    """Uniform actions in [-1, 1], the same ones from the seed after each reset of all worlds."""

    observes: Literal["observations", "state"] = "observations"

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self.reset()

    def reset(self, worlds: np.ndarray | None = None) -> None:
        """Begin again, unless only some ``worlds``, (worlds,) bool, do."""
        if worlds is None:
            self._random = np.random.default_rng(self._seed)

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Sample actions; ``deterministic`` makes no difference."""
        return self._random.uniform(-1.0, 1.0, size=(*seen.shape[:2], 2)).astype(np.float32)


def load_trained(run: Path | RunFolder) -> TrainedPolicy:
    """Load the latest policy of a run, with its :class:`Origin` in the attribute ``origin``.

    Raises:
        RunError: there is no run, or it has saved no policy yet.
    """
    folder = run if isinstance(run, RunFolder) else RunFolder.open(run)
    with reading(folder.path / "config.json"):
        algorithm = find_algorithm(folder.config["algorithm"])
        origin = Origin(folder.fields, make_config(folder.config["environment"]))
    policy: Any = None
    while policy is None:
        place = folder.policy
        try:
            policy = algorithm.load_policy(place)
        except RunError:
            if folder.policy == place:
                raise
            # The run has written its next checkpoint meanwhile, and removed this one.
    policy.origin = origin
    trained: TrainedPolicy = policy
    return trained
