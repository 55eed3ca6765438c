"""The speed of the engine with a feature on: dynamics, failures, disturbances, what is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from benchmarks.report import Advance, Benchmark, Findings, Measurement
from benchmarks.speed.adapters import FIELD
from benchmarks.speed.timing import Budget, engine_case, interleaved
from mbn_marl import BatchEngine, Failures, Uniform
from mbn_marl.config import CONDITIONS
from mbn_marl.field import FieldSampler, catalogue_names
from mbn_marl.field.layout import FAMILIES

FEATURES: dict[str, dict[str, Any]] = {
    "holonomic": {"dynamics": "holonomic"},
    "unicycle": {"dynamics": "unicycle"},
    "bicycle": {"dynamics": "bicycle"},
    "failures": {"failures": Failures(rate=0.005)},
    "gusts": dict(CONDITIONS["gusty"]),
    "late, lost and noisy actions": {**CONDITIONS["delayed"], "action_noise": 0.05},
    "noisy sight and dropout": {"position_noise": 1.0, "velocity_noise": 0.1, "dropout": 0.05},
    "drawn numbers": {**CONDITIONS["windy"], "mass": Uniform(1.0, 2.0)},
    "storm": dict(CONDITIONS["storm"]),
}
PLAIN, TEN = "plain", "ten fields"
EPISODES = (1000, 40)
"""Most steps of an episode where fields are compared: the default, and what a fast team needs."""
SAMPLERS: dict[str, tuple[FieldSampler, float | None]] = {
    "drawn fields": (FieldSampler(seed=1), 80.0),
    "drawn fields of all families, 2 to 7 robots, 3 to 10 ROIs": (
        FieldSampler(FAMILIES, robots=(2, 7), rois=(3, 10), size=(160, 420), seed=1),
        None,
    ),
}
"""A new field in every episode of every world, and the least share of the ten fields' speed in %.

The first has as many robots and ROIs as the ten.
"""


@dataclass(frozen=True)
class Features(Benchmark):
    """Measure the engine with each feature on, as a share of its speed without."""

    name: ClassVar[str] = "features"
    stages: ClassVar[int] = 2
    budget: ClassVar[Budget] = Budget()

    def measure(self, advance: Advance) -> Findings:
        """Measure all of them in turn, on one thread."""
        budget, worlds = self.budget, self.budget.worlds
        cases = [
            engine_case(name, BatchEngine(FIELD, worlds, threads=1, **settings), budget.warm_up)
            for name, settings in {PLAIN: {}, **FEATURES}.items()
        ]
        drawn = {name: sampler for name, (sampler, _) in SAMPLERS.items()}
        fields_of: dict[str, Any] = {TEN: catalogue_names(), **drawn}
        cases += [
            engine_case(
                f"{name}, {steps}",
                BatchEngine(fields, worlds, threads=1, max_steps=steps),
                budget.warm_up,
            )
            for steps in EPISODES
            for name, fields in fields_of.items()
        ]
        advance()
        timings = interleaved(cases, budget).cpu
        advance()
        shares = {name: 100 * (timings[PLAIN] / timings[name]).median() for name in FEATURES}
        rows = [
            Measurement(name, share, "%", None if name == "storm" else 50.0)
            for name, share in shares.items()
        ]
        for steps in EPISODES:
            for name, (_, target) in SAMPLERS.items():
                share = 100 * (timings[f"{TEN}, {steps}"] / timings[f"{name}, {steps}"]).median()
                title = f"{name}, of ten fixed ones, at most {steps} steps"
                rows.append(Measurement(title, share, "%", target))
        rate = 1e-6 / timings[PLAIN].median()
        title = f"speed with a feature on, of {rate:.2f} M env-steps/s without, {worlds:,} worlds"
        return Findings(title, rows)
