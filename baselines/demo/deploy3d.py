"""Policies off the plane: who is deployed where, and the results in numbers."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from baselines.classical.controller import CLASSICAL
from baselines.demo.resolve import Actor, find_actor
from baselines.evaluation.fitting import fitted
from baselines.evaluation.policy import restart
from mbn_marl.engine import BatchEngine
from mbn_marl.sim3d import Deployment, Scale, Simulator, deploy


def find_pilots(
    policy: str,
    fields: Sequence[str],
    speed_limit: float | None = None,
    **asked: Any,
) -> list[Actor]:
    """Find who acts in each of some fields.

    Args:
        policy: ``"zoo"``, ``zoo:NAME``, a run's folder, ``"greedy"``, ``"planner"``,
            ``"replan"``, ``"random"``, ``module:callable``.
        fields: names or files; without any, a run's or a zoo policy's own.
        speed_limit: of the vehicles, units/step: classical policies plan with it.
        **asked: settings that replace those that the policy brings.

    Raises:
        ConfigError: a policy that needs a field has none.
        MbnError: a field, or a policy for it, is not there.
    """
    limited = policy in CLASSICAL and speed_limit is not None
    asked |= {"v_clip": speed_limit} if limited else {}
    return [find_actor(policy, name, **asked) for name in fields or (None,)]


def summarise(deployment: Deployment, scale: Scale) -> dict[str, Any]:
    """Return a deployment at a scale as JSON values; what is not known is ``None``."""
    episode, taken = deployment.episode, deployment.seconds
    simulated = episode.steps * episode.config.tau * scale.seconds
    speed, angle = episode.config.wind
    return {
        "field": episode.field.name,
        "wind_speed": speed,
        "wind_angle": angle,
        "outcome": episode.outcome,
        "success": deployment.success,
        "makespan": deployment.makespan,
        "steps": episode.steps,
        "return": episode.team_return,
        "rois_visited": episode.rois_visited,
        "wall_hits": deployment.wall_hits,
        "failed": [int(step) or None for step in episode.failed],
        "separation": deployment.separation,
        "tracking_error": deployment.tracking_error,
        "times_real_time": simulated / taken if taken else None,
    }


def sweep_wind(
    actor: Actor, simulator: Simulator, speeds: Sequence[float], angle: float, *, every: bool
) -> list[Deployment]:
    """Deploy an actor in winds instead of its own, the weakest first, or in its own.

    Args:
        actor: who, where.
        simulator: is reset each time, and left open.
        speeds: of the wind, in any order, units/step per step; without any, its own wind.
        angle: of the wind, degrees from +x.
        every: continue after the first failure.

    Raises:
        ConfigError: the policy does not fit the settings, or they the simulator.
    """
    policy = fitted(actor.policy, BatchEngine(actor.field, 1, threads=1, **actor.settings))
    deployments: list[Deployment] = []
    for wind in [{"wind": (speed, angle)} for speed in sorted(set(speeds))] or [{}]:
        settings = {**actor.settings, **wind}
        restart(policy)
        flown = deploy(policy, actor.field, settings, simulator, source=actor.name)
        deployments.append(flown)
        if not (flown.success or every):
            break
    return deployments


def strongest_wind(sweep: Sequence[Deployment]) -> float | None:
    """Return the largest wind speed with success in it and in all weaker ones of a sweep."""
    good = itertools.takewhile(lambda one: one.success, sweep)
    return max((one.episode.config.wind[0] for one in good), default=None)
