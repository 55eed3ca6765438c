"""Grids of tiny runs."""

from pathlib import Path
from typing import Any

from baselines.sweep.processes import LocalEngine
from baselines.sweep.run import Outcome, runs_left, train_runs
from baselines.sweep.spec import GridSpec, runs_of

BUDGET = {"steps": 60, "evaluate_every": 20, "episodes": 1}
TINY: dict[str, Any] = {
    "algorithms": ["a2c"],
    "fields": ["field_03"],
    "settings": ["A"],
    "seeds": [0],
    "budget": BUDGET,
}


def spec_of(store: Path | str, **changes: Any) -> GridSpec:
    return GridSpec.model_validate({"store": str(store), **TINY, **changes})


def run_here(spec: GridSpec) -> dict[str, Outcome]:
    return train_runs(runs_left(runs_of(spec), spec.store), spec.store, LocalEngine(1))
