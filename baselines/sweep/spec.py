"""A grid as a YAML file declares it, and the runs that it stands for."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BaseModel, ConfigDict, Field

from baselines.algorithms import SETTINGS, Setting, find_algorithm
from baselines.training.config import TrainConfig, default_label
from baselines.training.hyperparameters import validate
from baselines.training.overrides import ENVIRONMENT, parse
from baselines.training.train import found_anywhere, prepare
from mbn_marl.errors import ConfigError
from mbn_marl.field import catalogue_names, load_field

Count = Annotated[int, Field(ge=1)]
_STRICT = ConfigDict(frozen=True, extra="forbid")


class Budget(BaseModel):
    """How long each run is.

    Attributes:
        steps: env-steps; ``None`` for the setting's own number.
        evaluate_every: env-steps between two fresh evaluations; a checkpoint is due after each.
        episodes: stochastic episodes of an evaluation.
        stop_at: stop at the first fresh evaluation with this mean return; ``None``: go on.
    """

    model_config = _STRICT

    steps: Count | None = None
    evaluate_every: Count = 32_768
    episodes: Count = 100
    stop_at: float | None = None


class Resources(BaseModel):
    """What a run is given.

    Attributes:
        cpus: cores that Ray sets aside for it; training uses one.
        gpus: GPUs, whole or a share of one; with any, the networks run on a GPU.
        retries: how often a run is taken up again, from its last checkpoint, when its process or
            machine is lost or something unforeseen happens.
        upload_seconds: to a store elsewhere checkpoints go no more often than so.
    """

    model_config = _STRICT

    cpus: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = 1.0
    gpus: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0
    retries: Annotated[int, Field(ge=0)] = 3
    upload_seconds: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 300.0


class GridSpec(BaseModel):
    """Every algorithm on every field under every setting with every seed, and more axes.

    Attributes:
        store: where the run folders go: a path, or a URL that fsspec knows.
        algorithms: names of :data:`baselines.algorithms.ALGORITHMS`.
        fields: catalogue names or paths of field files; by default the whole catalogue.
        settings: names of :data:`baselines.algorithms.SETTINGS`; an algorithm takes part under
            those that it has.
        seeds: of networks, exploration and worlds.
        robots: team sizes; by default that of the field.
        set: more axes: the values that a hyperparameter, or with ``environment.NAME`` a setting of
            the environment, takes in turn.
        source: the field whose run under A the runs under C begin with.
        budget: of each run.
        resources: of each run.
    """

    model_config = _STRICT

    store: str
    algorithms: Annotated[tuple[str, ...], Field(min_length=1)]
    fields: Annotated[tuple[str, ...], Field(min_length=1)] = tuple(catalogue_names())
    settings: Annotated[tuple[Setting, ...], Field(min_length=1)] = ("N",)
    seeds: Annotated[tuple[int, ...], Field(min_length=1)]
    robots: Annotated[tuple[Count, ...], Field(min_length=1)] | None = None
    set: Mapping[str, Annotated[list[Any], Field(min_length=1)]] = Field(default_factory=dict)
    source: str = "field_01"
    budget: Budget = Budget()
    resources: Resources = Resources()


@dataclass(frozen=True)
class Cell:
    """A run of a grid.

    Attributes:
        config: what to train; under setting C ``transferred_from`` is only the name of a run.
    """

    config: TrainConfig

    @property
    def name(self) -> str:
        """The run's name, and that of its folder in the store."""
        return self.config.name

    @property
    def learner(self) -> str:
        """What all its fields and seeds have in common."""
        return self.config.label or default_label(self.config.algorithm, self.config.setting)

    @property
    def source(self) -> str | None:
        """The name of the run that has to be done before this one; ``None`` for most."""
        path = self.config.transferred_from
        return None if path is None else path.name

    def begun_anew(self) -> TrainConfig:
        """The same training without another run's policy, which does not have to be there yet."""
        if self.source is None:
            return self.config
        return replace(self.config, setting="A", transferred_from=None)


def read_spec(path: Path) -> GridSpec:
    """Read a grid.

    Raises:
        ConfigError: the file cannot be read, or naming every value that is not valid.
    """
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(str(path), [f"cannot be read: {error}"]) from None
    if not isinstance(values, dict):
        raise ConfigError(str(path), ["must be a mapping"])
    return validate(GridSpec, values, str(path))


def cells_of(spec: GridSpec) -> list[Cell]:
    """The runs of a grid, each after the one that it begins with; every one is checked.

    Runs under A on the source's field that setting C needs are among them, asked for or not.

    Raises:
        ConfigError: an axis names something twice, an algorithm has none of the settings, or two
            field files have the same name.
        MbnError: an algorithm, a field, a hyperparameter or a setting is not valid.
    """
    _check_axes(spec)
    cells: dict[str, Cell] = {}
    asked = (
        (algorithm, setting, field, seed, changes)
        for seed, field, algorithm, setting, changes in itertools.product(
            spec.seeds,
            map(found_anywhere, spec.fields),
            spec.algorithms,
            spec.settings,
            _changes(spec),
        )
        if setting in find_algorithm(algorithm).settings
    )
    for cell in (one for words in asked for one in _with_source(spec, *words)):
        other = cells.setdefault(cell.name, cell)
        if other != cell:
            raise ConfigError("grid", [f"{cell.name}: two runs have this name"])
    different = [replace(cell.begun_anew(), seed=0) for cell in cells.values()]
    for config in {config.command: config for config in different}.values():
        prepare(config)
    return sorted(cells.values(), key=lambda cell: cell.source is not None)


def _check_axes(spec: GridSpec) -> None:
    """Whether every axis names everything once."""
    axes: dict[str, list[Any]] = {
        **{name: list(getattr(spec, name)) for name in ("algorithms", "fields", "settings")},
        "seeds": list(spec.seeds),
        "robots": list(spec.robots or ()),
        **{f"set.{name}": list(values) for name, values in spec.set.items()},
    }
    problems = [
        f"{name}: {value} is given twice"
        for name, values in axes.items()
        for place, value in enumerate(values)
        if value in values[:place]
    ]
    for name in spec.algorithms:
        there = find_algorithm(name).settings
        if not set(there) & set(spec.settings):
            problems.append(f"settings: {name} has {', '.join(there)}, and none is asked for")
    if spec.robots and (axis := f"{ENVIRONMENT}.n_robots") in spec.set:
        problems.append(f"set: {axis} is what robots says")
    for field in dict.fromkeys((*spec.fields, *([spec.source] if "C" in spec.settings else []))):
        starts, most = len(load_field(field).starts), max(spec.robots or (1,))
        if most > starts:
            problems.append(f"robots: {field} has {starts} starts, not {most}")
    if problems:
        raise ConfigError("grid", problems)


def _changes(spec: GridSpec) -> Iterator[tuple[str, dict[str, Any]]]:
    """What is changed in each run: in words for its label, and as :func:`parse` gives it."""
    axes = {**({f"{ENVIRONMENT}.n_robots": list(spec.robots)} if spec.robots else {}), **spec.set}
    for values in itertools.product(*axes.values()):
        chosen = dict(zip(axes, values, strict=True))
        label = "".join(f"-{_in_words(name, value)}" for name, value in chosen.items())
        yield label, parse([f"{name}={json.dumps(value)}" for name, value in chosen.items()])


def _in_words(name: str, value: Any) -> str:
    """An axis and its value as a part of a label."""
    last = name.rpartition(".")[2]
    words = re.sub(r"[^\w.+-]+", "+", json.dumps(value)).strip("+")
    return f"{words}robots" if last == "n_robots" else f"{last}{words}"


def _with_source(
    spec: GridSpec,
    algorithm: str,
    setting: Setting,
    field: str,
    seed: int,
    changes: tuple[str, dict[str, Any]],
) -> Iterator[Cell]:
    """A run, after the one that it begins with if there is one."""
    label, values = changes
    values = dict(values)
    environment = values.pop(ENVIRONMENT, {})

    def cell(setting: Setting, field: str, source: str | None = None) -> Cell:
        config = TrainConfig(
            algorithm,
            field,
            setting,
            seed,
            steps=spec.budget.steps or SETTINGS[setting].steps,
            evaluate_every=spec.budget.evaluate_every,
            episodes=spec.budget.episodes,
            stop_at=spec.budget.stop_at,
            transferred_from=None if source is None else Path(source),
            device="cuda" if spec.resources.gpus else "cpu",
            label=default_label(algorithm, setting) + label if label else None,
            environment=environment,
            hyperparameters=values,
        )
        return Cell(config)

    if setting != "C":
        yield cell(setting, field)
        return
    first = cell("A", found_anywhere(spec.source))
    yield first
    yield cell("C", field, first.name)
