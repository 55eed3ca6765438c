"""``mbn grid``: many runs, declared in a file, on this machine or on a cluster."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from baselines.cli.options import CORES
from baselines.console import console
from baselines.runs.folder import RunFolder


@dataclass(frozen=True)
class Grid:
    """Train a grid of runs that a YAML file declares; the same command again resumes it."""

    spec: Positional[Annotated[Path, arg(metavar="SPEC")]]
    """The YAML file."""
    engine: Literal["local", "ray"] = "local"
    """local: processes of this machine. ray: a Ray cluster that is already running."""
    processes: int = CORES
    """local: runs at a time; each takes one core."""
    address: str | None = None
    """ray: HOST:PORT of the cluster; by default $RAY_ADDRESS, or the cluster of this machine."""
    check: bool = False
    """Check the file and list the runs with their states, but train nothing."""

    def run(self, command_line: str) -> None:
        from rich.progress import MofNCompleteColumn, Progress, TaskID, TimeElapsedColumn

        from baselines.sweep.run import Outcome, check_outcomes, make_engine, runs_left, train_runs
        from baselines.sweep.spec import read_spec, runs_of
        from baselines.training.run_logger import Report

        spec = read_spec(self.spec)
        engine = make_engine(self.engine, self.processes, self.address, spec.resources)
        runs, screen = runs_of(spec, str(self.spec)), console()
        left = runs_left(runs, spec.store)
        print(f"{len(runs)} runs, {len(runs) - len(left)} of them done; {spec.store}", flush=True)
        if self.check:
            for run in runs:
                print(f"{run.name}: {RunFolder(spec.store / run.name).state}")
            return
        columns = (*Progress.get_default_columns()[:3], MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=screen, disable=not screen.is_terminal) as bars:
            whole = bars.add_task("runs", total=len(runs), completed=len(runs) - len(left))
            running: dict[str, TaskID] = {}
            steps = {run.name: run.steps for run in left}

            def show(report: Report) -> None:
                if report.run not in running:
                    running[report.run] = bars.add_task(report.run, total=steps[report.run])
                bars.update(running[report.run], completed=report.env_steps)

            def tell(outcome: Outcome) -> None:
                error = "" if outcome.error is None else f" ({outcome.error})"
                print(f"{outcome.name}: {outcome.state}{error}", flush=True)
                bars.advance(whole)
                if outcome.name in running:
                    bars.remove_task(running.pop(outcome.name))

            outcomes = train_runs(left, spec.store, engine, listener=show, ended=tell)
        check_outcomes(outcomes.values(), spec.store, "the same command")
