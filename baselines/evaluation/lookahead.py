"""Any policy with a lookahead: it tries changes of its episode in the engine, and acts the best.

Source: this package; random shooting around a policy, as sampling-based control does it, over
whole episodes and with the environment itself as the model.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from baselines.evaluation.fitting import LoadedPolicy, fitted
from baselines.evaluation.policy import Origin, Policy, restart, show
from mbn_marl.config import NavigationConfig
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError

WORLDS, GENERATIONS = 64, 20
LONGEST = 300
"""Steps of an episode, while none has succeeded."""
LOG_SIGMAS = (math.log(0.03), math.log(1.5))
"""The logarithm of the noise's standard deviation, in shares of the full force, is uniform."""
LENGTH = 6.0
"""Steps that noise lasts, on the average (geometric)."""
HOLDS = (1, 3, 8)
"""Steps that a number of the noise lasts, on the average; all worlds of a generation have one."""
ALONE = 0.7
"""The share of the worlds in which one robot alone is changed."""


class Change(NamedTuple):
    """How each world departs from the episode that is kept."""

    robots: NDArray[np.bool_]  # (W, n): which do; past its end, all
    first: NDArray[np.intp]  # (W,): the step from which they do, by the policy and noise
    last: NDArray[np.intp]  # (W,): the step from which there is no noise
    sigma: NDArray[np.float64]  # (W,)
    hold: int


class Generation(NamedTuple):
    """The episodes of a generation."""

    success: NDArray[np.bool_]  # (W,)
    returns: NDArray[np.float64]  # (W,) reward units, the team's
    missing: NDArray[np.float64]  # (W,) units, see missing(); inf where it is over
    actions: NDArray[np.float32]  # (T, W, n, 2)


class Lookahead:
    """A policy that improves its episode before it acts, where nothing is by chance.

    Every generation plays an episode in each of many worlds, in which some robots depart from the
    best one so far: from some step on they take mean actions again, with noise for a while. Ever
    shorter episodes are played, and the one with the highest return is kept, or, if none succeeds,
    the one that came nearest. If none ever does, within ``LONGEST`` steps, the policy acts as it
    would without. It counts on the field's own starts. :func:`~.fitting.fitted` shows it the
    engine.

    Args:
        policy: the policy, loaded or not.
        generations: how many; at least 1.

    Raises:
        ConfigError: from :meth:`watch`: episodes differ there; from :meth:`act`: it was shown none.
    """

    samples = False

    def __init__(self, policy: Policy, generations: int = GENERATIONS) -> None:
        self.policy = policy.policy if isinstance(policy, LoadedPolicy) else policy
        self.generations = generations
        self.observes: Literal["observations", "state"] = policy.observes
        self.origin: Origin | None = getattr(self.policy, "origin", None)
        self._watched: BatchEngine | None = None
        self._plan: NDArray[np.float32] | None = None  # (T, n, 2); T is 0 without success
        self._steps = np.zeros(0, int)

    def watch(self, engine: BatchEngine) -> None:
        """See :func:`~.policy.show`; a ConfigError says why it cannot look ahead there."""
        wrong = {
            "condition: by chance; allowed: one in which all episodes are the same": (
                engine.config.is_random
            ),
            "fields: several; allowed: one": engine.sampler is not None or len(engine.fields) > 1,
            "autoreset: 'next_step'; allowed: the others": engine.autoreset == "next_step",
        }
        if problems := [problem for problem, holds in wrong.items() if holds]:
            raise ConfigError("lookahead", problems)
        before = self._watched
        if before is None or (before.field, before.config) != (engine.field, engine.config):
            self._plan = None
        self._watched, self._steps = engine, np.zeros(engine.num_worlds, int)

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """See :class:`Policy`; nothing is sampled. The first call looks ahead."""
        if self._watched is None:
            raise ConfigError("lookahead", ["engine: none; needed: policy = fitted(...)"])
        if self._plan is None:
            self._plan = _look_ahead(self.policy, self._watched, self.generations)
            show(self.policy, self._watched)
            restart(self.policy)
        if not len(self._plan):
            return self.policy.act(seen, deterministic=True)
        self._steps = np.resize(self._steps, len(seen))  # of a loaded policy: any number of worlds
        actions: NDArray[np.float32] = self._plan[np.minimum(self._steps, len(self._plan) - 1)]
        self._steps += 1
        return actions

    def reset(self, worlds: np.ndarray | None = None) -> None:
        """See :func:`~.policy.restart`."""
        steps = self._steps if worlds is None else np.resize(self._steps, len(worlds))
        self._steps = np.where(True if worlds is None else worlds, 0, steps)
        restart(self.policy, worlds)


def _look_ahead(policy: Policy, like: BatchEngine, generations: int) -> NDArray[np.float32]:
    """Return the actions (T, n, 2) of the best episode that was found in an engine's field."""
    settings = {name: getattr(like.config, name) for name in NavigationConfig.model_fields}
    engine = BatchEngine(like.field, WORLDS, autoreset="disabled", threads=1, **settings)
    acting, rng = fitted(policy, engine), np.random.default_rng(0)
    best = kept = np.zeros((0, engine.n_robots, 2), np.float32)
    highest, nearest, horizon = -math.inf, math.inf, min(LONGEST, like.config.max_steps)
    for _ in range(generations):
        if not horizon:  # one step is the least
            break
        change = _draw_change(rng, len(kept), engine.n_robots)
        trial = _play(engine, acting, kept, change, horizon, rng)
        returns = np.where(trial.success, trial.returns, -math.inf)
        if returns.max() > highest:
            highest, nearest = returns.max(), math.inf
            best = kept = trial.actions[:, returns.argmax()]
            horizon = len(best) - 1
        elif trial.missing.min() < nearest:
            nearest, kept = trial.missing.min(), trial.actions[:, trial.missing.argmin()]
    return best


def _draw_change(rng: np.random.Generator, length: int, n: int) -> Change:
    """Draw a change of an episode of ``length`` steps for every world; the first has no noise."""
    robots = np.ones((WORLDS, n), np.bool_)
    alone = np.flatnonzero(rng.random(WORLDS) < ALONE)
    robots[alone] = rng.integers(n, size=(len(alone), 1)) == np.arange(n)
    first = rng.integers(max(length, 1), size=WORLDS)
    sigma = np.exp(rng.uniform(*LOG_SIGMAS, WORLDS))
    sigma[0] = 0.0
    last = first + rng.geometric(1.0 / LENGTH, WORLDS)
    return Change(robots, first, last, sigma, int(rng.choice(HOLDS)))


def _play(
    engine: BatchEngine,
    policy: Policy,
    kept: NDArray[np.float32],
    change: Change,
    horizon: int,
    rng: np.random.Generator,
) -> Generation:
    """Play at most ``horizon`` steps in every world, until one succeeds."""
    active, taken = np.ones(WORLDS, np.bool_), []
    success, ended = np.zeros((2, WORLDS), np.bool_)  # by success or collision
    noise = np.zeros((WORLDS, engine.n_robots, 2))
    restart(policy)
    seen = engine.reset(0)
    for step in range(horizon):
        shown = engine.state() if policy.observes == "state" else seen
        drawn = (rng.random(WORLDS) < 1.0 / change.hold) | (step == change.first)
        sigma = change.sigma * (step < change.last)
        fresh = rng.standard_normal(noise.shape)
        noise = np.where(drawn[:, None, None], fresh, noise)
        actions = policy.act(shown, deterministic=True) + sigma[:, None, None] * noise
        actions = np.clip(actions, -1.0, 1.0).astype(np.float32)
        if step < len(kept):
            same = ~(change.robots & (step >= change.first)[:, None])
            actions = np.where(same[..., None], kept[step], actions)
        taken.append(actions)
        seen, _, terminated, truncated = engine.step(actions, active)
        success = active & engine.metrics(("success",))["success"]
        ended |= terminated
        active &= ~(terminated | truncated)
        if success.any() or not active.any():
            break
    returns = engine.metrics(("episode_return",))["episode_return"]
    far = np.where(ended, math.inf, missing(engine))
    return Generation(success, returns, far, np.array(taken))


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
