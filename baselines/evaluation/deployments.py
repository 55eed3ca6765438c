"""Policies on simulated vehicles: the results in numbers, and the strongest wind."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from baselines.policies.loaded import LoadedPolicy
from mbn_marl.engine import BatchEngine
from mbn_marl.sim3d import Deployment, Scale, Simulator, deploy


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
    policy: LoadedPolicy,
    simulator: Simulator,
    speeds: Sequence[float],
    angle: float,
    *,
    every: bool,
) -> list[Deployment]:
    """Deploy a policy in winds, the weakest first, or without ``speeds`` in that of its settings.

    ``speeds`` are in units/step per step, ``angle`` is in degrees from +x. Unless ``every``, the
    first failure is the last deployment.

    Raises:
        ConfigError: the policy does not fit the settings, or they the simulator.
    """
    fitted = policy.fit(BatchEngine(policy.place, 1, threads=1, **policy.settings))
    deployments: list[Deployment] = []
    for wind in [{"wind": (speed, angle)} for speed in sorted(set(speeds))] or [{}]:
        fitted.reset()
        settings = {**policy.settings, **wind}
        flown = deploy(fitted, policy.place, settings, simulator, source=policy.name)
        deployments.append(flown)
        if not (flown.success or every):
            break
    return deployments


def strongest_wind(sweep: Sequence[Deployment]) -> float | None:
    """Return the largest wind speed with success in it and in all weaker ones of a sweep."""
    good = itertools.takewhile(lambda one: one.success, sweep)
    return max((one.episode.config.wind[0] for one in good), default=None)
