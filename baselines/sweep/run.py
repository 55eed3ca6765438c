"""Train many runs into a store, by one of the engines."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from baselines.runs.files import RunError, differences
from baselines.sweep.processes import Failure, LocalEngine
from baselines.sweep.ray_cluster import RayEngine
from baselines.sweep.spec import GridSpec, Resources, runs_of, without_source
from baselines.sweep.store import Note, Store, open_store
from baselines.sweep.worker import Outcome, TrainJob, source_of, train_in_store
from baselines.training.config import TrainConfig
from baselines.training.run_logger import Listener, Report
from baselines.training.train import prepare, resolve
from mbn_marl.errors import ConfigError

Engine = LocalEngine | RayEngine
SHOWN = 10
"""Failures that a message lists."""


def make_engine(
    name: Literal["local", "ray"],
    processes: int,
    address: str | None,
    resources: Resources | None = None,
) -> Engine:
    """Return the engine that a command line asks for.

    Without ``resources`` a job gets a core, and no retries on this machine.

    Raises:
        ConfigError: ``processes`` is below 1, or ``address`` is given without ``"ray"``.
    """
    if name == "ray":
        given = resources or Resources()
        return RayEngine(address, given.cpus, given.gpus, given.retries)
    if address is not None:
        raise ConfigError("engine", ["address: allowed with --engine ray"])
    return LocalEngine(processes, 0 if resources is None else resources.retries)


def train_runs(
    runs: Iterable[TrainConfig],
    place: str,
    engine: Engine,
    *,
    noted: bool = False,
    upload_seconds: float = 0.0,
    wandb: str | None = None,
    listener: Listener = lambda report: None,
    ended: Callable[[Outcome], None] = lambda outcome: None,
) -> dict[str, Outcome]:
    """Train every run that is not finished; one that fails or diverges stops no other.

    Args:
        runs: what to train; each comes after the one that it begins with, and the next one is
            drawn when there is a process for it.
        place: the path or URL of the store.
        engine: runs the jobs.
        noted: write notes about the runs in the store, for ``mbn grid status``.
        upload_seconds: least seconds between two copies of checkpoints into a remote store.
        wandb: a project of Weights & Biases to log to as well.
        listener: receives the progress of the runs.
        ended: receives how each run ended; all ends are returned, by the run's name.
    """
    outcomes: dict[str, Outcome] = {}
    drawn: set[str | None] = set()

    def jobs() -> Iterator[TrainJob]:
        for run in runs:
            source = source_of(run)
            after = source if source in drawn else None
            drawn.add(run.name)
            yield TrainJob(run, place, after, noted, upload_seconds, wandb)

    def end(job: TrainJob, result: Outcome | Failure) -> None:
        if isinstance(result, Failure):
            result = Outcome(job.name, "failed", result.error)
            if noted:  # a process that was killed has left no note itself
                store = open_store(place)
                known = store.last_note(job.name) or Note(state="failed")
                failed = {"state": "failed", "error": result.error}
                store.note(job.name, known.model_copy(update=failed))
        if result.error is not None:
            listener(Report(job.name, error=result.error))
        outcomes[job.name] = result
        ended(result)

    engine.run(train_in_store, jobs(), listener, end)
    return outcomes


def check_outcomes(
    outcomes: Collection[Outcome], place: str | Path, again: str = "the same command and --resume"
) -> None:
    """Check that all runs are done; raise a RunError that says which are not, and why.

    It says that ``again`` resumes them.
    """
    lines = [f"{one.name}: {first_line(one.error)}" for one in outcomes if one.state != "done"]
    if lines:
        more = [f"and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else []
        shown = "\n  - ".join([*lines[:SHOWN], *more])
        raise RunError(
            f"{place}: {len(outcomes) - len(lines)} of {len(outcomes)} runs are done; resume the "
            f"others with {again}\n  - {shown}"
        )


def first_line(error: str | None) -> str:
    """Return the first line of an error, or the last one of a traceback."""
    lines = (error or "").strip().splitlines()
    return lines[-1] if lines and lines[0].endswith("process failed:") else "".join(lines[:1])


@dataclass(frozen=True)
class Sweep:
    """The checked runs of a grid, in order, and their store at ``place``, a path or URL."""

    runs: Sequence[TrainConfig]
    resources: Resources
    place: str
    store: Store

    @classmethod
    def of(cls, spec: GridSpec) -> Sweep:
        """Expand and check a grid; raise a ConfigError that names every value that is wrong."""
        place = spec.store if "://" in spec.store else str(Path(spec.store).resolve())
        return cls(runs_of(spec), spec.resources, place, open_store(place))

    @property
    def names(self) -> list[str]:
        """The names of the runs."""
        return [run.name for run in self.runs]

    def left(self) -> list[TrainConfig]:
        """Return the runs to do; raise a ConfigError if a finished one is of another grid."""
        finished = self.store.finished(self.names)
        problems = []
        for run in (run for run in self.runs if run.name in finished):
            recorded = self.store.config(run.name)
            asked = json.loads(json.dumps(dict(resolve(*prepare(without_source(run))))))
            # Where the run's source lay does not matter.
            same = {"transferred_from": recorded.get("transferred_from"), "setting": run.setting}
            found = differences(recorded, {**asked, **same})
            problems += [f"{run.name}: {problem}" for problem in found]
        if problems:
            raise ConfigError(f"{self.place}: finished runs are of another grid", problems)
        return [run for run in self.runs if run.name not in finished]

    def train(
        self, engine: Engine, ended: Callable[[Outcome], None] = lambda outcome: None
    ) -> None:
        """Train every run that is not finished; ``ended`` receives how each one ended.

        Raises:
            RunError: runs failed; the message names the first ones.
            MbnError: a finished run is of another configuration, or there is no Ray cluster.
        """
        seconds = self.resources.upload_seconds
        outcomes = train_runs(
            self.left(), self.place, engine, noted=True, upload_seconds=seconds, ended=ended
        )
        for name in outcomes.keys() - self.store.finished(outcomes):
            if outcomes[name].state == "done":
                missing = "it is not in the store; do all machines see that place?"
                outcomes[name] = Outcome(name, "failed", missing)
        check_outcomes(outcomes.values(), self.place, "the same command")
