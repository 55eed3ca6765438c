"""``mbn compare``: algorithms on fields, several seeds each, equal budgets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg
from tyro.constructors import PrimitiveConstructorSpec, PrimitiveTypeInfo

from baselines.cli.options import CORES, REGISTRY, Reading, check_options
from baselines.compare.variants import CompareConfig, Variant, parse_variant, read_variants
from mbn_marl.errors import ConfigError

if TYPE_CHECKING:
    from baselines.compare.results import Results


@REGISTRY.primitive_rule
def read_variant(info: PrimitiveTypeInfo) -> Reading | None:
    """Read a variant from ``ALGO`` or ``ALGO:SETTING``."""
    if info.type is not Variant:
        return None

    def read(words: list[str]) -> Variant:
        try:
            return parse_variant(words[0])
        except ConfigError as error:
            raise ValueError(f"{words[0]!r}; {', '.join(error.problems)}") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="ALGO",
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, Variant),
        str_from_instance=lambda value: [value.name],
    )


@dataclass(frozen=True)
class Compare:
    """Train every algorithm on every field with every seed, then print and write a comparison."""

    config: Annotated[CompareConfig, arg(name="")]
    variants: Path | None = None
    """Instead of --algos: a YAML file of labelled variants, see docs/comparison.md."""
    processes: int = CORES
    """Runs at a time; each takes one core."""
    out: Path = Path("runs/comparison")
    """The folder to write: tables, figures, GIFs, and a run folder for every run."""
    force: bool = False
    """If the folder exists, move it aside (to OUT.1, OUT.2, ...)."""
    resume: bool = False
    """Resume the comparison in the folder: finished runs are kept, interrupted ones are resumed,
    missing ones are started. The rest of the command must be the same."""
    wandb: str | None = None
    """Log every run to this project of Weights & Biases too (pip install wandb)."""

    def run(self, command_line: str) -> None:
        """Train with a bar for every run, then print the tables."""
        config = self.config
        wrong = {
            "algos and variants: allowed is one of them": self.variants is not None
            and config.variants != CompareConfig.variants,
            f"processes: at least 1, not {self.processes}": self.processes < 1,
            "force and resume: allowed is one of them": self.force and self.resume,
        }
        check_options("comparison", wrong)
        if self.variants is not None:
            config = replace(config, variants=read_variants(self.variants))
        names = ("processes", "force", "resume", "wandb")
        how = {name: getattr(self, name) for name in names}
        train_and_compare(config, self.out, command=command_line, **how)
        print(f"written to {self.out}: comparison.md, comparison.json, table.csv, figures, runs")


def train_and_compare(config: CompareConfig, out: Path, **options: Any) -> Results:
    """Train with a bar for every run, then write and print the comparison.

    Arguments and errors are those of :func:`~baselines.compare.run.train_all_runs`.

    Raises:
        RunError: a learner diverged; all else is done and written.
    """
    from baselines.compare.report import PAGE, write_comparison
    from baselines.compare.run import train_all_runs
    from baselines.compare.tables import print_comparison
    from baselines.console import console
    from baselines.runs.files import Place, RunError
    from baselines.training.progress_bar import progress_bars

    hours = config.core_hours
    spent = f"{hours:.1f} hours" if hours >= 1.0 else f"{60 * hours + 0.5:.0f} minutes"
    print(f"{len(config.runs())} runs of {config.steps:,} env-steps: about {spent} of one core")
    with progress_bars([run.name for run in config.runs()], config.steps) as show:
        results = train_all_runs(config, out, listener=show, **options)
    print_comparison(write_comparison(results, Place.of(out, PAGE)), console())
    if results.broken:
        errors = "\n".join(results.broken.values())
        raise RunError(f"{out / PAGE} leaves out the variants of runs that diverged:\n{errors}")
    return results
