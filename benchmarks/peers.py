"""Other projects' environments of the same kind, where they are installed: VMAS and MPE2.

Neither resets during the timing, which is to their advantage.
"""

from __future__ import annotations

from importlib.util import find_spec
from itertools import cycle
from typing import Any

import numpy as np

from benchmarks.timing import Case

ROBOTS = 3
VMAS_WORLDS = (1024, 4096, 16_384, 65_536)
NEVER = 10**9


def vmas_cases() -> list[Case]:
    """VMAS ``simple_spread`` with three agents, a case per batch size, in seconds per env-step."""
    return [_vmas_case(worlds) for worlds in VMAS_WORLDS] if find_spec("vmas") else []


def _vmas_case(worlds: int) -> Case:
    import torch
    import vmas

    env = vmas.make_env(
        "simple_spread",
        num_envs=worlds,
        device="cpu",
        continuous_actions=True,
        seed=0,
        n_agents=ROBOTS,
    )
    env.reset()
    generator = torch.Generator().manual_seed(0)
    sets = [
        [torch.rand((worlds, 2), generator=generator) * 2 - 1 for _ in range(ROBOTS)]
        for _ in range(4)
    ]
    actions = cycle(sets)

    def run(calls: int) -> None:
        for _ in range(calls):
            env.step(next(actions))

    return Case(f"VMAS simple_spread, {worlds:,} worlds", run, worlds)


def mpe2_cases() -> list[Case]:
    """One world of MPE2 ``simple_spread``, continuous actions, in seconds per env-step."""
    if not find_spec("mpe2"):
        return []
    from mpe2 import simple_spread_v3

    env = simple_spread_v3.parallel_env(N=ROBOTS, max_cycles=NEVER, continuous_actions=True)
    env.reset(seed=0)
    space = env.action_space(env.agents[0])
    rng = np.random.default_rng(0)
    sets: list[dict[str, Any]] = [
        {agent: rng.uniform(space.low, space.high).astype(np.float32) for agent in env.agents}
        for _ in range(64)
    ]
    actions = cycle(sets)

    def run(calls: int) -> None:
        for _ in range(calls):
            env.step(next(actions))

    return [Case("MPE2 simple_spread", run)]
