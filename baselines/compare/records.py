"""The one reader of runs: what run folders record, and which of them may be compared."""

import dataclasses
import itertools
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError
from pydantic import Field as Range

from baselines.algorithms import ALGORITHMS, find_algorithm
from baselines.evaluation.intervals import passes
from baselines.policies.information import information
from baselines.runs.discover import run_folders
from baselines.runs.files import RunError, read_json
from baselines.runs.folder import RunFolder
from baselines.training.config import MOST, default_label, problems_of
from mbn_marl.config import RealNumber, WholeNumber, describe, make_config
from mbn_marl.errors import ConfigError, collecting
from mbn_marl.field import Field, FieldSampler, load_split
from mbn_marl.optimum import VIEW

NEEDED = ("algorithm", "setting", "field", "seed")
CONFIG = ("steps", "evaluate_every", "episodes", "environment", "hyperparameters")
BUDGET = ("steps", "evaluate_every", "episodes")
"""Settings that must be the same in all runs."""
METRICS = ("success_rate", "makespan", "gap", "spl", "return_mean")
BOTH = (*METRICS, *(f"deterministic_{name}" for name in METRICS))
"""The numbers of an evaluation: with sampled actions, and with mean ones."""
LEARNER = ("algorithm", "setting", "environment", "hyperparameters")
"""Settings that must be the same in all runs of one label."""
Count = Annotated[WholeNumber, Range(ge=0, le=MOST)]
Number = Annotated[RealNumber, Range(ge=-MOST, le=MOST)]
Positive = Annotated[RealNumber, Range(ge=0, le=MOST)]
Share = Annotated[RealNumber, Range(ge=0, le=1)]


class Score(BaseModel):
    return_mean: Number
    success_rate: Share


class Measured(Score):
    makespan: Positive | None
    gap: Number | None
    spl: Positive | None


class Progress(Measured):
    env_steps: Count
    seconds: Positive
    deterministic_return_mean: Number
    deterministic_success_rate: Share
    deterministic_makespan: Positive | None
    deterministic_gap: Number | None
    deterministic_spl: Positive | None


class Scores(BaseModel):
    stochastic: Score


class Final(BaseModel):
    env_steps: Count
    policy_env_steps: Count
    seconds: Positive
    stochastic: Measured
    deterministic: Measured


@dataclass(frozen=True)
class RunRecord:
    run: RunFolder
    config: Mapping[str, Any]
    fields: Field | FieldSampler

    @classmethod
    def read(cls, run: RunFolder, *, finished: bool = True) -> Self:
        """Read a run, with all that a comparison needs if ``finished``; a RunError names a file."""
        of_tier = finished and run.config.get("tier") is not None
        record = cls(run, run.config, run.fields if of_tier else run.field)
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
            validate(Final if finished else Scores, run.evaluation, place)
        if finished:
            for number, entry in enumerate(run.evaluations):
                validate(Progress, entry, run.path / "evaluations.json", f"{number}.")
            steps = [entry["env_steps"] for entry in run.evaluations]
            if not steps or steps != sorted(set(steps)):
                wrong = "env_steps have to increase" if steps else "is empty: never evaluated"
                raise RunError(f"{run.path / 'evaluations.json'}: {wrong}")
        return record

    @property
    def label(self) -> str:
        return self.config.get("label") or self.default_label

    @property
    def default_label(self) -> str:
        return default_label(self.config["algorithm"], self.config["setting"])

    @property
    def place(self) -> str:
        """The name of the field, or the tier that a run on random fields is evaluated on."""
        return self.fields.name if isinstance(self.fields, Field) else str(self.config["tier"])

    def field_to_show(self) -> Field:
        if isinstance(self.fields, Field):
            return self.fields
        return load_split("test", self.place)[0].field

    @cached_property
    def row(self) -> dict[str, Any]:
        """The run in numbers, a row of ``runs.csv``; ``None`` is unknown."""
        config, final = self.config, self.run.evaluation
        form = find_algorithm(config["algorithm"]).form
        kinds = {"": final["stochastic"], "deterministic_": final["deterministic"]}
        seen = information(config["environment"], centralized=form == "centralized")
        revision = read_json(self.run.path / "versions.json", dict).get("git_revision")
        return {
            **{"label": self.label, "algorithm": config["algorithm"], "setting": config["setting"]},
            **{"form": form, "information": seen, "field": self.place, "seed": config["seed"]},
            **{name: final[name] for name in ("env_steps", "policy_env_steps", "seconds")},
            "passed": passes(*(kind["success_rate"] for kind in kinds.values())),
            **{f"{way}{name}": kinds[way][name] for way in kinds for name in METRICS},
            "first_pass": next(
                (
                    entry["env_steps"]
                    for entry in self.run.evaluations
                    if passes(entry["success_rate"], entry["deterministic_success_rate"])
                ),
                None,
            ),
            "revision": revision and revision.removesuffix("-dirty"),
            "clean": revision is not None and not revision.endswith("-dirty"),
        }

    @property
    def curve(self) -> list[dict[str, Any]]:
        """The evaluations on the way, rows of ``curves.csv``."""
        who = {name: self.row[name] for name in ("label", "field", "seed")}
        names = ("env_steps", *BOTH)
        return [{**who, **{name: one[name] for name in names}} for one in self.run.evaluations]

    @property
    def instances(self) -> list[dict[str, Any]]:
        """Each frozen field of the tier by mean actions, rows of ``instances.csv``."""
        who = {name: self.row[name] for name in ("label", "field", "seed")}
        found = self.run.evaluation["deterministic"]["per_episode"]
        lists = (found[name] for name in ("bounds", "successes", "steps"))
        # The fields in order, and again where episodes differ by chance.
        names = itertools.cycle(_frozen(self.place))
        return [
            {**who, "instance": name, "bound": bound, "makespan": steps if success else None}
            for name, bound, success, steps in zip(names, *lists, strict=False)
        ]


@cache
def _frozen(tier: str) -> list[str]:
    return [*dict.fromkeys(one.field.name for one in load_split("test", tier))]


def validate(model: type[BaseModel], content: Any, path: Path, place: str = "") -> None:
    try:
        model.model_validate(content)
    except ValidationError as error:
        problems = "; ".join(place + problem for problem in describe(error, model))
        raise RunError(f"{path} is not valid: {problems}") from None


def find_records(
    paths: Sequence[Path], note: Callable[[str], None] = lambda text: None, *, finished: bool = True
) -> list[RunRecord]:
    """Read the runs at ``paths``; a RunError names one that cannot be read.

    Those inside a comparison are read if all have to be ``finished``. Runs on random fields are
    left out, but for finished ones that are evaluated on a tier; ``note`` receives a line about
    each.
    """
    runs = [RunFolder.open(path) for path in run_folders(paths, note, comparisons=finished)]
    some = [
        run
        for run in runs
        if isinstance(run.fields, Field) or (finished and run.config.get("tier") is not None)
    ]
    for run in runs:
        if some and run not in some:
            note(f"left out: {run.path}, trained on random fields")
    records, problems = list[RunRecord](), list[str]()
    for run in some or runs:
        with collecting(problems):
            records.append(RunRecord.read(run, finished=finished))
    if problems:
        raise RunError("\n".join(problems))
    return records


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
    fields: tuple[str, ...]  # names or tiers, in order
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
    ) -> Self:
        """Put finished runs together; a ConfigError names all that makes them unequal."""
        if not records:
            raise ConfigError("comparison", ["runs: there is none"])
        looks = ordered({one.label: one.config["algorithm"] for one in records})
        looks = {label: looks[label] for label in [*order, *looks] if label in looks}
        fields = tuple(sorted({one.place for one in records}))
        cells: dict[tuple[str, str], list[RunRecord]] = {
            place: [] for place in itertools.product(looks, fields)
        }
        for one in sorted(records, key=lambda one: int(one.config["seed"])):
            cells[one.label, one.place].append(one)
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

    @property
    def records(self) -> list[RunRecord]:
        return [one for cell in self.cells.values() for one in cell]

    def spl(self, label: str) -> NDArray[np.float64]:
        """SPL of a label's runs with sampled actions, (fields, seeds); all must have a bound."""
        found = [one.row["spl"] for one in self.of_label(label)]
        return np.array(found, float).reshape(len(self.fields), -1)

    @property
    def bounded(self) -> list[str]:
        """The fields on which all runs have a proved bound."""
        unknown = {one.place for one in self.records if one.row["spl"] is None}
        return [name for name in self.fields if name not in unknown]

    def on(self, fields: Collection[str]) -> "Results":
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
    defaults = make_config({}).model_dump(mode="json")  # an older run lacks newer settings

    def task(record: RunRecord) -> dict[str, Any]:
        world = {**defaults, **record.config["environment"]}
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

    def seedless(one: RunRecord) -> Field | FieldSampler:
        fields = one.fields
        return fields if isinstance(fields, Field) else fields.model_copy(update={"seed": 0})

    firsts: dict[str, RunRecord] = {}
    for one in records:
        if seedless(first := firsts.setdefault(one.place, one)) != seedless(one):
            places = f"{first.run.path} and {one.run.path}"
            yield f"fields: {places} have different fields of the name {one.place}"


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
