"""The engine and its adapters against a plain loop and other suites.

Cases take turns, so that noise of the machine hits them alike; CPU time, medians and ratios of
turns that followed each other count. VMAS and MPE2 do not reset during the timing, which is to
their advantage.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from itertools import chain, cycle
from time import perf_counter, thread_time
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pandas as pd
import torch

from benchmarks.report import Benchmark, Findings, Measurement, measurement_table
from mbn_marl import BatchEngine, FieldSampler, load_field, parallel_env
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.field import catalogue_names
from mbn_marl.field.generator.layout import FAMILIES

Step = Callable[[Any], object]
MILLION, RATE = 1e6, "M env-steps/s"
FIELD, ROBOTS = "field_01", 3
SETS = 64  # steps for which actions are drawn at a time; longer turns use them again
STEPS_PER_COLLECTION = 16
SCENARIOS = "simple_spread", "navigation"
VMAS_WORLDS = (1024, 4096, 16_384, 65_536)
MIXED = FieldSampler(FAMILIES, robots=(2, 7), rois=(3, 10), size=(160, 420), seed=1)
FIRST_STEP = """
from mbn_marl import parallel_env
env = parallel_env("field_03")
env.reset()
env.step(dict.fromkeys(env.agents, (0.0, 0.0)))
"""


@dataclass(frozen=True)
class Budget:
    rounds: int = 15  # turns of every case
    seconds: float = 0.06  # of a turn, about; at least one call
    warm_up: int = 1000  # steps before; as many as an episode has at most: episodes of all ages
    worlds: int = 4096
    many_worlds: int = 16_384  # of a large batch
    startup: bool = True  # also start fresh processes, with an empty cache and with a filled one


@dataclass(frozen=True)
class Speed(Benchmark):
    """Measure the engine and its adapters against the plain loop and the peers installed."""

    name: ClassVar[str] = "speed"
    budget: ClassVar[Budget] = Budget()

    def measure(self) -> Findings:
        torch.set_num_threads(1)  # an engine with several threads would undo it
        startup = measure_startup() if self.budget.startup else []
        parts = (measure_engine, measure_pettingzoo, measure_torchrl)
        rows = [*chain.from_iterable(part(self.budget) for part in parts), *startup]
        title = "CPU time of one thread; 3 robots, 6 ROIs, field_01, random actions, float32"
        return Findings({title: measurement_table(rows)}, {"rows": [row.to_json() for row in rows]})


def measure_startup() -> list[Measurement]:
    """Measure a new process up to its first PettingZoo step: without a cache, and with one."""
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
        for name, target in (("first call on a machine (compiles)", 6.0), ("later starts", 0.6)):
            wall, before = perf_counter(), os.times()
            subprocess.run([sys.executable, "-c", FIRST_STEP], env=environment, check=True)
            wall, after = perf_counter() - wall, os.times()
            used = sum(after[2:4]) - sum(before[2:4])  # by ended children
            rows.append(Measurement(name, used, "s", target, False, f"by the clock {wall:.3g} s"))
    return rows


def measure_engine(budget: Budget) -> list[Measurement]:
    """Measure ``BatchEngine``; all cases, the plain loop and VMAS (if installed) take turns."""
    some, many = budget.worlds, budget.many_worlds
    mixed = "drawn fields of all families, 2 to 7 robots, 3 to 10 ROIs"
    batches: dict[str, tuple[Any, int, float | None]] = {
        f"BatchEngine.step, {some:,} worlds": (FIELD, some, 11.0),
        f"BatchEngine.step, {many:,} worlds": (FIELD, many, 7.5),
        f"the ten fields in one batch, {some:,} worlds": (catalogue_names(), some, None),
        f"{mixed}, {some:,} worlds": (MIXED, some, 1.9),
    }
    cases = [
        engine_case(name, BatchEngine(fields, worlds, threads=1), budget.warm_up)
        for name, (fields, worlds, _) in batches.items()
    ]
    plain = plain_case()
    vmas = {scenario: vmas_cases(scenario) for scenario in SCENARIOS}
    timings, walls = interleaved([plain, *chain.from_iterable(vmas.values()), *cases], budget)
    step, rates = timings[cases[0].name], 1 / timings.median()
    walled = 1 / walls[[*batches]].median() / MILLION
    rows = [
        Measurement(name, rates[name] / MILLION, RATE, target, note=f"by the clock {wall:.3g} M")
        for (name, (*_, target)), wall in zip(batches.items(), walled, strict=True)
    ]
    times = (timings[plain.name] / step).median()
    of_loop = f"the loop: {rates[plain.name]:,.0f} env-steps/s"
    name = "BatchEngine.step against the plain loop"
    rows.append(Measurement(name, times, "x", 1000.0, note=of_loop))
    for scenario, peers in vmas.items():
        ratio, note = None, "needs vmas, in the extra bench"
        if peers:
            best = rates[[case.name for case in peers]].idxmax()
            ratio = (timings[best] / step).median()
            note = f"its best: {best.partition(', ')[2]}, {rates[best] / MILLION:.2f} {RATE}"
        name = f"BatchEngine.step against VMAS {scenario}"
        rows.append(Measurement(name, ratio, "x", 5.0, note=note))
    return rows


def measure_pettingzoo(budget: Budget) -> list[Measurement]:
    """Measure one world stepped with dicts, against MPE2 ``simple_spread`` if it is installed."""
    env, rng = parallel_env(FIELD), np.random.default_rng(0)
    sets = [
        {agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.possible_agents}
        for _ in range(SETS)
    ]
    env.reset(seed=0)

    def step(actions: Any) -> None:
        env.step(actions)
        if not env.agents:
            env.reset()

    mpe2 = mpe2_cases()
    timings, walls = interleaved([cycling_case("own", sets, step), *mpe2], budget)
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


def measure_torchrl(budget: Budget) -> list[Measurement]:
    from torchrl.collectors import Collector

    frames = budget.worlds * STEPS_PER_COLLECTION

    def case(name: str, flags: dict[str, bool], **settings: Any) -> Case:
        env = NavigationEnv(FIELD, budget.worlds, threads=1, **settings)
        rollouts = iter(Collector(env, None, frames_per_batch=frames, total_frames=-1, **flags))
        return Case(name, lambda calls: [next(rollouts) for _ in range(calls)], frames)

    flags = {"track_traj_ids": False, "return_same_td": True}
    lean = case("lean", flags, state=False, team_reward=False, metrics=())
    timings = interleaved([case("all", {}), lean], budget).cpu
    times = (timings["all"] / timings["lean"]).median()
    note = f"{times:.2f} x the rate with all entries and the default flags"
    name = f"TorchRL collector, {budget.worlds:,} worlds, lean"
    return [Measurement(name, 1e-6 / timings["lean"].median(), RATE, note=note)]


@dataclass(frozen=True)
class Case:
    """Something to time; the name is unique in its group."""

    name: str
    run: Callable[[int], object]  # does it so many times
    units: float = 1.0  # units (env-steps, say) of a call
    prepare: Callable[[int], object] = lambda calls: None  # before the clock starts


class Timings(NamedTuple):
    """Seconds per unit: a row for each round, a column for the name of each case."""

    cpu: pd.DataFrame  # of the calling thread: all of it where a case uses no other
    wall: pd.DataFrame


def interleaved(cases: Sequence[Case], budget: Budget) -> Timings:
    turns = [(case, _calls_per_turn(case, budget.seconds)) for case in cases]
    rounds = [
        [np.divide(_time(case, calls), calls * case.units) for case, calls in turns]
        for _ in range(budget.rounds)
    ]
    names, (cpu, wall) = [case.name for case in cases], np.array(rounds).transpose(2, 0, 1)
    return Timings(pd.DataFrame(cpu, columns=names), pd.DataFrame(wall, columns=names))


def _time(case: Case, calls: int) -> tuple[float, float]:
    case.prepare(calls)
    cpu, wall = thread_time(), perf_counter()
    case.run(calls)
    return thread_time() - cpu, perf_counter() - wall


def _calls_per_turn(case: Case, seconds: float) -> int:
    _time(case, 1)  # warms up
    calls, (taken, _) = 1, _time(case, 1)
    while taken < seconds / 4:
        calls *= 2
        taken, _ = _time(case, calls)
    return max(1, round(calls * seconds / max(taken, 1e-9)))


def engine_case(name: str, engine: BatchEngine, warm_up: int) -> Case:
    engine.reset()
    shape = (engine.num_worlds, engine.n_robots, 2)
    return random_case(name, shape, engine.step, engine.num_worlds, warm_up)


def random_case(
    name: str, shape: tuple[int, ...], step: Step, units: float, warm_up: int = 0
) -> Case:
    """Step with uniform random actions of that shape in [-1, 1), float32, after ``warm_up``."""
    rng = np.random.default_rng(0)
    drawn = np.empty((SETS, *shape), np.float32)

    def draw(calls: int) -> None:
        actions = rng.random(out=drawn[:calls], dtype=np.float32)
        np.subtract(2 * actions, 1, out=actions)

    def run(calls: int) -> None:
        for k in range(calls):
            step(drawn[k % SETS])

    for done in range(0, warm_up, SETS):
        draw(SETS)
        run(min(SETS, warm_up - done))
    return Case(name, run, units, draw)


def cycling_case(name: str, sets: Iterable[Any], step: Step, units: float = 1.0) -> Case:
    actions = cycle(sets)

    def run(calls: int) -> None:
        for _ in range(calls):
            step(next(actions))

    return Case(name, run, units)


def plain_case() -> Case:
    """Return the plain loop, one world of the tests' oracle, in seconds per env-step."""
    oracle = import_module("tests.support.oracle").Oracle(load_field(FIELD))

    # All that the engine does in a step, with the metrics and the reset when an episode ends.
    def step(actions: Any) -> None:
        outcome = oracle.step(actions.tolist())
        if outcome.terminated or outcome.truncated:
            oracle.metrics()
            oracle.reset()
        for robot in range(oracle.n):
            oracle.observe(robot)

    return random_case("plain loop", (oracle.n, 2), step, 1.0)


def vmas_cases(scenario: str) -> list[Case]:
    if not find_spec("vmas"):
        return []
    import vmas

    options = {"device": "cpu", "continuous_actions": True, "seed": 0, "n_agents": ROBOTS}
    cases = []
    for worlds in VMAS_WORLDS:
        env = vmas.make_env(scenario, num_envs=worlds, **options)
        env.reset()
        generator = torch.Generator().manual_seed(0)
        drawn = torch.rand((4, ROBOTS, worlds, 2), generator=generator) * 2 - 1
        sets = [list(actions) for actions in drawn]
        cases.append(cycling_case(f"VMAS {scenario}, {worlds:,} worlds", sets, env.step, worlds))
    return cases


def mpe2_cases() -> list[Case]:
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
