"""Train many runs into one folder, the store, which all machines see under the same path."""

# The run folders are the only memory: whoever trains a run looks at its folder and resumes it
# there, so it can be repeated at any time. The lock of a run folder keeps two processes apart.

import json
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from baselines.runs.files import RunError, alone, differences
from baselines.runs.folder import RunFolder
from baselines.sweep.processes import Failure, LocalEngine, RayEngine
from baselines.sweep.spec import Resources, without_source
from baselines.training.config import DivergenceError, TrainConfig
from baselines.training.run_logger import Listener, Report
from baselines.training.train import prepare, resolve, train
from mbn_marl.errors import ConfigError, MbnError

Engine = LocalEngine | RayEngine
# Failures that a message lists.
SHOWN = 10
# A lost machine may hold the lock of a run folder for a while.
PATIENCE = 60.0


def make_engine(
    name: Literal["local", "ray"],
    processes: int,
    address: str | None,
    resources: Resources | None = None,
) -> Engine:
    if name == "ray":
        given = resources or Resources()
        return RayEngine(address, given.cpus, given.gpus, given.retries)
    if address is not None:
        raise ConfigError("engine", ["address: allowed with --engine ray"])
    return LocalEngine(processes, 0 if resources is None else resources.retries)


@dataclass(frozen=True)
class TrainJob:
    run: TrainConfig
    store: Path
    wandb: str | None = None


@dataclass(frozen=True)
class Outcome:
    name: str
    state: Literal["done", "diverged", "failed"]
    error: str | None = None


def train_in_store(job: TrainJob, report: Listener) -> Outcome:
    """Train or resume a run; errors that a repetition would raise again are outcomes."""
    run, folder = job.run, job.store / job.run.name
    if run.setting == "C" and run.transferred_from is not None:
        run = replace(run, transferred_from=job.store / run.transferred_from.name)
    try:
        if folder.is_dir():
            with alone(folder, "mbn train", patience=PATIENCE):
                pass
        begun = (folder / "config.json").is_file()
        train(run, folder, resume=begun, wandb=job.wandb, listener=report)
    except DivergenceError as error:
        return Outcome(run.name, "diverged", str(error))
    except MbnError as error:
        return Outcome(run.name, "failed", str(error))
    return Outcome(run.name, "done")


def train_runs(
    runs: Sequence[TrainConfig],
    store: Path,
    engine: Engine,
    *,
    wandb: str | None = None,
    listener: Listener = lambda report: None,
    ended: Callable[[Outcome], None] = lambda outcome: None,
) -> dict[str, Outcome]:
    """Train every run that is not finished; one that fails or diverges stops no other."""
    outcomes: dict[str, Outcome] = {}
    store = store.resolve()

    def end(job: TrainJob, result: Outcome | Failure) -> None:
        name = job.run.name
        if isinstance(result, Failure):
            result = Outcome(name, "failed", result.error)
        elif result.state == "done" and not RunFolder(store / name).finished:
            missing = f"it is not in {store}; do all machines see that folder?"
            result = Outcome(name, "failed", missing)
        if result.error is not None:
            listener(Report(name, error=result.error))
        outcomes[name] = result
        ended(result)

    # Runs that begin with another one of these come after all others.
    names = {run.name for run in runs}
    batches: tuple[list[TrainJob], list[TrainJob]] = [], []
    for run in runs:
        source = run.transferred_from
        batches[source is not None and source.name in names].append(TrainJob(run, store, wandb))
    for jobs in filter(None, batches):
        engine.run(train_in_store, jobs, listener, end)
    return outcomes


def check_outcomes(
    outcomes: Collection[Outcome], store: Path, again: str = "the same command and --resume"
) -> None:
    failed = [one for one in outcomes if one.error is not None]
    lines = [f"{one.name}: {one.error}".replace("\n", "\n  ") for one in failed]
    if lines:
        more = [f"and {len(lines) - SHOWN} more"] if len(lines) > SHOWN else []
        shown = "\n  - ".join([*lines[:SHOWN], *more])
        raise RunError(
            f"{store}: {len(outcomes) - len(lines)} of {len(outcomes)} runs are done; once this is "
            f"mended, resume the others with {again}\n  - {shown}"
        )


def runs_left(runs: Iterable[TrainConfig], store: Path) -> list[TrainConfig]:
    left, problems = [], []
    for run in runs:
        folder = RunFolder(store / run.name)
        if not folder.finished:
            left.append(run)
            continue
        recorded = folder.config
        asked: dict[str, Any] = json.loads(json.dumps(resolve(*prepare(without_source(run)))))
        if run.setting == "C":  # the folder of the run's source may have moved
            asked |= {"transferred_from": recorded.get("transferred_from"), "setting": "C"}
        found = differences(recorded, asked)
        problems += [f"{run.name}: {problem}" for problem in found]
    if problems:
        raise ConfigError(f"{store}: finished runs are of another grid", problems)
    return left
