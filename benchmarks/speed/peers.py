"""Peers of the suite: the plain loop of the tests, and VMAS and MPE2 if installed.

VMAS and MPE2 do not reset during the timing, which is to their advantage.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np

from benchmarks.speed.timing import SETS, Case, cycling_case, random_case
from mbn_marl import load_field

ROBOTS = 3
VMAS_WORLDS = (1024, 4096, 16_384, 65_536)


def plain_case() -> Case:
    """The plain loop on field_01, in seconds per env-step.

    One world of the tests' oracle does what the engine does in a step: revisit memory, rewards and
    their terms, an observation for each robot, and metrics and a reset when an episode ends.
    """
    oracle = import_module("tests.support.oracle").Oracle(load_field("field_01"))

    def step(actions: Any) -> None:
        outcome = oracle.step(actions.tolist())
        if outcome.terminated or outcome.truncated:
            oracle.metrics()
            oracle.reset()
        for robot in range(oracle.n):
            oracle.observe(robot)

    return random_case("plain loop", (oracle.n, 2), step, 1.0)


def vmas_cases(scenario: str) -> list[Case]:
    """A scenario of VMAS with three agents, a case per batch size, in seconds per env-step."""
    if not find_spec("vmas"):
        return []
    import torch
    import vmas

    options = {"device": "cpu", "continuous_actions": True, "seed": 0, "n_agents": ROBOTS}
    cases = []
    for worlds in VMAS_WORLDS:
        env = vmas.make_env(scenario, num_envs=worlds, **options)
        env.reset()
        generator = torch.Generator().manual_seed(0)
        drawn = torch.rand((4, ROBOTS, worlds, 2), generator=generator) * 2 - 1
        sets = [list(actions) for actions in drawn]
        name = f"VMAS {scenario}, {worlds:,} worlds"
        cases.append(cycling_case(name, sets, env.step, worlds))
    return cases


def mpe2_cases() -> list[Case]:
    """One world of MPE2 ``simple_spread``, continuous actions, in seconds per env-step."""
    if not find_spec("mpe2"):
        return []
    from mpe2 import simple_spread_v3

    env = simple_spread_v3.parallel_env(N=ROBOTS, max_cycles=10**9, continuous_actions=True)
    env.reset(seed=0)
    space = env.action_space(env.agents[0])
    rng = np.random.default_rng(0)
    sets: list[dict[str, Any]] = [
        {agent: rng.uniform(space.low, space.high).astype(np.float32) for agent in env.agents}
        for _ in range(SETS)
    ]
    return [cycling_case("MPE2 simple_spread", sets, env.step)]
