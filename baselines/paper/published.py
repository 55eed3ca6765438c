"""The paper's own numbers, as ``published.json`` holds them: tables, tuned values, protocol."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

ALGORITHM_UNIT = 1e6
"""One unit of the paper's numbers per algorithm, in reward units; those per field are in reward."""

STATISTICS = {"mean": "mean", "SD": "sd", "max": "max", "range": "range"}
"""The numbers of a cell: as the paper calls them -> as the file does."""

Numbers = dict[str, float]
"""A cell's numbers in reward units, by the names in ``STATISTICS``."""


@cache
def _published() -> dict[str, Any]:
    published: dict[str, Any] = json.loads(Path(__file__).with_name("published.json").read_text())
    return published


def source() -> str:
    """Where the numbers come from."""
    return str(_published()["source"])


def algorithms() -> dict[str, str]:
    """The paper's algorithms in its order: our name -> the paper's."""
    return {name.lower(): name for name in _published()["algorithms"]}


def settings() -> list[str]:
    """The paper's settings."""
    return list(_published()["environments"])


def display_name(algorithm: str) -> str:
    """An algorithm as the paper writes it; one that it does not have in capitals."""
    return algorithms().get(algorithm, algorithm.upper())


def fields() -> list[str]:
    """The paper's fields."""
    return list(_published()["environments"]["A"])


def by_algorithm() -> dict[tuple[str, str], Numbers]:
    """Each algorithm over all fields (table 1): (our name, setting) -> its numbers."""
    table = _published()["algorithms"]
    return {
        (name, setting): _numbers(cell, ALGORITHM_UNIT)
        for name, shown in algorithms().items()
        for setting, cell in table[shown].items()
    }


def by_field() -> dict[tuple[str, str], Numbers]:
    """Each field over all algorithms (appendix): (field, setting) -> its numbers."""
    return {
        (field, setting): _numbers(cell, 1.0)
        for setting, cells in _published()["environments"].items()
        for field, cell in cells.items()
    }


def tuned(algorithm: str) -> dict[str, float]:
    """The hyperparameters that the paper tuned for ``algorithm``, with the values it found."""
    return dict(_published()["optuna_hyperparameters"][algorithms()[algorithm]])


def tuning_range(hyperparameter: str) -> tuple[float, float]:
    """The range in which the paper tuned a hyperparameter."""
    low, high = _published()["optuna_ranges"][hyperparameter]
    return low, high


def _numbers(cell: dict[str, float], unit: float) -> Numbers:
    return {name: cell[key] * unit for name, key in STATISTICS.items()}
