"""The adapters: what PettingZoo, TorchRL and Stable-Baselines3 add to the engine."""

from __future__ import annotations

from typing import Any

import numpy as np
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from benchmarks.report import Measurement
from benchmarks.speed import timing
from benchmarks.speed.peers import mpe2_cases
from mbn_marl import BatchEngine, parallel_env
from mbn_marl.adapters.sb3 import CentralizedVecEnv
from mbn_marl.adapters.torchrl import NavigationEnv

FIELD = "field_01"
STEPS_PER_COLLECTION = 16
ROWS = 256


def measure_pettingzoo(budget: timing.Budget) -> list[Measurement]:
    """Measure one world stepped with dicts, against MPE2 ``simple_spread`` if it is installed."""
    env, rng = parallel_env(FIELD), np.random.default_rng(0)
    sets = [
        {agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.possible_agents}
        for _ in range(timing.SETS)
    ]
    env.reset(seed=0)

    def step(actions: Any) -> None:
        env.step(actions)
        if not env.agents:
            env.reset()

    mpe2 = mpe2_cases()
    timings, walls = timing.interleaved([timing.cycling_case("own", sets, step), *mpe2], budget)
    own, times, note = timings["own"], None, "needs mpe2, in the extra bench"
    if mpe2:
        other = timings[mpe2[0].name]
        times, note = (other / own).median(), f"MPE2: {other.median() * 1e6:.0f} us"
    resets = f"with the resets between; by the clock {walls['own'].median() * 1e6:.3g} us"
    against = "PettingZoo step against MPE2 simple_spread"
    return [
        Measurement("PettingZoo step, one world", own.median() * 1e6, "us", 10.0, False, resets),
        Measurement(against, times, "x", 10.0, note=note),
    ]


def measure_sb3(budget: timing.Budget) -> list[Measurement]:
    """Measure how much longer ``CentralizedVecEnv`` takes than the engine in it."""
    env = CentralizedVecEnv(FIELD, ROWS, threads=1)
    env.reset()
    cases = [
        timing.engine_case("engine", BatchEngine(FIELD, ROWS, threads=1), budget.warm_up),
        timing.random_case("SB3", (ROWS, env.engine.n_robots, 2), env.step, ROWS, budget.warm_up),
    ]
    timings = timing.interleaved(cases, budget).cpu
    over = (timings["SB3"] - timings["engine"]).median() * 1e6
    note = f"per world-step; the engine takes {timings['engine'].median() * 1e6:.2f} us"
    name = f"SB3 CentralizedVecEnv over the engine, {ROWS} worlds"
    return [Measurement(name, over, "us", 1.0, False, note)]


def measure_torchrl(budget: timing.Budget) -> list[Measurement]:
    """Measure ``NavigationEnv`` against an empty environment, under a random policy."""
    env = NavigationEnv(FIELD, budget.worlds, threads=1)
    lean = NavigationEnv(
        FIELD, budget.worlds, threads=1, state=False, team_reward=False, metrics=()
    )
    flags = {"track_traj_ids": False, "return_same_td": True}
    own = [_collector_case("own", env), _collector_case("lean", lean, **flags)]
    for case in own:
        case.run(budget.warm_up // STEPS_PER_COLLECTION)
    timings = timing.interleaved([*own, _collector_case("empty", EmptyEnv(env))], budget).cpu
    rates, times = 1e-6 / timings.median(), (timings["own"] / timings["lean"]).median()
    title = f"TorchRL collector, {budget.worlds:,} worlds"
    note = f"{times:.2f} x the rate with all entries and the default flags"
    percent = 100 * (timings["empty"] / timings["own"]).median()
    against = f"{rates['own']:.2f} M against {rates['empty']:.2f} M env-steps/s"
    return [
        Measurement(f"{title}, lean", rates["lean"], "M env-steps/s", note=note),
        Measurement(f"{title}, of an empty env's rate", percent, "%", 70.0, note=against),
    ]


def _collector_case(name: str, env: Any, **flags: bool) -> timing.Case:
    """Rollouts of random actions by TorchRL's collector, in seconds per env-step."""
    frames = env.batch_size[0] * STEPS_PER_COLLECTION
    rollouts = iter(Collector(env, None, frames_per_batch=frames, total_frames=-1, **flags))
    return timing.Case(name, lambda calls: [next(rollouts) for _ in range(calls)], frames)


class EmptyEnv(EnvBase):  # type: ignore[misc]
    """Has the specs of another environment, and returns zeros: what TorchRL itself costs."""

    def __init__(self, like: EnvBase) -> None:
        super().__init__(device=like.device, batch_size=like.batch_size)
        self.action_spec = like.full_action_spec.clone()
        self.reward_spec = like.full_reward_spec.clone()
        self.observation_spec = like.observation_spec.clone()
        self.done_spec = like.full_done_spec.clone()
        self._first = self.observation_spec.zero().update(self.full_done_spec.zero())
        self._next = self._first.clone().update(self.full_reward_spec.zero())

    def _set_seed(self, seed: int | None) -> None:
        """There is nothing random."""

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        return self._first.clone()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        return self._next.clone()
