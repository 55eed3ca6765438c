"""``mbn compare``: algorithms on fields, several seeds each, equal budgets."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from baselines.compare.results import Results
    from baselines.compare.run import CompareConfig


@dataclass(frozen=True)
class Compare:
    """Train every algorithm on every field with every seed, then print and write a comparison."""

    algos: tuple[str, ...] = ()
    """Algorithms of `mbn train`, centralised and decentralised together; crossq:A is crossq under
    setting A, crossq under N. By default ppo mappo ippo."""
    variants: Path | None = None
    """Instead of --algos: a YAML file of labelled variants, see docs/comparison.md."""
    fields: tuple[str, ...] = ("field_03",)
    """Names of `mbn fields`, or paths of field files."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """One run per algorithm, field and seed."""
    steps: int = 655_360
    """Budget of every run in env-steps."""
    evaluate_every: int = 32_768
    """Env-steps between two fresh evaluations."""
    episodes: int = 100
    """Episodes of an evaluation."""
    processes: int = os.cpu_count() or 1
    """Runs at a time; each takes one core."""
    out: Path = Path("runs/comparison")
    """The folder to write: tables, figures, GIFs, and a run folder for every run."""
    force: bool = False
    """If the folder exists, move it aside (to OUT.1, OUT.2, ...)."""
    resume: bool = False
    """Go on with the comparison in the folder: finished runs are kept, interrupted ones go on,
    missing ones are started. The rest of the command must be the same."""
    wandb: str | None = None
    """Log every run to this project of Weights & Biases too (pip install wandb)."""

    def run(self, command_line: str) -> None:
        """Train with a bar for every run, then print the tables."""
        from baselines.compare.run import CompareConfig
        from baselines.compare.variants import parse_variants, read_variants
        from mbn_marl.errors import ConfigError

        if self.algos and self.variants is not None:
            raise ConfigError("comparison", ["algos and variants: allowed is one of them"])
        named = parse_variants(self.algos or ("ppo", "mappo", "ippo"))
        config = CompareConfig(
            named if self.variants is None else read_variants(self.variants),
            self.fields,
            self.seeds,
            self.steps,
            self.evaluate_every,
            self.episodes,
        )
        train_and_compare(
            config,
            self.out,
            command=command_line,
            processes=self.processes,
            force=self.force,
            resume=self.resume,
            wandb=self.wandb,
        )
        print(f"written to {self.out}: comparison.md, comparison.json, table.csv, figures, runs")


def train_and_compare(
    config: CompareConfig,
    out: Path,
    *,
    command: str,
    processes: int,
    force: bool,
    resume: bool,
    wandb: str | None = None,
) -> Results:
    """Train with a bar for every run, then write and print the comparison.

    Raises:
        ConfigError: ``force`` and ``resume`` together, or no process.
        RunError: a learner broke down; all else is done and written.
        MbnError: as ``train_all_runs``.
    """
    from baselines.compare.markdown import PAGE, write_comparison
    from baselines.compare.run import train_all_runs
    from baselines.compare.tables import print_comparison
    from baselines.console import console
    from baselines.runs.files import RunError
    from baselines.runs.report_path import Place
    from baselines.training.progress_bar import ProgressDisplay
    from mbn_marl.errors import ConfigError

    problems = []
    if processes < 1:
        problems.append(f"processes: at least 1, not {processes}")
    if force and resume:
        problems.append("force and resume: allowed is one of them")
    if problems:
        raise ConfigError("comparison", problems)
    with ProgressDisplay([run.name for run in config.runs()], config.steps) as display:
        results = train_all_runs(
            config,
            out,
            command=command,
            processes=processes,
            force=force,
            resume=resume,
            wandb=wandb,
            listener=display,
        )
    print_comparison(write_comparison(results, Place.of(out, PAGE)), console())
    if results.broken:
        errors = "\n".join(results.broken.values())
        raise RunError(f"{out / PAGE} leaves out the variants of runs that broke down:\n{errors}")
    return results
