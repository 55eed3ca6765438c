"""``mbn compare``, ``report``, ``benchmark`` and ``runs``: what runs and policies are worth."""

import re
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from baselines.cli.options import CORES, OptionalOutput, Output, Writes, check_options
from baselines.compare.text_table import TextTable, shown
from baselines.compare.variants import CompareConfig, read_variants
from baselines.console import console
from baselines.runs.discover import run_folders
from baselines.runs.files import Place, RunError, alone, claim_folder, reading, write_text
from baselines.runs.folder import RunFolder
from mbn_marl.errors import MbnError, collecting

WRITTEN = "comparison.md, comparison.json, table.csv, runs.csv, curves.csv, figures, runs"


@dataclass(frozen=True)
class Compare(Writes):
    """Train every algorithm on every field with every seed, then print and write a comparison."""

    config: Annotated[CompareConfig, arg(name="")]
    variants: Path | None = None
    """Instead of --algos: a YAML file of labelled variants, see docs/comparison.md."""
    processes: int = CORES
    """Runs at a time; each takes one core."""
    out: Output = Path("runs/comparison")
    """The folder to write: tables, figures, GIFs, and a run folder for every run."""
    resume: bool = False
    """Continue the comparison in the folder, with the same command otherwise."""
    wandb: str | None = None
    """Log every run to this project of Weights & Biases too (pip install wandb)."""

    def run(self, command_line: str) -> None:
        config = self.config
        both = self.variants is not None and config.variants != CompareConfig.variants
        wrong = {
            "algos and variants: allowed is one of them": both,
            f"processes: at least 1, not {self.processes}": self.processes < 1,
            "force and resume: allowed is one of them": self.force and self.resume,
        }
        problems: list[str] = []
        if self.variants is not None:
            with collecting(problems):
                config = replace(config, variants=read_variants(self.variants))
        check_options("comparison", wrong, problems)
        how = {name: getattr(self, name) for name in ("processes", "force", "resume", "wandb")}
        train_and_compare(config, self.out, command=command_line, **how)
        print(f"written to {self.out}: {WRITTEN}")


def train_and_compare(config: CompareConfig, out: Path, **options: Any) -> None:
    """Train, write and print a comparison; a RunError names at the end all that diverged."""
    from baselines.compare.report import PAGE, write_comparison
    from baselines.compare.run import train_all_runs
    from baselines.compare.tables import print_comparison
    from baselines.training.run_logger import progress_bars
    from baselines.training.train import notes

    runs = config.runs()
    print(f"{len(runs)} runs of {config.steps:,} env-steps")
    with suppress(MbnError):  # train_all_runs lists all that is wrong
        for run in replace(config, seeds=config.seeds[:1]).runs():
            for line in notes(run):
                print(f"{run.shown_as} in {run.field}: {line}")
    with progress_bars(runs) as show:
        results = train_all_runs(config, out, listener=show, **options)
    print_comparison(write_comparison(results, Place(out / PAGE, out)), console())
    if results.broken:
        errors = "\n".join(results.broken.values())
        raise RunError(f"{out / PAGE} leaves out the variants of runs that diverged:\n{errors}")


@dataclass(frozen=True)
class Report(Writes):
    """Report on runs: the paper's tables and figures with ours beside them, or a comparison."""

    runs: Positional[Annotated[tuple[Path, ...], arg(metavar="RUN ...")]]
    """Run folders, or folders that hold some; with --paper also folders of earlier reports."""
    out: Output
    """The folder to write, with paper.md or comparison.md; NAME.md, beside its folder NAME; or
    NAME.html for a comparison on one self-contained page."""
    paper: bool = False
    """The paper's experiments: its tables as Markdown, CSV and LaTeX, and its figures."""
    comparison: bool = False
    """The statistics of `mbn compare`, on runs that are there already."""
    marl_eval: Path | None = None
    """With a comparison: also write a file of all evaluations that marl-eval reads."""
    study: tuple[Path, ...] = ()
    """Folders of `mbn tune`, to put their best values and figures on the paper's page."""
    notes: Path | None = None
    """A Markdown file to put at the top of the page."""

    def run(self, command_line: str) -> None:
        from baselines.compare.report import is_page, report_comparison
        from baselines.compare.tables import print_comparison

        page = is_page(self.out)
        inputs = [run.resolve() for run in self.runs]
        folder = Place.of(self.out, "").folder.resolve()
        # An earlier report has no runs in it, and may be replaced.
        holds = any(folder.rglob("field.yaml"))
        lost = folder in inputs and (self.comparison or holds)
        lost |= any(folder in run.parents or (holds and run in folder.parents) for run in inputs)
        wrong = {
            f"out: {self.out} would replace a RUN; choose another": lost and not page,
            f"out: --paper writes a folder or .md, not {self.out}": page and self.paper,
            "kind: --paper or --comparison is needed, or an out that ends in .html": not page
            and self.paper == self.comparison,
            "study and notes: allowed with --paper": not self.paper and (self.study or self.notes),
            "marl_eval: allowed with a comparison": self.paper and self.marl_eval,
            "marl_eval: allowed is another file than out": self.marl_eval == self.out,
            "RUN: at least one folder is needed": not self.runs,
        }
        check_options("report", wrong)
        screen = console()
        note = partial(screen.print, soft_wrap=True, highlight=False)
        how: dict[str, Any] = {"command": command_line, "force": self.force, "note": note}
        if self.paper:
            from baselines.paper.report import write_report

            write_report(self.runs, self.out, study=self.study, notes=self.notes, **how)
        else:
            found = report_comparison(self.runs, self.out, marl_eval=self.marl_eval, **how)
            print_comparison(found, screen)
        note(f"written to {self.out}")


@dataclass(frozen=True)
class Benchmark(Writes):
    """Measure a policy on frozen fields with proved bounds, by the same rules for all."""

    source: Positional[Annotated[str, arg(metavar="POLICY")]]
    """zoo:NAME, the folder of a run, greedy, planner, replan, open-loop, greedy-local, blind,
    random, or module:callable."""
    split: Literal["test", "validation"] = "test"
    """The fields: those to choose by are of validation."""
    shield: bool = False
    """Let robots do only what they could brake after, whatever the policy wants."""
    tiers: tuple[str, ...] = ()
    """Some of 1-convex, 2-sizes, 3-shapes, 4-crowds, 5-weather, which are the default, 6-search,
    7-passages."""
    out: OptionalOutput = None
    """The folder to write: result.json, page.html, episodes; by default
    runs/benchmark-POLICY-SPLIT."""
    resume: bool = False
    """Continue a benchmark that was interrupted: tiers that are done are kept."""

    def run(self, command_line: str) -> None:
        from rich.progress import Progress

        from baselines.compare import benchmark
        from baselines.policies.load import check_known
        from baselines.policies.shielded import behind

        wrong = {"force and resume: allowed is one of them": self.force and self.resume}
        problems: list[str] = []
        with collecting(problems):
            check_known(self.source)
        with collecting(problems):
            tiers = benchmark.load_tiers(self.split, self.tiers or benchmark.load_protocol().tiers)
        check_options("benchmark", wrong, problems)
        policy = f"{self.source}{behind(self.shield)}"
        name = re.sub(r"[^\w.-]+", "-", policy).strip("-")
        out = self.out or Path(f"runs/benchmark-{name}-{self.split}")
        # A folder without a result may be another's, whose files would be written over.
        if not (self.resume and (out / benchmark.RESULT).exists()):
            claim_folder(out, force=self.force)
        with alone(out, "mbn benchmark"), Progress(console=console(), transient=True) as progress:
            task = progress.add_task(name, total=sum(map(len, tiers.values())))
            how: dict[str, Any] = {"command": command_line, "shield": self.shield}
            how |= {"resume": self.resume, "advance": partial(progress.advance, task)}
            try:
                record = benchmark.run_benchmark(self.source, self.split, tiers, out, **how)
            except KeyboardInterrupt:
                problem = f"{out} has the tiers that are done; continue with --resume"
                raise KeyboardInterrupt(problem) from None
        write_text(out / benchmark.PAGE, benchmark.result_page(record, out))
        for title, table in benchmark.result_tables(record).items():
            table.print(f"{policy} on {self.split}: {title}")
        print(f"written to {out}: {', '.join(sorted(path.name for path in out.iterdir()))}")


@dataclass(frozen=True)
class Runs:
    """List runs: finished, interrupted or under way, with success and makespan so far."""

    folders: Positional[Annotated[tuple[Path, ...], arg(metavar="[FOLDER ...]")]] = (Path("runs"),)
    """Run folders, or folders that hold some."""

    def run(self, command_line: str) -> None:
        lines = [line_of(path) for path in run_folders(self.folders, print, comparisons=True)]
        headings = ("run", "algorithm", "field", "seed", "success", "makespan", "state")
        caption = "sampled actions in the final evaluation, or the last one so far"
        TextTable(caption, headings, lines).print("runs")


def line_of(path: Path) -> tuple[str, ...]:
    here = Path.cwd()
    name = str(path.relative_to(here) if path.is_relative_to(here) else path)
    try:
        run = RunFolder.open(path)
        with reading(path):
            asked, last = run.config, {"success_rate": None, "makespan": None}
            if run.finished:
                last = run.evaluation["stochastic"]
            elif (run.path / "evaluations.json").exists() and run.evaluations:
                last = run.evaluations[-1]
            cells = shown(last["success_rate"], "{:.1%}"), shown(last["makespan"], "{:.1f}")
            who = str(asked["algorithm"]), Path(asked["field"]).stem, str(asked["seed"])
            return name, *who, *cells, run.state
    except MbnError as error:
        return name, *("-" * 5), str(error).removeprefix(f"{path}/")
