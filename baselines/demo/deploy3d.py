"""Policies off the plane: who is deployed where, and what came of it, in numbers."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from baselines.classical.controller import CLASSICAL, make_classical
from baselines.demo.resolve import Actor, find_actor
from mbn_marl.errors import ConfigError
from mbn_marl.field import load_field
from mbn_marl.sim3d import Deployment, Simulator, deploy

ZOO = "zoo"
"""The zoo's own policy for each field."""


def find_pilots(
    policy: str, fields: Sequence[str], speed_limit: float | None = None
) -> list[Actor]:
    """Who acts in each of some fields.

    Args:
        policy: ``"zoo"``, ``zoo:NAME``, a run's folder, ``"greedy"``, ``"planner"`` or
            ``"random"``.
        fields: names or files; without any, a run's or a zoo policy's own.
        speed_limit: of the vehicles, units/step: classical policies reckon with it.

    Raises:
        ConfigError: a policy that needs a field has none.
        MbnError: a field, or a policy for it, is not there.
    """
    if not fields:
        if policy in (ZOO, "random", *CLASSICAL):
            problem = f"field: {policy} has none of its own; name one or more"
            raise ConfigError("deployment", [problem])
        return [find_actor(policy)]
    if policy in CLASSICAL:
        settings = {} if speed_limit is None else {"v_clip": speed_limit}
        loaded = [load_field(name) for name in fields]
        return [
            Actor(make_classical(policy, field, settings), field, settings, policy)
            for field in loaded
        ]
    return [find_actor(name, f"zoo:{name}" if policy == ZOO else policy) for name in fields]


def deploy_actor(actor: Actor, simulator: Simulator, wind: tuple[float, float]) -> Deployment:
    """Let an actor act on a simulator's vehicles.

    Args:
        actor: who, where.
        simulator: is reset, and left open.
        wind: speed (units/step per step) and angle (degrees from +x), in place of the actor's own.
    """
    settings = {**actor.settings, "wind": wind}
    return deploy(actor.policy, actor.field, settings, simulator, source=actor.name)


def summarise(deployment: Deployment, simulated: float) -> dict[str, Any]:
    """A deployment as JSON values; ``simulated``: how many seconds a step stands for."""
    episode = deployment.episode
    speed, angle = episode.config.wind
    pace = episode.steps * simulated / deployment.seconds if deployment.seconds > 0 else None
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
        "separation": deployment.separation,
        "tracking_error": deployment.tracking_error,
        "times_real_time": pace,
    }


def sweep_wind(
    actor: Actor,
    simulator: Simulator,
    speeds: Sequence[float],
    angle: float,
    *,
    after_failure: bool,
) -> list[Deployment]:
    """Deploy an actor in ever more wind.

    Args:
        actor: who, where.
        simulator: is reset each time, and left open.
        speeds: of the wind, rising, units/step per step.
        angle: of the wind, degrees from +x.
        after_failure: go on after the first failure.
    """
    deployments: list[Deployment] = []
    for speed in speeds:
        deployments.append(deploy_actor(actor, simulator, (speed, angle)))
        if not (deployments[-1].success or after_failure):
            break
    return deployments


def strongest_wind(sweep: Sequence[Deployment]) -> float | None:
    """The largest wind speed of a sweep with success in it and in all weaker ones, or ``None``."""
    winds = [
        deployment.episode.config.wind[0]
        for deployment in itertools.takewhile(lambda one: one.success, sweep)
    ]
    return max(winds, default=None)
