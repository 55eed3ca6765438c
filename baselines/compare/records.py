"""The one reader of runs: what comparisons and the paper's report take from run folders."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic import Field as Range

from baselines.algorithms import ALGORITHMS
from baselines.runs.discover import run_folders
from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.training.config import MOST, default_label, problems_of
from mbn_marl.config import RealNumber, WholeNumber, describe, make_config
from mbn_marl.errors import collecting
from mbn_marl.field import Field
from mbn_marl.optimum import optimal_return

NEEDED = ("algorithm", "setting", "field", "seed")
"""Entries that the configuration of every run must have."""
CONFIG = ("steps", "evaluate_every", "episodes", "environment", "hyperparameters")
"""Those that a comparison needs besides."""
Content = TypeVar("Content", bound=BaseModel)
Count = Annotated[WholeNumber, Range(ge=0, le=MOST)]
Number = Annotated[RealNumber, Range(ge=-MOST, le=MOST)]
Positive = Annotated[RealNumber, Range(ge=0, le=MOST)]


class Listed(BaseModel):
    """The part of a configuration that a list of runs reads."""

    algorithm: str
    field: str
    seed: Count
    steps: Count


class Score(BaseModel):
    """The part of ``Evaluation.summary`` that every report reads."""

    return_mean: Number
    success_rate: Annotated[RealNumber, Range(ge=0, le=1)]


class Summary(Score):
    """The part of it that a comparison reads."""

    makespan: Positive | None


class Progress(BaseModel):
    """The part of a fresh evaluation on the way that a comparison reads."""

    env_steps: Count
    seconds: Positive
    return_mean: Number


class Scores(BaseModel):
    """The part of the final evaluation that every report reads."""

    stochastic: Score


class Final(BaseModel):
    """The part of the final evaluation that a comparison reads."""

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
        """Read a run; check too that it has all that a comparison needs, if it is ``finished``.

        Raises:
            RunError: a file cannot be read, or lacks what runs record now.
        """
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
        """The summaries of its fresh evaluations during training, in order."""
        return self.run.evaluations

    @cached_property
    def evaluation(self) -> dict[str, Any]:
        """The final evaluation."""
        return self.run.evaluation

    @property
    def label(self) -> str:
        """The name in tables and figures."""
        return self.config.get("label") or self.default_label

    @property
    def default_label(self) -> str:
        """The name of runs that differ from others by algorithm and setting alone."""
        return default_label(self.config["algorithm"], self.config["setting"])

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


def validate(model: type[Content], content: Any, path: Path, place: str = "") -> Content:
    """Check the content of a file of a run; raise a RunError that names each wrong entry."""
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
    """Read the runs at ``paths``: run folders, or folders with run folders anywhere inside.

    See :func:`baselines.runs.discover.run_folders`, and :meth:`RunRecord.read` for ``finished``.
    Runs on random fields are left out; ``note`` receives a line about each.

    Raises:
        RunError: a path holds no run, a run cannot be read, or all are on random fields.
    """
    runs = [RunFolder.open(path) for path in run_folders(paths, note, comparisons=comparisons)]
    some = [run for run in runs if isinstance(run.fields, Field)]
    for run in runs:
        if some and run not in some:
            note(f"left out: {run.path}, trained on random fields")
    return [RunRecord.read(run, finished=finished) for run in some or runs]


def ordered(algorithms: Mapping[str, str]) -> dict[str, int]:
    """Order labels, given with their algorithms, as every table and figure has them.

    Algorithms are in the order of the registry, and labels of one algorithm in their own order. The
    first label of an algorithm has the algorithm's place in the registry as its look, so that it
    looks the same in every report; each further one has the next look that is free. Looks are
    numbered as for ``mbn_marl.render.style.series``.
    """
    places = {label: list(ALGORITHMS).index(name) for label, name in algorithms.items()}
    free = (look for look in itertools.count() if look not in places.values())
    looks: dict[str, int] = {}
    for label in sorted(places, key=lambda label: (places[label], label)):
        looks[label] = next(free) if places[label] in looks.values() else places[label]
    return looks
