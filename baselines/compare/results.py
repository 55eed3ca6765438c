"""Finished runs as results that can be compared: the same seeds, budgets and evaluations."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from baselines.algorithms import Form, find_algorithm
from baselines.runs.discover import run_folders
from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.training.config import default_label
from mbn_marl.config import make_config
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field
from mbn_marl.optimum import VIEW, optimal_return

CONFIG = (
    *("algorithm", "setting", "seed", "steps", "evaluate_every", "episodes"),
    *("environment", "hyperparameters"),
)
EVALUATION = ("env_steps", "seconds", "stochastic", "deterministic")
SUMMARY = ("return_mean", "success_rate", "makespan")
HISTORY = ("env_steps", "seconds", "return_mean")
"""What a run's files have to have to be compared: the configuration, the final evaluation, each of
its two summaries, and every entry of the evaluations on the way."""

Kind = Literal["stochastic", "deterministic"]
"""Of a final evaluation: with sampled actions, or with mean ones."""


@dataclass(frozen=True)
class Result:
    """What a finished run recorded.

    Attributes:
        run: its folder.
        config: its configuration.
        field: the field it was trained on.
        evaluations: the summaries of its fresh evaluations, in order.
        evaluation: the final evaluation.
    """

    run: RunFolder
    config: Mapping[str, Any]
    field: Field
    evaluations: Sequence[dict[str, Any]]
    evaluation: Mapping[str, Any]

    @classmethod
    def read(cls, run: RunFolder) -> Result:
        """Read a run.

        Raises:
            RunError: it is not finished, a file cannot be read, or lacks what runs record now.
        """
        result = cls(run, run.config, run.field, run.evaluations, run.evaluation)
        for name, entries, needed in result._parts():
            known = entries if isinstance(entries, Mapping) else {}
            if missing := [entry for entry in needed if entry not in known]:
                problem = f"has no {', '.join(missing)}: it is not a run of this version"
                raise RunError(f"{run.path / name} {problem}")
        if not result.evaluations:
            raise RunError(f"{run.path / 'evaluations.json'} is empty: the run was never evaluated")
        return result

    def _parts(self) -> Iterator[tuple[str, Any, Sequence[str]]]:
        """Each part that is read: its file, what is there, and what has to be in it."""
        yield "config.json", self.config, CONFIG
        yield "evaluation.json", self.evaluation, EVALUATION
        yield "evaluation.json", self.evaluation["stochastic"], SUMMARY
        yield "evaluation.json", self.evaluation["deterministic"], SUMMARY
        for entry in self.evaluations:
            yield "evaluations.json", entry, HISTORY

    @property
    def label(self) -> str:
        """What tables and figures call it."""
        config = self.config
        return config.get("label") or default_label(config["algorithm"], config["setting"])

    @property
    def form(self) -> Form:
        """Whether one policy moved all robots, or each robot its own."""
        return find_algorithm(self.config["algorithm"]).form

    @cached_property
    def optimum(self) -> float | None:
        """The proved best return, or ``None`` if nothing is proved."""
        return optimal_return(self.field, make_config(self.config["environment"]))

    def final(self, *path: str) -> float:
        """A number of the final evaluation."""
        value: Any = self.evaluation
        for name in path:
            value = value[name]
        return float(value)


@dataclass(frozen=True)
class Results:
    """Results that may be compared: each label on each field with equally many seeds.

    Attributes:
        labels: in order.
        fields: names, in order.
        cells: the results of each label and field, by seed.
        broken: what is said of each run that broke down, by its name; its label is not among the
            others, since what is left of it would be too good.
    """

    labels: tuple[str, ...]
    fields: tuple[str, ...]
    cells: Mapping[tuple[str, str], tuple[Result, ...]]
    broken: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, results: Sequence[Result], broken: Mapping[str, str] | None = None) -> Results:
        """Put results together.

        Args:
            results: of runs that finished.
            broken: see the attribute.

        Raises:
            ConfigError: naming everything that keeps them from being compared.
        """
        if not results:
            raise ConfigError("comparison", ["runs: there is none"])
        labels = tuple(dict.fromkeys(result.label for result in results))
        fields = tuple(dict.fromkeys(result.field.name for result in results))
        cells: dict[tuple[str, str], list[Result]] = {
            (label, field): [] for label in labels for field in fields
        }
        for result in results:
            cells[result.label, result.field.name].append(result)
        problems = [
            *_unequal_seeds(cells),
            *_differences(results, "all runs", _everywhere),
            *(
                problem
                for label in labels
                for problem in _differences(
                    [result for result in results if result.label == label],
                    f"runs labelled {label}",
                    _in_a_label,
                )
            ),
            *_different_fields(results),
        ]
        if problems:
            raise ConfigError("comparison", problems)
        ordered = {
            place: tuple(sorted(cell, key=lambda result: int(result.config["seed"])))
            for place, cell in cells.items()
        }
        return cls(labels, fields, ordered, broken or {})

    @property
    def seeds(self) -> int:
        """Runs of a cell."""
        return len(next(iter(self.cells.values())))

    def of_label(self, label: str) -> list[Result]:
        """The results of a label, field by field."""
        return [result for field in self.fields for result in self.cells[label, field]]

    def returns(self, label: str, kind: Kind = "stochastic") -> NDArray[np.float64]:
        """The final mean returns of a label, (fields, seeds)."""
        return np.array(
            [
                [result.final(kind, "return_mean") for result in self.cells[label, field]]
                for field in self.fields
            ]
        )

    def optima(self) -> NDArray[np.float64]:
        """The proved best returns, (fields,); NaN where nothing is proved."""
        firsts = [self.cells[self.labels[0], field][0] for field in self.fields]
        return np.array([first.optimum for first in firsts], np.float64)

    def proved(self) -> Results | None:
        """The part on fields with a proved optimum; ``None`` if there is none."""
        known = np.isfinite(self.optima())
        fields = tuple(itertools.compress(self.fields, known))
        cells = {place: cell for place, cell in self.cells.items() if place[1] in fields}
        return Results(self.labels, fields, cells) if fields else None


def find_results(
    paths: Sequence[Path],
    note: Callable[[str], None] = lambda text: None,
    *,
    trust: bool = False,
) -> Results:
    """Read the runs at ``paths``: run folders, or folders with run folders anywhere inside.

    Args:
        paths: where to look.
        note: is told what is left out, see :func:`baselines.runs.discover.run_folders`.
        trust: whether pickled files of the runs may be loaded whoever made them.

    Raises:
        RunError: a path holds no run, or a run is not finished.
        ConfigError: naming everything that keeps the runs from being compared.
    """
    folders = run_folders(paths, note, comparisons=True)
    return Results.of([Result.read(RunFolder.open(folder, trust=trust)) for folder in folders])


def _unequal_seeds(cells: Mapping[tuple[str, str], Sequence[Result]]) -> list[str]:
    """Cells with fewer seeds than another has, and seeds that are there twice."""
    problems = []
    seeds = {place: [result.config["seed"] for result in cell] for place, cell in cells.items()}
    most = max(len(set(numbers)) for numbers in seeds.values())
    for (label, field), numbers in seeds.items():
        place = f"{label} on {field}"
        if len(set(numbers)) < most:
            there = ", ".join(map(str, sorted(set(numbers)))) or "none"
            problems.append(
                f"seeds: {place} has {len(set(numbers))} ({there}), another has {most}; allowed: "
                "equally many everywhere"
            )
        problems += [
            f"seeds: {place} has seed {seed} twice"
            for seed in sorted(set(numbers))
            if numbers.count(seed) > 1
        ]
    return problems


def _differences(
    results: Sequence[Result], whose: str, values_of: Callable[[Result], Mapping[str, Any]]
) -> list[str]:
    """The values in which a result differs from the first one, each named once."""
    first = results[0]
    values = values_of(first)
    problems = []
    for name, value in values.items():
        for other in results:
            theirs = values_of(other).get(name)
            if theirs != value:
                problems.append(
                    f"{name}: must be the same in {whose}; {first.run.path} has {value!r}, "
                    f"{other.run.path} {theirs!r}"
                )
                break
    return problems


def _everywhere(result: Result) -> dict[str, Any]:
    """What all runs of a comparison have in common: budget, evaluations, and what is to reach."""
    world = result.config["environment"]
    return {
        **{name: result.config[name] for name in ("steps", "evaluate_every", "episodes")},
        **{f"environment.{name}": world[name] for name in world if name not in VIEW},
    }


def _in_a_label(result: Result) -> dict[str, Any]:
    """What runs of one label have in common: they differ in field and seed alone."""
    names = ("algorithm", "setting", "environment", "hyperparameters")
    return {name: result.config[name] for name in names}


def _different_fields(results: Sequence[Result]) -> list[str]:
    """Names that two fields have."""
    firsts: dict[str, Result] = {}
    return [
        f"fields: {first.run.path} and {result.run.path} have different fields of the "
        f"name {result.field.name}"
        for result in results
        if (first := firsts.setdefault(result.field.name, result)).field != result.field
    ]
