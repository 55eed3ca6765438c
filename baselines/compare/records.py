"""The one reader of runs: what comparisons and the paper's report take from run folders."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from baselines.algorithms import ALGORITHMS
from baselines.runs.discover import run_folders
from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.training.config import default_label
from mbn_marl.config import make_config
from mbn_marl.field import Field
from mbn_marl.optimum import optimal_return

NEEDED = ("algorithm", "setting", "field", "seed")
"""Entries that the configuration of every run must have."""
CONFIG = ("steps", "evaluate_every", "episodes", "environment", "hyperparameters")
EVALUATION = ("env_steps", "seconds", "stochastic", "deterministic")
SUMMARY = ("return_mean", "success_rate", "makespan")
HISTORY = ("env_steps", "seconds", "return_mean")
"""Entries that a comparison needs besides: of the configuration, the final evaluation, each of its
two summaries, and every evaluation on the way."""


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
        for name, entries, needed in record._parts(finished):
            known = entries if isinstance(entries, Mapping) else {}
            if missing := [entry for entry in needed if entry not in known]:
                problem = f"has no {', '.join(missing)}: it is not a run of this version"
                raise RunError(f"{run.path / name} {problem}")
        if finished and not record.evaluations:
            raise RunError(f"{run.path / 'evaluations.json'} is empty: the run was never evaluated")
        return record

    def _parts(self, finished: bool) -> Iterator[tuple[str, Any, Sequence[str]]]:
        """Yield what is checked: the file, its content, and the entries it must have."""
        yield "config.json", self.config, NEEDED
        if finished:
            yield "config.json", self.config, CONFIG
            yield "evaluation.json", self.evaluation, EVALUATION
            for kind in ("stochastic", "deterministic"):
                yield "evaluation.json", self.evaluation[kind], SUMMARY
            for entry in self.evaluations:
                yield "evaluations.json", entry, HISTORY

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
