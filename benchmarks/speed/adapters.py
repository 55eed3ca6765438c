"""The adapters: what PettingZoo, TorchRL and Stable-Baselines3 add to the engine."""

from __future__ import annotations

from importlib.util import find_spec
from itertools import cycle
from typing import Any

import numpy as np

from benchmarks.report import Measurement
from benchmarks.speed.engine import FIELD
from benchmarks.speed.peers import mpe2_cases
from benchmarks.speed.timing import SETS, Budget, Case, RandomSteps, engine_case, interleaved
from mbn_marl import BatchEngine, parallel_env

STEPS_PER_COLLECTION = 16
ROWS = 256


def measure_pettingzoo(budget: Budget) -> list[Measurement]:
    """Measure one world stepped with dicts, against MPE2 ``simple_spread`` if it is installed."""
    mpe2 = mpe2_cases()
    timings = interleaved([_pettingzoo_case(), *mpe2], budget)
    own = timings["PettingZoo"]
    time = Measurement(
        "PettingZoo step, one world", own.median * 1e6, "us", 15.0, False, "with the resets between"
    )
    name = "PettingZoo step against MPE2 simple_spread"
    if not mpe2:
        return [
            time,
            Measurement(name, None, "x", 10.0, note="needs mpe2: pip install 'mbn-marl[bench]'"),
        ]
    other = timings[mpe2[0].name]
    note = f"MPE2: {other.median * 1e6:.0f} us"
    return [time, Measurement(name, own.times_faster_than(other), "x", 10.0, note=note)]


def _pettingzoo_case() -> Case:
    env = parallel_env(FIELD)
    rng = np.random.default_rng(0)
    sets = [
        {agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.possible_agents}
        for _ in range(SETS)
    ]
    actions = cycle(sets)
    env.reset(seed=0)

    def run(calls: int) -> None:
        for _ in range(calls):
            env.step(next(actions))
            if not env.agents:
                env.reset()

    return Case("PettingZoo", run)


def measure_sb3(budget: Budget) -> list[Measurement]:
    """Measure how much longer ``CentralizedVecEnv`` takes than the engine in it."""
    name = f"SB3 CentralizedVecEnv over the engine, {ROWS} worlds"
    if not find_spec("stable_baselines3"):
        return [Measurement(name, None, "us", 1.0, False, "needs pip install 'mbn-marl[sb3]'")]
    from mbn_marl.adapters.sb3 import CentralizedVecEnv

    env = CentralizedVecEnv(FIELD, ROWS)
    env.reset()
    steps = RandomSteps((ROWS, env.engine.n_robots, 2), env.step)
    cases = [
        engine_case("engine", BatchEngine(FIELD, ROWS), budget.warm_up),
        steps.case("SB3", ROWS, budget.warm_up),
    ]
    timings = interleaved(cases, budget)
    over = timings["SB3"].longer_than(timings["engine"]) * 1e6
    note = f"per world-step; the engine takes {timings['engine'].median * 1e6:.2f} us"
    return [Measurement(name, over, "us", 1.0, False, note)]


def measure_torchrl(budget: Budget) -> list[Measurement]:
    """Measure ``NavigationEnv`` against an empty environment, under a random policy."""
    title = f"TorchRL NavigationEnv collected, {budget.worlds:,} worlds, of an empty env's rate"
    if not find_spec("torchrl"):
        return [Measurement(title, None, "%", 70.0, note="needs pip install 'mbn-marl[torchrl]'")]
    from benchmarks.speed.empty_env import EmptyEnv
    from mbn_marl.adapters.torchrl import NavigationEnv

    env = NavigationEnv(FIELD, budget.worlds)
    empty = {
        "never ending": EmptyEnv(env, ending=False),
        "a world ends each step": EmptyEnv(env, ending=True),
    }
    own = _collector_case("own", env)
    own.run(budget.warm_up // STEPS_PER_COLLECTION)
    cases = [own, *(_collector_case(name, one) for name, one in empty.items())]
    timings = interleaved(cases, budget)
    rows = []
    for name in empty:
        percent = 100 * timings["own"].times_faster_than(timings[name])
        rates = [timings[case].rate / 1e6 for case in ("own", name)]
        note = f"{rates[0]:.2f} M against {rates[1]:.2f} M env-steps/s"
        rows.append(Measurement(f"{title} ({name})", percent, "%", 70.0, note=note))
    return rows


def _collector_case(name: str, env: Any) -> Case:
    """Rollouts of random actions by TorchRL's collector, in seconds per env-step."""
    from torchrl.collectors import Collector

    frames = env.batch_size[0] * STEPS_PER_COLLECTION
    rollouts = iter(Collector(env, None, frames_per_batch=frames, total_frames=-1))

    def run(calls: int) -> None:
        for _ in range(calls):
            next(rollouts)

    return Case(name, run, frames)
