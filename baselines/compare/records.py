"""The one reader of runs: what run folders record, and which of them may be compared."""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError
from pydantic import Field as Range

from baselines.algorithms import ALGORITHMS
from baselines.runs.discover import run_folders
from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.training.config import MOST, default_label, problems_of
from mbn_marl.config import RealNumber, WholeNumber, describe, make_config
from mbn_marl.errors import ConfigError, collecting
from mbn_marl.field import Field
from mbn_marl.optimum import VIEW, optimal_return

NEEDED = ("algorithm", "setting", "field", "seed")
CONFIG = ("steps", "evaluate_every", "episodes", "environment", "hyperparameters")
BUDGET = ("steps", "evaluate_every", "episodes")
"""Settings that must be the same in all runs."""
LEARNER = ("algorithm", "setting", "environment", "hyperparameters")
"""Settings that must be the same in all runs of one label."""
Content = TypeVar("Content", bound=BaseModel)
Count = Annotated[WholeNumber, Range(ge=0, le=MOST)]
Number = Annotated[RealNumber, Range(ge=-MOST, le=MOST)]
Positive = Annotated[RealNumber, Range(ge=0, le=MOST)]


class Listed(BaseModel):
    algorithm: str
    field: str
    seed: Count
    steps: Count


class Score(BaseModel):
    return_mean: Number
    success_rate: Annotated[RealNumber, Range(ge=0, le=1)]


class Summary(Score):
    makespan: Positive | None


class Progress(BaseModel):
    env_steps: Count
    seconds: Positive
    return_mean: Number


class Scores(BaseModel):
    stochastic: Score


class Final(BaseModel):
    env_steps: Count
    seconds: Positive
    stochastic: Summary
    deterministic: Summary


@dataclass(frozen=True)
class RunRecord:
    """A run's folder, configuration and field; evaluations are read when first asked for."""

    run: RunFolder
    config: Mapping[str, Any]
    field: Field

    @classmethod
    def read(cls, run: RunFolder, *, finished: bool = True) -> RunRecord:
        """Read a run, with all that a comparison needs if ``finished``; a RunError names a file."""
        record = cls(run, run.config, run.field)
        path = run.path / "config.json"
        needed = (*NEEDED, *CONFIG) if finished else NEEDED
        if missing := [name for name in needed if record.config.get(name) is None]:
            raise RunError(f"{path} has no {', '.join(missing)}: it is not a run of this version")
        problems = problems_of(record.config)
        if isinstance(environment := record.config.get("environment", {}), Mapping):
            with collecting(problems):
                make_config(environment)
        if problems:
            raise RunError(f"{path} is not valid: {'; '.join(problems)}")
        if finished or run.finished:
            place = run.path / "evaluation.json"
            validate(Final if finished else Scores, record.evaluation, place)
        if finished:
            for number, entry in enumerate(record.evaluations):
                validate(Progress, entry, run.path / "evaluations.json", f"{number}.")
            steps = [entry["env_steps"] for entry in record.evaluations]
            if not steps or steps != sorted(set(steps)):
                wrong = "env_steps have to increase" if steps else "is empty: never evaluated"
                raise RunError(f"{run.path / 'evaluations.json'}: {wrong}")
        return record

    @cached_property
    def evaluations(self) -> list[dict[str, Any]]:
        return self.run.evaluations

    @cached_property
    def evaluation(self) -> dict[str, Any]:
        return self.run.evaluation

    @property
    def label(self) -> str:
        return self.config.get("label") or self.default_label

    @property
    def default_label(self) -> str:
        return default_label(self.config["algorithm"], self.config["setting"])

    @cached_property
    def optimum(self) -> float | None:
        """The proved best return, or ``None`` if nothing is proved."""
        return optimal_return(self.field, make_config(self.config["environment"]))

    def final(self, *path: str) -> float:
        value: Any = self.evaluation
        for name in path:
            value = value[name]
        return float(value)


def validate(model: type[Content], content: Any, path: Path, place: str = "") -> Content:
    try:
        return model.model_validate(content)
    except ValidationError as error:
        problems = "; ".join(place + problem for problem in describe(error, model))
        raise RunError(f"{path} is not valid: {problems}") from None


def find_records(
    paths: Sequence[Path],
    note: Callable[[str], None] = lambda text: None,
    *,
    comparisons: bool = True,
    finished: bool = True,
) -> list[RunRecord]:
    """Read the runs at ``paths``, see ``run_folders``; a RunError names one that cannot be read.

    Runs on random fields are left out; ``note`` receives a line about each.
    """
    runs = [RunFolder.open(path) for path in run_folders(paths, note, comparisons=comparisons)]
    some = [run for run in runs if isinstance(run.fields, Field)]
    for run in runs:
        if some and run not in some:
            note(f"left out: {run.path}, trained on random fields")
    return [RunRecord.read(run, finished=finished) for run in some or runs]


def ordered(algorithms: Mapping[str, str]) -> dict[str, int]:
    """Order labels, given with their algorithms, and number their looks for ``style.series``."""
    # An algorithm looks the same in every report: its first label has the algorithm's place in
    # the registry as its look; each further label has the next look that is free.
    places = {label: list(ALGORITHMS).index(name) for label, name in algorithms.items()}
    free = (look for look in itertools.count() if look not in places.values())
    looks: dict[str, int] = {}
    for label in sorted(places, key=lambda label: (places[label], label)):
        looks[label] = next(free) if places[label] in looks.values() else places[label]
    return looks


@dataclass(frozen=True)
class Results:
    """Finished runs that may be compared: each label on each field with equally many seeds."""

    looks: Mapping[str, int]  # the labels in order, with the numbers of their looks in figures
    fields: tuple[str, ...]  # names, in order
    cells: Mapping[tuple[str, str], tuple[RunRecord, ...]]  # of each label and field, by seed
    # The error of each run that diverged, by its name. Its label is not in ``cells``: the runs
    # that are left of it would be too good.
    broken: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(
        cls,
        records: Sequence[RunRecord],
        broken: Mapping[str, str] | None = None,
        order: Sequence[str] = (),
    ) -> Results:
        """Put finished runs together; a ConfigError names all that makes them unequal."""
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
        if problems := [*_unequal_seeds(cells), *_unequal_settings(records, looks)]:
            raise ConfigError("comparison", problems)
        return cls(looks, fields, {at: tuple(cell) for at, cell in cells.items()}, broken or {})

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(self.looks)

    @property
    def seeds(self) -> int:
        return len(next(iter(self.cells.values())))

    def of_label(self, label: str) -> list[RunRecord]:
        return [one for field in self.fields for one in self.cells[label, field]]

    def of_field(self, field: str) -> dict[str, tuple[RunRecord, ...]]:
        return {label: self.cells[label, field] for label in self.looks}

    def returns(
        self, label: str, kind: Literal["stochastic", "deterministic"] = "stochastic"
    ) -> NDArray[np.float64]:
        """Final mean returns of a label with sampled or mean actions (reward), (fields, seeds)."""
        finals = [one.final(kind, "return_mean") for one in self.of_label(label)]
        return np.array(finals).reshape(len(self.fields), -1)

    @property
    def optima(self) -> dict[str, float]:
        """The proved best return (reward units) of each field with one that all labels share."""
        found = {
            name: {runs[0].optimum for runs in self.of_field(name).values()} for name in self.fields
        }
        alike = {name: optimum for name, (optimum, *others) in found.items() if not others}
        return {name: optimum for name, optimum in alike.items() if optimum is not None}

    def on(self, fields: Collection[str]) -> Results:
        cells = {place: cell for place, cell in self.cells.items() if place[1] in fields}
        return Results(self.looks, tuple(fields), cells)


def _unequal_seeds(cells: Mapping[tuple[str, str], Sequence[RunRecord]]) -> Iterator[str]:
    seeds = {place: Counter(one.config["seed"] for one in cell) for place, cell in cells.items()}
    most = max(map(len, seeds.values()))
    for (label, field), counts in seeds.items():
        place = f"seeds: {label} on {field} has"
        if len(counts) < most:
            there = ", ".join(map(str, sorted(counts))) or "none"
            allowed = "allowed: equally many everywhere"
            yield f"{place} {len(counts)} ({there}), another has {most}; {allowed}"
        yield from (f"{place} seed {seed} twice" for seed in sorted(counts) if counts[seed] > 1)


def _unequal_settings(records: Sequence[RunRecord], labels: Collection[str]) -> Iterator[str]:

    def task(record: RunRecord) -> dict[str, Any]:
        world = record.config["environment"]
        seen = [name for name in VIEW if name != "gust_time" or not world.get("gust")]
        return {f"environment.{name}": world[name] for name in world if name not in seen}

    def values(names: Sequence[str]) -> Callable[[RunRecord], dict[str, Any]]:
        return lambda record: {name: record.config[name] for name in names}

    # A different label may name a difference of the task; the budget is the same for all.
    unnamed = [one for one in records if one.label == one.default_label]
    yield from _differences(records, "all runs", values(BUDGET))
    yield from _differences(unnamed, "all runs", task)
    for label in labels:
        own = [one for one in records if one.label == label]
        yield from _differences(own, f"runs labelled {label}", values(LEARNER))
    firsts: dict[str, RunRecord] = {}
    for one in records:
        if (first := firsts.setdefault(one.field.name, one)).field != one.field:
            places = f"{first.run.path} and {one.run.path}"
            yield f"fields: {places} have different fields of the name {one.field.name}"


def _differences(
    records: Sequence[RunRecord], whose: str, values_of: Callable[[RunRecord], Mapping[str, Any]]
) -> Iterator[str]:
    """Name each value in which a run differs from the first one, once."""
    for name, value in (values_of(records[0]) if records else {}).items():
        others = (one for one in records if values_of(one).get(name) != value)
        if other := next(others, None):
            first = f"{records[0].run.path} has {value!r}"
            theirs = f"{other.run.path} {values_of(other).get(name)!r}"
            yield f"{name}: must be the same in {whose}; {first}, {theirs}"
