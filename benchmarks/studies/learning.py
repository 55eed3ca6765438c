"""The comparisons of learning, and the targets of the recorded setting."""

from __future__ import annotations

import heapq
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, ClassVar

import pandas as pd
from pydantic import BaseModel, ConfigDict
from tyro.conf import Positional

from baselines.cli.compare import train_and_compare
from baselines.cli.options import CORES
from baselines.compare.records import RunRecord
from baselines.compare.text_table import TextTable, shown
from baselines.compare.variants import CompareConfig, labelled
from baselines.evaluation.intervals import passes
from baselines.paper import published
from baselines.runs.files import write_json, write_text
from baselines.training.config import validate
from benchmarks.report import Benchmark, Measurement, measurement_table
from mbn_marl.errors import ConfigError, unknown
from mbn_marl.field import catalogue_names
from mbn_marl.field.files import parse_yaml

STUDIES = sorted(path.stem for path in Path(__file__).parent.glob("*.yaml"))
PAPER = published.by_field()
STEPS = 1_441_792  # env-steps of a run
NEAR = 0.0025  # a return so far below the optimum still counts as near it
BUDGET = 1_500_000  # env-steps within which a run has to pass
CAPTION = (
    "A run passes when the mean return of fresh sampled episodes is 100 000 or more, 99 % of them "
    "succeed, and so does the policy with mean actions. Wall times have the evaluations in them, "
    "but not the start of Python and compilation; in the table, of as many runs at a time as there "
    "were processes. Returns of fields are those of mean actions, over seeds: the median is of "
    "final policies, the best of any fresh evaluation. Targets are scaled to the runs made: for "
    "ten fields 160 s until all pass, 30 minutes in all."
)
FIELD_CAPTION = (
    "pass: runs whose final policy does. env-steps, s: to the first evaluation that passes, "
    "median over seeds, wall time; worst: the most env-steps. mean actions: the median return "
    "of final policies; below: how far it is below the proved optimum; best: of any evaluation."
)
WHOLE = "{:,.0f}"
COLUMNS = {
    "field": ("field", "{}"),
    "pass": ("pass", "{}"),
    "env-steps": ("env_steps", WHOLE),
    "worst": ("worst_env_steps", WHOLE),
    "s": ("seconds", "{:.1f}"),
    "sampled return": ("return_mean", WHOLE),
    "success": ("success_rate", "{:.1%}"),
    "mean actions": ("deterministic_median", WHOLE),
    "below": ("below", "{:.2%}"),
    "best": ("deterministic_best", WHOLE),
    "optimum": ("optimum", WHOLE),
    "paper's best": ("paper_best", WHOLE),
}


class Plan(BaseModel):
    """A study, as its YAML file in this folder has it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    fields: tuple[str, ...] = tuple(catalogue_names())
    seeds: tuple[int, ...]  # 100 and up, where nothing was tuned
    steps: int = STEPS
    evaluate_every: int = 65_536
    targets: bool = False  # hold the one variant against the targets of the recorded setting
    variants: dict[str, dict[str, Any]]  # the values of ``Variant``, by label


@dataclass(frozen=True)
class Study(Benchmark):
    """Train and compare the variants of a study, a YAML file in benchmarks/studies."""

    name: ClassVar[str] = "study"

    study: Positional[str] = "forms"
    """The name of the file: forms, learning, aids and others."""
    fields: tuple[str, ...] = ()
    """Names of `mbn fields`, or paths; by default the study's."""
    seeds: tuple[int, ...] = ()
    """One run for each variant, field and seed; by default the study's."""
    steps: int | None = None
    """Env-steps of every run; by default the study's."""
    processes: int = CORES
    """Runs at a time, each on one core."""
    resume: bool = False
    """Resume what is in the folder, as `mbn compare` does."""

    @property
    def folder(self) -> Path:
        return self.out or Path(f"runs/bench-{self.study}")

    @property
    def plan(self) -> Plan:
        if self.study not in STUDIES:
            raise ConfigError("study", [f"{self.study}: {unknown('study', self.study, STUDIES)}"])
        given = {name: getattr(self, name) for name in ("fields", "seeds", "steps")}
        path = Path(__file__).with_name(f"{self.study}.yaml")
        values: Any = parse_yaml(path.read_bytes(), str(path))
        plan = validate(Plan, values, str(path))
        return plan.model_copy(update={name: value for name, value in given.items() if value})

    def config(self) -> CompareConfig:
        plan = self.plan
        variants = labelled(plan.variants, self.study)
        return CompareConfig(variants, plan.fields, plan.seeds, plan.steps, plan.evaluate_every)

    def run(self, command: str) -> bool:
        options = {name: getattr(self, name) for name in ("processes", "force", "resume")}
        results = train_and_compare(self.config(), self.folder, command=command, **options)
        print(f"written to {self.folder}: comparison.md, comparison.json, figures, runs")
        if self.plan.targets:
            runs = run_table(results.of_label(results.labels[0]))
            rows = target_rows(runs, self.processes)
            measurement_table(rows, CAPTION).print("targets")
            write_targets(runs, rows, self.folder)
        return True


def target_rows(runs: pd.DataFrame, processes: int) -> list[Measurement]:
    """Return the targets, for ``processes`` runs at a time."""

    def count(name: str, met: Sequence[bool], share: float) -> Measurement:
        least = math.ceil(share * len(met) - 1e-9)
        return Measurement(name, int(sum(met)), f"of {len(met)}", least)

    lines = field_table(runs)
    near = lines.deterministic_median >= (1 - NEAR) * lines.optimum
    best, title = lines.deterministic_best, "fields, best return"
    by_seed = runs.groupby(runs.groupby("field").cumcount()).seconds  # of a run on its field
    until_all = float(median(makespan(seconds, processes) for _, seconds in by_seed))
    worst, wall = float(runs.env_steps.max()), float(runs.wall_seconds.sum()) / processes
    fields, note = len(lines), f"{processes} at a time"
    all_pass = f"until {fields} fields pass, one seed each, wall time"
    return [
        count("final policies that pass", runs.passed, 1.0),
        Measurement("until a run passes, worst run", worst, "env-steps", BUDGET, False),
        Measurement(all_pass, until_all, "s", 16 * fields, False, f"{note}, median over seeds"),
        count("fields, median return within 0.25 % of the optimum", near, 1.0),
        count(f"{title} at or above the paper's", best >= lines.paper_best, 1.0),
        count(f"{title} is the proved optimum", best == lines.optimum, 0.9),
        Measurement("wall time of all runs", wall, "s", 180.0 * fields, False, note),
    ]


def makespan(seconds: Iterable[float], workers: int) -> float:
    """Return the seconds that ``workers`` take for jobs, begun in this order."""
    busy_until = [0.0] * workers
    for job in seconds:
        heapq.heapreplace(busy_until, busy_until[0] + job)
    return max(busy_until)


def write_targets(runs: pd.DataFrame, rows: Sequence[Measurement], out: Path) -> None:
    """Write ``learning.md`` and ``learning.json`` into the folder ``out``."""
    lines = field_table(runs)
    fields = json.loads(lines.to_json(orient="records", double_precision=15))  # never is null
    targets = [row.to_json() for row in rows]
    write_json(out / "learning.json", {"targets": targets, "fields": fields})
    lines["below"] = 1.0 - lines.deterministic_median / lines.optimum
    lines["pass"] = lines.passed.astype(str) + "/" + lines.runs.astype(str)
    lines = lines.astype(object).where(lines.ne(math.inf) & lines.notna(), None)
    cells = [
        [shown(line[name], form) for name, form in COLUMNS.values()]
        for line in lines.to_dict("records")
    ]
    tables = measurement_table(rows, CAPTION), TextTable(FIELD_CAPTION, [*COLUMNS], cells)
    parts = ["# Learning", tables[0].markdown("Targets"), tables[1].markdown("Fields")]
    write_text(out / "learning.md", "\n\n".join(parts) + "\n")


def run_table(records: Iterable[RunRecord]) -> pd.DataFrame:
    """Return a row for each run: when it first passed, its final evaluation, its best return.

    ``best`` is the best return with mean actions of any evaluation, during training or at its end.
    ``optimum`` (proved) and ``paper_best``, the largest number that the paper has, are those of
    its field; NaN where unknown.
    """
    rows = []
    for record in records:
        final, found = record.evaluation, record.evaluations
        passing = (e for e in found if passes(e, e["deterministic_success_rate"]))
        first = next(passing, {"env_steps": math.inf, "wall_seconds": math.inf})
        deterministic = final["deterministic"]["return_mean"]
        paper = [cell for (field, _), cell in PAPER.items() if field == record.field.name]
        rows.append(
            {
                "field": record.field.name,
                "passed": passes(final["stochastic"], final["deterministic"]["success_rate"]),
                "env_steps": first["env_steps"],
                "seconds": first["wall_seconds"],
                "wall_seconds": final["wall_seconds"],
                "return_mean": final["stochastic"]["return_mean"],
                "success_rate": final["stochastic"]["success_rate"],
                "deterministic": deterministic,
                "best": max(deterministic, *(e["deterministic_return_mean"] for e in found)),
                "optimum": record.optimum,
                "paper_best": max((cell["max"] for cell in paper), default=None),
            }
        )
    return pd.DataFrame(rows).astype({"optimum": float, "paper_best": float})


def field_table(runs: pd.DataFrame) -> pd.DataFrame:
    lines = runs.groupby("field", sort=False).agg(
        runs=("passed", "size"),
        passed=("passed", "sum"),  # final policies
        env_steps=("env_steps", "median"),
        worst_env_steps=("env_steps", "max"),
        seconds=("seconds", "median"),
        return_mean=("return_mean", "mean"),
        success_rate=("success_rate", "mean"),
        deterministic_median=("deterministic", "median"),
        deterministic_best=("best", "max"),
        optimum=("optimum", "first"),
        paper_best=("paper_best", "first"),
    )
    return lines.reset_index()
