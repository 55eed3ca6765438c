"""Fresh evaluation episodes: true returns, in worlds that training never saw."""

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from baselines.evaluation.intervals import mean_of_known
from baselines.policies.policy import Policy
from mbn_marl.config import make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.episode import Episode, EpisodeRecorder
from mbn_marl.field import Field, FieldSampler, Instance
from mbn_marl.optimum import VIEW, optimal_makespan

# Seed of the evaluation episodes, the same for every run; those of training are others.
EVALUATION_SEED = 1_000_003
# Of a run at most; each has the next seed.
EVALUATIONS = 1_000_000
# The lists of an evaluation, and the engine's metrics in them.
LISTS = {
    "returns": "episode_return",
    "successes": "success",
    "collisions": "collision",
    "steps": "steps",
    "rois_visited": "rois_visited",
    "wall_hits": "wall_hits",
}


# A field by name, a field, random fields, or frozen ones.
Place = str | Field | FieldSampler | Sequence[Instance]


@dataclass(frozen=True)
class Evaluation:
    deterministic: bool  # whether the policy's mean action was taken, or a sampled one
    seed: int  # of the episodes and of the sampled actions
    returns: list[float]  # true team returns (undiscounted, reward units)
    successes: list[bool]  # whether every ROI was visited and no robots collided
    collisions: list[bool]  # whether two robots collided
    steps: list[int]  # lengths in env-steps
    rois_visited: list[int]  # at the end
    wall_hits: list[int]  # steps of any robot that pushed outside the field
    bounds: list[int | None]  # makespans that are proved to be least, if any
    recorded: tuple[Episode, ...] = ()  # those that were asked for, whole

    @property
    def pace(self) -> float:
        """The mean of 1 / makespan, 0 for a failure: it orders policies of the same fields."""
        return float(np.mean(np.array(self.successes) / self.steps))

    @property
    def paths(self) -> list[float] | None:
        """Of each episode bound / makespan, 0 for a failure; ``None`` if a bound is missing."""
        if None in self.bounds:
            return None
        ends = zip(self.bounds, self.steps, self.successes, strict=True)
        return [bound * ok / steps for bound, steps, ok in ends if bound is not None]

    def summary(self) -> dict[str, Any]:
        """Means over the episodes; ``makespan`` and ``gap`` are of the successful ones.

        ``spl`` is success weighted by path length (Anderson et al., 2018), in steps.
        """
        paths = self.paths
        makespans = (steps for steps, ok in zip(self.steps, self.successes, strict=True) if ok)
        return {
            "episodes": len(self.returns),
            "deterministic": self.deterministic,
            "seed": self.seed,
            "return_mean": float(np.mean(self.returns)),
            "return_min": min(self.returns),
            "return_max": max(self.returns),
            "success_rate": float(np.mean(self.successes)),
            "collision_rate": float(np.mean(self.collisions)),
            "makespan": mean_of_known(makespans),
            "gap": None if paths is None else mean_of_known(1.0 / p - 1.0 for p in paths if p),
            "spl": None if paths is None else float(np.mean(paths)),
            "rois_visited": float(np.mean(self.rois_visited)),
            "wall_hits": float(np.mean(self.wall_hits)),
        }

    def to_json(self) -> dict[str, Any]:
        lists = {name: getattr(self, name) for name in (*LISTS, "bounds")}
        return {**self.summary(), "per_episode": lists}


def evaluate(
    policy: Policy,
    place: Place,
    settings: Mapping[str, Any],
    *,
    episodes: int = 100,
    deterministic: bool = False,
    seed: int = EVALUATION_SEED,
    record: Iterable[int] = (),
    source: str = "",
) -> Evaluation:
    """Run fresh episodes side by side; those of the worlds in ``record`` (from 0) are recorded.

    ``episodes`` are those of each frozen field, or of all fields that a sampler draws.
    """
    bounds: list[int | None] = []
    fields: Any = place
    if isinstance(place, Sequence) and not isinstance(place, str):
        bounds = [bound_of(one, settings) for one in place] * episodes
        episodes, fields = len(bounds), [one.field for one in place]
    engine = BatchEngine(fields, episodes, seed=seed, threads=1, **settings)
    running = np.ones(episodes, dtype=bool)
    results: dict[str, np.ndarray] = {}
    with ExitStack() as stack:
        recorders = [
            stack.enter_context(EpisodeRecorder(engine, world, source=source)) for world in record
        ]
        for ended in roll_out(engine, policy, deterministic=deterministic, seed=seed):
            if (first := ended & running).any():
                for name, values in engine.metrics(LISTS.values()).items():
                    per_world = values if values.ndim == 1 else values.sum(axis=1)
                    results.setdefault(name, np.zeros_like(per_world))[first] = per_world[first]
            running &= ~ended
            if not running.any():
                break
    lists: dict[str, Any] = {name: results[metric].tolist() for name, metric in LISTS.items()}
    recorded = tuple(recorder.episodes[0] for recorder in recorders)
    if not bounds:
        known = None if engine.sampler else optimal_makespan(engine.field_of(0), engine.config)
        bounds = [known] * episodes
    return Evaluation(deterministic, seed, **lists, bounds=bounds, recorded=recorded)


def bound_of(frozen: Instance, settings: Mapping[str, Any]) -> int | None:
    """Return a field's proved bound, ``None`` if settings change more than views and rewards."""
    alike = dict.fromkeys((*VIEW, "reward", "n_robots", "max_steps"))
    fixed = {"observation": "entities", **frozen.settings}  # which shows own knowledge
    ours, theirs = (make_config(some).model_copy(update=alike) for some in (settings, fixed))
    return frozen.makespan_lower_bound if ours == theirs else None


def roll_out(
    engine: BatchEngine, policy: Policy, *, deterministic: bool, seed: int
) -> Iterator[np.ndarray]:
    """Reset the engine and let a policy act; yield at each step which episodes ended, (W,) bool."""
    policy = policy.fit(engine)
    policy.reset()
    observations = engine.reset()
    with sampling(seed):
        while True:
            actions = policy.act_in(engine, observations, deterministic=deterministic)
            observations, _, terminated, truncated = engine.step(actions)
            ended = terminated | truncated
            if ended.any():
                policy.reset(ended)
            yield ended


@contextmanager
def sampling(seed: int) -> Iterator[None]:
    """Seed torch for sampled actions; put its generators back afterwards, a GPU's too."""
    torch = sys.modules.get("torch")
    if torch is None:  # no policy here samples from it
        yield
        return
    gpus = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
    with torch.random.fork_rng(gpus):
        torch.manual_seed(seed)
        yield


def unseen(fields: Field | FieldSampler, seed: int) -> Field | FieldSampler:
    """Return a field, or a sampler with the ``seed`` of an evaluation, whose fields are new."""
    return fields if isinstance(fields, Field) else fields.model_copy(update={"seed": seed})


def is_one_episode(policy: Policy, settings: Mapping[str, Any], *, deterministic: bool) -> bool:
    """Return whether all episodes are the same: they depend on no random number."""
    return not (make_config(settings).is_random or policy.draws(deterministic=deterministic))


def extremes(evaluation: Evaluation) -> dict[str, Episode]:
    """Return the ``best``, ``median`` and ``worst`` episode, by return, if all were recorded."""
    order = np.argsort(evaluation.returns, kind="stable")
    worlds = {"best": order[-1], "median": order[len(order) // 2], "worst": order[0]}
    return {name: evaluation.recorded[world] for name, world in worlds.items()}


def evaluate_both(
    policy: Policy,
    field: Field | FieldSampler,
    settings: Mapping[str, Any],
    *,
    record: Iterable[int] = (),
    source: str = "",
    **how: Any,
) -> dict[str, Evaluation]:
    """Evaluate with sampled actions, whose episodes may be recorded, and with mean ones."""
    where = policy, field, settings
    return {
        "stochastic": evaluate(*where, record=record, source=source, **how),
        "deterministic": evaluate(*where, deterministic=True, **how),
    }
