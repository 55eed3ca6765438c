"""Grids of tiny runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from baselines.sweep.processes import LocalEngine
from baselines.sweep.run import Sweep
from baselines.sweep.spec import GridSpec
from baselines.sweep.worker import Outcome

BUDGET = {"steps": 60, "evaluate_every": 20, "episodes": 1}
TINY: dict[str, Any] = {
    "algorithms": ["a2c"],
    "fields": ["field_03"],
    "settings": ["A"],
    "seeds": [0],
    "budget": BUDGET,
    "resources": {"upload_seconds": 0},
}


def spec_of(store: Path | str, **changes: Any) -> GridSpec:
    return GridSpec.model_validate({"store": str(store), **TINY, **changes})


def run_here(sweep: Sweep) -> dict[str, Outcome]:
    """Run a grid in this process; return how each run ended."""
    outcomes: dict[str, Outcome] = {}

    def listen(outcome: Outcome) -> None:
        assert outcome.name not in outcomes, "a run ended twice"
        outcomes[outcome.name] = outcome

    sweep.train(LocalEngine(1), listen)
    return outcomes
