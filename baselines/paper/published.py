"""The paper's own numbers, as ``published.json`` holds them: tables, tuned values, protocol."""

import json
from pathlib import Path
from typing import Any

from baselines.algorithms import Setting

ALGORITHM_UNIT = 1e6
STATISTICS = {"mean": "mean", "SD": "sd", "max": "max", "range": "range"}
Numbers = dict[str, float]
"""A cell's numbers in reward units, by the names in ``STATISTICS``."""

_FILE: dict[str, Any] = json.loads(Path(__file__).with_name("published.json").read_text())
SOURCE: str = _FILE["source"]
ALGORITHMS: dict[str, str] = {name.lower(): name for name in _FILE["algorithms"]}
"""The paper's algorithms in its order: our name -> the paper's."""
SETTINGS: list[str] = list(_FILE["environments"])
REPORTED: list[Setting] = ["A", "B", "C", "N"]
"""The paper's settings, and ours beside them."""
RANGES: dict[str, tuple[float, float]] = {
    name: tuple(ends) for name, ends in _FILE["optuna_ranges"].items()
}
TRIALS: int = _FILE["protocol"]["optuna_trials"]
TRIAL_STEPS: int = _FILE["protocol"]["optuna_timesteps"]
FIELDS: list[str] = list(_FILE["environments"]["A"])


def display_name(algorithm: str) -> str:
    name, dash, kind = algorithm.partition("-")
    return f"{ALGORITHMS.get(name, name.upper())}{dash}{kind}"


def by_algorithm() -> dict[tuple[str, str], Numbers]:
    """Each algorithm over all fields (table 1): (our name, setting) -> its numbers."""
    return {
        (name, setting): _numbers(cell, ALGORITHM_UNIT)
        for name, shown in ALGORITHMS.items()
        for setting, cell in _FILE["algorithms"][shown].items()
    }


def by_field() -> dict[tuple[str, str], Numbers]:
    """Each field over all algorithms (appendix): (field, setting) -> its numbers."""
    return {
        (field, setting): _numbers(cell, 1.0)
        for setting, cells in _FILE["environments"].items()
        for field, cell in cells.items()
    }


def _numbers(cell: dict[str, float], unit: float) -> Numbers:
    return {name: cell[key] * unit for name, key in STATISTICS.items()}


def tuned_values(algorithm: str) -> dict[str, float]:
    values: dict[str, float] = _FILE["optuna_hyperparameters"][ALGORITHMS[algorithm]]
    return values


def tuning_ranges(algorithm: str) -> dict[str, tuple[float, float]]:
    """The hyperparameters that the paper tuned for an algorithm, with the ends of their ranges."""
    return {name: RANGES[name] for name in tuned_values(algorithm)}
