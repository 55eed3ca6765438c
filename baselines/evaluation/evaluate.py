"""Fresh evaluation episodes: true returns, in worlds that training never saw."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from baselines.evaluation.intervals import mean_of_known
from baselines.evaluation.policy import Origin, Policy, RandomPolicy
from mbn_marl.config import NavigationConfig, make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.episode import Episode, EpisodeRecorder
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field

EVALUATION_SEED = 1_000_003
"""Seed of the evaluation episodes: the same for every run, and none that training uses."""


@dataclass(frozen=True)
class Evaluation:
    """The episodes of one evaluation, each list with one entry per episode.

    Attributes:
        deterministic: whether the policy's mean action was taken, or a sampled one.
        seed: the seed of the episodes and of the sampled actions.
        returns: true team returns (undiscounted, reward units).
        successes: whether every ROI was visited and no robots collided.
        collisions: whether two robots collided.
        steps: lengths in env-steps.
        rois_visited: ROIs visited at the end.
        wall_hits: steps of any robot that pushed outside the field.
    """

    deterministic: bool
    seed: int
    returns: list[float]
    successes: list[bool]
    collisions: list[bool]
    steps: list[int]
    rois_visited: list[int]
    wall_hits: list[int]

    def summary(self) -> dict[str, Any]:
        """Means over the episodes; ``makespan`` is the mean length of the successful ones."""
        lengths = [s if ok else None for s, ok in zip(self.steps, self.successes, strict=True)]
        return {
            "episodes": len(self.returns),
            "deterministic": self.deterministic,
            "seed": self.seed,
            "return_mean": float(np.mean(self.returns)),
            "return_min": min(self.returns),
            "return_max": max(self.returns),
            "success_rate": float(np.mean(self.successes)),
            "collision_rate": float(np.mean(self.collisions)),
            "makespan": mean_of_known(lengths),
            "rois_visited": float(np.mean(self.rois_visited)),
            "wall_hits": float(np.mean(self.wall_hits)),
        }

    def to_json(self) -> dict[str, Any]:
        """The summary, and every episode under ``per_episode``."""
        lists = {name: value for name, value in asdict(self).items() if isinstance(value, list)}
        return {**self.summary(), "per_episode": lists}


def evaluate(
    policy: Policy,
    field: str | Field,
    settings: Mapping[str, Any],
    *,
    episodes: int = 100,
    deterministic: bool = False,
    seed: int = EVALUATION_SEED,
    attach: Callable[[BatchEngine], None] = lambda engine: None,
) -> Evaluation:
    """Run ``episodes`` fresh episodes side by side, one world each.

    Args:
        policy: what acts; it sees the engine's observation or state, as it says.
        field: catalogue name, path or field.
        settings: settings of the environment (:class:`mbn_marl.config.NavigationConfig`).
        episodes: how many (> 0).
        deterministic: take the mean action instead of a sampled one.
        seed: of the worlds and of the sampled actions.
        attach: receives the engine before the first reset, to follow it.

    Raises:
        ConfigError: the policy was trained for other observations, see :func:`check_fits`.
    """
    engine = BatchEngine(field, episodes, seed=seed, threads=1, **settings)
    check_fits(policy, engine.field, settings)
    attach(engine)
    open_worlds = np.ones(episodes, dtype=bool)
    results: dict[str, np.ndarray] = {}
    observations = engine.reset()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        while open_worlds.any():
            seen = engine.state() if policy.observes == "state" else observations
            actions = policy.act(seen, deterministic=deterministic)
            observations, _, terminated, truncated = engine.step(actions)
            ended = (terminated | truncated) & open_worlds
            if ended.any():
                _record(results, engine.metrics(), ended)
                open_worlds &= ~ended
    return Evaluation(
        deterministic=deterministic,
        seed=seed,
        returns=[float(value) for value in results["episode_return"]],
        successes=[bool(value) for value in results["success"]],
        collisions=[bool(value) for value in results["collision"]],
        steps=[int(value) for value in results["steps"]],
        rois_visited=[int(value) for value in results["rois_visited"]],
        wall_hits=[int(value) for value in results["wall_hits"]],
    )


def is_one_episode(policy: Policy, settings: Mapping[str, Any], *, deterministic: bool) -> bool:
    """Return whether all episodes are the same: they start alike, and no action is sampled."""
    if make_config(settings).random_starts or isinstance(policy, RandomPolicy):
        return False
    return deterministic or not getattr(policy, "samples", True)


def check_fits(policy: Policy, field: Field, settings: Mapping[str, Any]) -> None:
    """Check that a loaded policy would see what it was trained to see.

    Raises:
        ConfigError: naming everything that differs: the number of robots or ROIs and, for a policy
            that acts on the robots' own observations, their kind and what they are scaled by.
    """
    trained: Origin | None = getattr(policy, "origin", None)
    if trained is None:
        return
    ours, theirs = _sizes(*trained), _sizes(field, make_config(settings))
    if policy.observes == "state":
        ours, theirs = dict([*ours.items()][:2]), dict([*theirs.items()][:2])
    problems = [
        f"{name}: the policy was trained with {ours[name]}, here it is {theirs[name]}"
        for name in ours
        if ours[name] != theirs[name]
    ]
    if problems:
        raise ConfigError(f"policy in {field.name}", problems)


def evaluate_recorded(
    policy: Policy,
    field: str | Field,
    settings: Mapping[str, Any],
    *,
    worlds: Iterable[int],
    source: str = "",
    **how: Any,
) -> tuple[Evaluation, list[Episode]]:
    """Evaluate, and record the episodes of some worlds.

    Args:
        policy: as for :func:`evaluate`, as all that is not here.
        field: as there.
        settings: as there.
        worlds: their numbers, from 0.
        source: the name of the policy.
        how: as there.

    Raises:
        ConfigError: as there.
    """
    recorders: list[EpisodeRecorder] = []
    with ExitStack() as stack:

        def attach(engine: BatchEngine) -> None:
            for world in worlds:
                recorder = EpisodeRecorder(engine, world, source=source)
                recorders.append(stack.enter_context(recorder))

        evaluation = evaluate(policy, field, settings, attach=attach, **how)
    return evaluation, [recorder.episodes[0] for recorder in recorders]


def record_evaluation(
    policy: Policy,
    field: Field,
    settings: Mapping[str, Any],
    *,
    episodes: int,
    seed: int,
    source: str,
) -> dict[str, Episode]:
    """The ``best``, the ``median`` and the ``worst`` episode with sampled actions, by return.

    Arguments as for :func:`evaluate`, which sees the same episodes; ``source`` names the policy.
    """
    how: dict[str, Any] = {"episodes": episodes, "seed": seed, "source": source}
    evaluation, recorded = evaluate_recorded(policy, field, settings, worlds=range(episodes), **how)
    order = np.argsort(evaluation.returns, kind="stable")
    worlds = {"best": order[-1], "median": order[len(order) // 2], "worst": order[0]}
    return {name: recorded[world] for name, world in worlds.items()}


def evaluate_both(
    policy: Policy, field: Field, settings: Mapping[str, Any], *, episodes: int, seed: int
) -> dict[str, Evaluation]:
    """Evaluate with sampled actions (``stochastic``) and with mean ones (``deterministic``).

    Arguments as for :func:`evaluate`.
    """
    return {
        name: evaluate(
            policy, field, settings, episodes=episodes, deterministic=deterministic, seed=seed
        )
        for name, deterministic in (("stochastic", False), ("deterministic", True))
    }


def _sizes(field: Field, config: NavigationConfig) -> dict[str, Any]:
    """What the numbers of an observation depend on."""
    sizes = {
        "robots": config.n_robots or len(field.starts),
        "ROIs": len(field.rois),
        "arena": tuple(map(float, field.arena)),
        **{name: getattr(config, name) for name in ("observation", "one_hot", "v_clip")},
    }
    if config.observation in ("local", "lidar"):
        sizes["sensing_radius"] = config.sensing_radius
    elif config.observation == "state":
        del sizes["arena"], sizes["v_clip"]
    return sizes


def _record(
    results: dict[str, np.ndarray], metrics: Mapping[str, np.ndarray], ended: np.ndarray
) -> None:
    """Copy the metrics of the worlds that have just ended their first episode."""
    for name, values in metrics.items():
        per_world = values if values.ndim == 1 else values.sum(axis=1)
        results.setdefault(name, np.zeros_like(per_world))[ended] = per_world[ended]
