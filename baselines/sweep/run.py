"""A grid from its file to finished runs, by one of the engines."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

from baselines.runs.files import RunError
from baselines.sweep.processes import work_all
from baselines.sweep.ray_cluster import Engine, Needs, connected, enough_somewhere, work_on_ray
from baselines.sweep.spec import Cell, GridSpec, cells_of
from baselines.sweep.store import State, Store, open_store
from baselines.sweep.worker import Assignment, Outcome, work_on_cell
from baselines.training.progress_bar import Report
from baselines.training.train import prepare, resolve
from mbn_marl.errors import ConfigError


@dataclass(frozen=True)
class Grid:
    """A grid, checked, and its store.

    Attributes:
        spec: as declared.
        cells: its runs, in order.
        place: the store's path or URL, as every machine takes it.
        store: it.
    """

    spec: GridSpec
    cells: Sequence[Cell]
    place: str
    store: Store

    @classmethod
    def of(cls, spec: GridSpec) -> Grid:
        """Expand and check a grid.

        Raises:
            MbnError: a value is not valid; the message names it.
        """
        place = spec.store if "://" in spec.store else str(Path(spec.store).resolve())
        return cls(spec, cells_of(spec), place, open_store(place))

    @property
    def names(self) -> list[str]:
        """Of its runs."""
        return [cell.name for cell in self.cells]

    def left(self) -> list[Cell]:
        """The cells that are not finished.

        Raises:
            ConfigError: a finished run is of another configuration than the grid asks for.
        """
        finished = self.store.finished(self.names)
        problems = [
            f"{cell.name}: {problem}"
            for cell in self.cells
            if cell.name in finished
            for problem in _differences(cell, self.store.config(cell.name))
        ]
        if problems:
            raise ConfigError(f"{self.place}: finished runs are of another grid", problems)
        return [cell for cell in self.cells if cell.name not in finished]


def run_grid(
    grid: Grid,
    *,
    engine: Engine,
    processes: int,
    address: str | None = None,
    trust: bool = False,
    listener: Callable[[Outcome], None] = lambda outcome: None,
    note: Callable[[str], None] = lambda text: None,
) -> None:
    """Train every cell that is not finished; one that fails stops no other.

    Args:
        grid: what to train.
        engine: ``"local"``, processes of this machine; or ``"ray"``, a Ray cluster.
        processes: under ``"local"``, cells at a time.
        address: of the Ray cluster; by default that of ``RAY_ADDRESS`` or of this machine.
        trust: load pickled files of the store whoever made them.
        listener: is told how each cell ended.
        note: is told what the user should know.

    Raises:
        ConfigError: a finished run in the store is of another configuration.
        MbnError: there is no Ray cluster.
        RunError: cells failed; the message names the first ones.
    """
    left = grid.left()
    if not left:
        return
    spec, call = grid.spec, uuid4().hex
    upload_seconds = spec.resources.upload_seconds
    jobs = [Assignment(cell, grid.place, call, upload_seconds, trust) for cell in left]
    places = {cell.name: place for place, cell in enumerate(left)}
    after = [None if cell.source is None else places.get(cell.source) for cell in left]
    tries: Counter[int] = Counter()

    def hear(message: Outcome | Report) -> None:
        if isinstance(message, Outcome):
            listener(message)

    def failed(place: int, error: str) -> bool:
        tries[place] += 1
        if engine == "local" and tries[place] <= spec.resources.retries:
            return True
        _note_failure(grid.store, left[place].name, call, error)
        listener(Outcome(left[place].name, "failed", error))
        return False

    if engine == "local":
        work_all(work_on_cell, jobs, processes, hear, failed=failed, after=after)
    else:
        needs = Needs(
            spec.resources.cpus, spec.resources.gpus, spec.resources.retries, retry_errors=True
        )
        with connected(address):
            if not enough_somewhere(needs):
                note(
                    f"no machine of the cluster has {needs.cpus:g} cores and {needs.gpus:g} GPUs "
                    "for a run now; waiting for one"
                )
            work_on_ray(work_on_cell, jobs, hear, needs, failed=failed, after=after)
    _check_outcome(grid, [cell.name for cell in left])


def _note_failure(store: Store, name: str, call: str, error: str) -> None:
    """Note that a cell is given up; it may have left no note itself."""
    known = store.state(name) or State(state="failed", grid=call, attempt=1, machine="", process=0)
    store.note(name, known.model_copy(update={"state": "failed", "error": error}))


def _check_outcome(grid: Grid, names: Sequence[str]) -> None:
    """Whether all cells are where they should be.

    Raises:
        RunError: some are not; the message says why.
    """
    finished, states = grid.store.finished(names), grid.store.states()
    missing = [name for name in names if name not in finished]
    failed = {
        name: states[name].error
        for name in missing
        if name in states and states[name].state == "failed"
    }
    elsewhere = [name for name in missing if name in states and states[name].alive]
    lost = [name for name in missing if name not in failed and name not in elsewhere]
    lines = [f"{name}: {first_line(error)}" for name, error in failed.items()]
    lines += [f"{name}: another mbn grid is at work on it" for name in elsewhere]
    lines += [f"{name}: not in {grid.place}; do all machines see that place?" for name in lost]
    if lines:
        more = [f"and {len(lines) - SHOWN} more; see mbn grid status"] if len(lines) > SHOWN else []
        shown = "\n  - ".join([*lines[:SHOWN], *more])
        raise RunError(
            f"{len(names) - len(missing)} of {len(names)} cells were done; the same command takes "
            f"up the others\n  - {shown}"
        )


SHOWN = 10
"""Failures that a message lists."""


def first_line(error: str | None) -> str:
    """What an error says in a line; of a defect's traceback the last one."""
    lines = (error or "").strip().splitlines()
    return lines[-1] if lines and lines[0].endswith("process failed:") else "".join(lines[:1])


def _differences(cell: Cell, recorded: Mapping[str, object]) -> list[str]:
    """Where a finished run is not what the grid asks for; where its source lay does not matter."""
    task, hyperparameters = prepare(cell.begun_anew())
    asked = json.loads(json.dumps(dict(resolve(task, hyperparameters))))
    asked["setting"] = cell.config.setting
    return [
        f"{name}: the run has {recorded.get(name)!r}, the grid {value!r}"
        for name, value in asked.items()
        if name != "transferred_from" and recorded.get(name) != value
    ]
