"""Runs that may be compared: the same seeds, budgets and evaluations."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from baselines.compare.records import RunRecord, ordered
from mbn_marl.errors import ConfigError
from mbn_marl.optimum import VIEW

BUDGET = ("steps", "evaluate_every", "episodes")
LEARNER = ("algorithm", "setting", "environment", "hyperparameters")
"""Settings that must be the same in all runs, and in all runs of one label."""


@dataclass(frozen=True)
class Results:
    """Finished runs that may be compared: each label on each field with equally many seeds.

    Attributes:
        looks: the labels in order, with the numbers of their looks in figures.
        fields: names, in order.
        cells: the runs of each label and field, by seed.
        broken: the error of each run that diverged, by its name; its label is not among the
            others, since what is left of it would be too good.
    """

    looks: Mapping[str, int]
    fields: tuple[str, ...]
    cells: Mapping[tuple[str, str], tuple[RunRecord, ...]]
    broken: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(
        cls,
        records: Sequence[RunRecord],
        broken: Mapping[str, str] | None = None,
        order: Sequence[str] = (),
    ) -> Results:
        """Put finished runs together, their labels in an ``order``, or that of their algorithms.

        Raises:
            ConfigError: naming everything that keeps them from being compared.
        """
        if not records:
            raise ConfigError("comparison", ["runs: there is none"])
        looks = ordered({one.label: one.config["algorithm"] for one in records})
        looks = {label: looks[label] for label in [*order, *looks] if label in looks}
        fields = tuple(sorted({one.field.name for one in records}))
        cells: dict[tuple[str, str], list[RunRecord]] = {
            place: [] for place in itertools.product(looks, fields)
        }
        for one in sorted(records, key=lambda one: int(one.config["seed"])):
            cells[one.label, one.field.name].append(one)
        unnamed = [one for one in records if one.label == one.default_label]
        problems = _unequal_seeds(cells)
        for alike, names in ((records, _budget), (unnamed, _task)):
            problems += _differences(alike, "all runs", names)
        for label in looks:
            own = [one for one in records if one.label == label]
            problems += _differences(
                own,
                f"runs labelled {label}",
                lambda one: {name: one.config[name] for name in LEARNER},
            )
        problems += _different_fields(records)
        if problems:
            raise ConfigError("comparison", problems)
        return cls(looks, fields, {at: tuple(cell) for at, cell in cells.items()}, broken or {})

    @property
    def labels(self) -> tuple[str, ...]:
        """The labels in order."""
        return tuple(self.looks)

    @property
    def seeds(self) -> int:
        """Runs of a cell."""
        return len(next(iter(self.cells.values())))

    def of_label(self, label: str) -> list[RunRecord]:
        """The runs of a label, field by field."""
        return [one for field in self.fields for one in self.cells[label, field]]

    def of_field(self, field: str) -> dict[str, tuple[RunRecord, ...]]:
        """The runs on a field, by label."""
        return {label: self.cells[label, field] for label in self.looks}

    def returns(
        self, label: str, kind: Literal["stochastic", "deterministic"] = "stochastic"
    ) -> NDArray[np.float64]:
        """Final mean returns of a label with sampled or mean actions (reward), (fields, seeds)."""
        finals = [one.final(kind, "return_mean") for one in self.of_label(label)]
        return np.array(finals).reshape(len(self.fields), -1)

    @property
    def optima(self) -> dict[str, float]:
        """The proved best return (reward units) of each field that has one, for every label."""
        optima = {
            field: {runs[0].optimum for runs in self.of_field(field).values()}
            for field in self.fields
        }
        alike = {field: one for field, (one, *more) in optima.items() if not more}
        return {field: one for field, one in alike.items() if one is not None}

    def on(self, fields: Collection[str]) -> Results:
        """The part on some fields."""
        cells = {place: cell for place, cell in self.cells.items() if place[1] in fields}
        return Results(self.looks, tuple(fields), cells)


def _unequal_seeds(cells: Mapping[tuple[str, str], Sequence[RunRecord]]) -> list[str]:
    """Name cells with fewer seeds than another has, and seeds that are there twice."""
    problems = []
    seeds = {place: [one.config["seed"] for one in cell] for place, cell in cells.items()}
    most = max(len(set(numbers)) for numbers in seeds.values())
    for (label, field), numbers in seeds.items():
        place, distinct = f"{label} on {field}", sorted(set(numbers))
        if len(distinct) < most:
            there = ", ".join(map(str, distinct)) or "none"
            problems.append(
                f"seeds: {place} has {len(distinct)} ({there}), another has {most}; allowed: "
                "equally many everywhere"
            )
        twice = [seed for seed in distinct if numbers.count(seed) > 1]
        problems += [f"seeds: {place} has seed {seed} twice" for seed in twice]
    return problems


def _differences(
    records: Sequence[RunRecord], whose: str, values_of: Callable[[RunRecord], Mapping[str, Any]]
) -> list[str]:
    """Name each value in which a run differs from the first one, once."""
    problems: list[str] = []
    for name, value in (values_of(records[0]) if records else {}).items():
        others = (one for one in records if values_of(one).get(name) != value)
        if other := next(others, None):
            problems.append(
                f"{name}: must be the same in {whose}; {records[0].run.path} has {value!r}, "
                f"{other.run.path} {values_of(other).get(name)!r}"
            )
    return problems


def _budget(record: RunRecord) -> dict[str, Any]:
    """Return what all runs have in common: budget and evaluations."""
    return {name: record.config[name] for name in BUDGET}


def _task(record: RunRecord) -> dict[str, Any]:
    """Return what runs whose label does not name a difference have in common too."""
    world = record.config["environment"]
    alike = [name for name in VIEW if name != "gust_time" or not world.get("gust")]
    return {f"environment.{name}": world[name] for name in world if name not in alike}


def _different_fields(records: Sequence[RunRecord]) -> list[str]:
    """Name two runs whose different fields have one name."""
    firsts: dict[str, RunRecord] = {}
    return [
        f"fields: {first.run.path} and {one.run.path} have different fields of the "
        f"name {one.field.name}"
        for one in records
        if (first := firsts.setdefault(one.field.name, one)).field != one.field
    ]
