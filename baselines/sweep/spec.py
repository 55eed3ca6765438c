"""The YAML file of a grid, and the runs in it."""

import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, Field, ValidationError

from baselines.algorithms import Setting, find_algorithm
from baselines.training import config
from baselines.training.aids import Count, NonNegative, Positive
from baselines.training.config import ENVIRONMENT, TrainConfig
from baselines.training.train import found_anywhere, prepare, sizes
from mbn_marl.config import describe
from mbn_marl.errors import ConfigError, MbnError, ProblemsError
from mbn_marl.field import catalogue_names, load_field


def _known(load: Callable[[str], object]) -> AfterValidator:
    def check(name: str) -> str:
        try:
            load(name)
        except ProblemsError as error:
            raise ValueError("; ".join(error.problems)) from None  # a line, as of all values
        return name

    return AfterValidator(check)


def _each_once(values: Sequence[Any]) -> Sequence[Any]:
    twice = [value for place, value in enumerate(values) if value in values[:place]]
    if twice:
        raise ValueError(f"{', '.join(map(str, twice))} given twice")
    return values


def _folder(store: Path) -> Path:
    if ":/" in str(store):
        raise ValueError("allowed: a folder; mount other storage")
    return store.resolve()


_Axis = (Field(min_length=1), AfterValidator(_each_once))
Algorithm = Annotated[str, _known(find_algorithm)]
FieldName = Annotated[str, _known(load_field)]


class Budget(BaseModel, frozen=True, extra="forbid"):
    steps: Count | None = None
    evaluate_every: Count = 32_768
    episodes: Count = 100


class Resources(BaseModel, frozen=True, extra="forbid"):
    cpus: Positive = 1.0
    gpus: NonNegative = 0.0
    retries: Annotated[int, Field(ge=0)] = 3


class GridSpec(BaseModel, frozen=True, extra="forbid"):
    """The values of a grid's file; docs/grid.md explains the keys."""

    store: Annotated[Path, AfterValidator(_folder)]
    algorithms: Annotated[tuple[Algorithm, ...], *_Axis]
    fields: Annotated[tuple[FieldName, ...], *_Axis] = tuple(catalogue_names())
    settings: Annotated[tuple[Setting, ...], *_Axis] = ("N",)
    seeds: Annotated[tuple[Annotated[int, Field(ge=0, le=config.MOST_SEED)], ...], *_Axis]
    robots: Annotated[tuple[Count, ...], *_Axis] | None = None
    set: Mapping[str, Annotated[list[Any], *_Axis]] = Field(default_factory=dict)
    # The field whose run under A the runs under C begin with.
    source: FieldName = "field_01"
    budget: Budget = Budget()
    resources: Resources = Resources()


def read_spec(path: Path) -> GridSpec:
    values = config.read_yaml(path)
    try:
        return GridSpec.model_validate(values)
    except ValidationError as error:
        problems, wrong = describe(error, GridSpec), {one["loc"][0] for one in error.errors()}
    if not wrong & {"algorithms", "fields", "settings"}:  # then the others can be checked too
        right = {name: value for name, value in values.items() if name not in wrong}
        problems += _problems(GridSpec.model_validate({"store": "", "seeds": [0], **right}))
    raise ConfigError(str(path), problems)


def runs_of(spec: GridSpec, place: str = "grid") -> list[TrainConfig]:
    """Return the checked runs of a grid, and those that runs under C begin with."""
    if problems := _problems(spec):
        raise ConfigError(place, problems)
    runs = {run.name: run for run in _runs(spec)}
    return sorted(runs.values(), key=lambda run: run.transferred_from is not None)


def without_source(run: TrainConfig) -> TrainConfig:
    """Return a run under C as one under A: its source need not exist yet."""
    return replace(run, setting="A", transferred_from=None) if run.setting == "C" else run


def _problems(spec: GridSpec) -> list[str]:
    problems: list[str] = []
    for name in spec.algorithms:
        known = find_algorithm(name).settings
        if not set(known) & set(spec.settings):
            problems.append(f"settings: {name} has {', '.join(known)}, and none is asked for")
    if "C" in spec.settings:
        source = load_field(spec.source)
        problems += [
            f"fields: {name}: {what} {ours}; allowed: {allowed}, as {spec.source} has"
            for name in spec.fields
            for what, (allowed, ours) in sizes(source, load_field(name)).items()
            if allowed != ours
        ]
    if spec.robots and (axis := f"{ENVIRONMENT}.n_robots") in spec.set:
        problems.append(f"set: {axis} is what robots says")
    return problems or list(dict.fromkeys(_problems_of_runs(spec)))


def _problems_of_runs(spec: GridSpec) -> Iterator[str]:
    """Find runs of one name, and what is not valid in a run; once for all seeds."""
    runs: dict[str, TrainConfig] = {}
    checked: set[str] = set()
    try:
        for run in _runs(spec):
            if runs.setdefault(run.name, run) != run:
                yield f"{run.name}: two runs have this name"
            same = replace(without_source(run), seed=0)
            if same.command not in checked:
                checked.add(same.command)
                try:
                    prepare(same)
                except MbnError as error:
                    yield from error.problems if isinstance(error, ProblemsError) else [str(error)]
    except ConfigError as error:
        yield from error.problems


def _runs(spec: GridSpec) -> Iterator[TrainConfig]:
    device: Literal["cpu", "cuda"] = "cuda" if spec.resources.gpus else "cpu"
    axes = (spec.seeds, spec.fields, spec.algorithms, spec.settings, _changes(spec))
    for seed, field, algorithm, asked, (words, changes) in itertools.product(*axes):
        if asked not in find_algorithm(algorithm).settings:
            continue
        cells: list[tuple[Setting, str]] = [(asked, field)]
        if asked == "C":
            cells.insert(0, ("A", spec.source))
        source = None
        for setting, place in cells:
            run = TrainConfig(
                algorithm,
                found_anywhere(place),
                setting,
                seed,
                transferred_from=source,
                device=device,
                label=config.default_label(algorithm, setting) + words if words else None,
                **dict(spec.budget),
                **changes,
            )
            source = Path(run.name)
            yield run


def _changes(spec: GridSpec) -> Iterator[tuple[str, dict[str, Any]]]:
    """Find what the other axes change in a run: in words for its label, and as its arguments."""
    axes = {**({f"{ENVIRONMENT}.n_robots": list(spec.robots)} if spec.robots else {}), **spec.set}
    for values in itertools.product(*axes.values()):
        chosen = dict(zip(axes, values, strict=True))
        label = "".join(f"-{_in_words(name, value)}" for name, value in chosen.items())
        changes = config.parse([f"{name}={json.dumps(value)}" for name, value in chosen.items()])
        environment = changes.pop(ENVIRONMENT, {})
        yield label, {"environment": environment, "hyperparameters": changes}


def _in_words(name: str, value: Any) -> str:
    last = name.rpartition(".")[2]
    words = re.sub(r"[^\w.+-]+", "+", json.dumps(value)).strip("+")
    return f"{words}robots" if last == "n_robots" else f"{last}{words}"
