"""The paper's own numbers, as ``published.json`` holds them: tables, tuned values, protocol."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from baselines.paper.summary import Summary

ALGORITHM_UNIT = 1e6
"""One unit of the paper's numbers per algorithm, in reward units; those per field are in reward."""


@cache
def _published() -> dict[str, Any]:
    published: dict[str, Any] = json.loads(Path(__file__).with_name("published.json").read_text())
    return published


def source() -> str:
    """Where the numbers come from."""
    return str(_published()["source"])


def protocol() -> dict[str, int]:
    """What the paper ran: timesteps, seed, trials and timesteps of Optuna, threshold, ..."""
    return dict(_published()["protocol"])


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


def of_algorithm(name: str, setting: str) -> Summary | None:
    """An algorithm over all fields (table 1), in reward units; ``None`` if it is not there."""
    row = _published()["algorithms"].get(display_name(name), {}).get(setting)
    return None if row is None else _summary(row, ALGORITHM_UNIT)


def of_field(name: str, setting: str) -> Summary | None:
    """A field over all algorithms (appendix), in reward units; ``None`` if it is not there."""
    row = _published()["environments"].get(setting, {}).get(name)
    return None if row is None else _summary(row, 1.0)


def tuned(algorithm: str) -> dict[str, float]:
    """The hyperparameters that the paper tuned for ``algorithm``, with the values it found."""
    return dict(_published()["optuna_hyperparameters"][algorithms()[algorithm]])


def tuning_range(hyperparameter: str) -> tuple[float, float]:
    """The range in which the paper tuned a hyperparameter."""
    low, high = _published()["optuna_ranges"][hyperparameter]
    return low, high


def _summary(row: Mapping[str, float], unit: float) -> Summary:
    return Summary(*(row[name] * unit for name in ("mean", "sd", "max", "range")))
