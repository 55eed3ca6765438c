"""Run a benchmark in a folder of its own; print and write what it measured."""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from baselines.console import console as make_console
from baselines.runs.files import claim_folder, write_json
from baselines.runs.provenance import versions

Advance = Callable[[], object]
"""Called after each stage of a benchmark."""
PEERS = ("vmas", "mpe2")
STAT = Path("/proc/stat")
IDLE = (3, 4)
"""Places of the idle and the waiting time among the counters of ``/proc/stat``."""
ALLOWED = 0.1
"""Cores that others may use before a result is doubtful."""


@dataclass(frozen=True)
class Measurement:
    """One line of the table."""

    name: str
    value: float | None  # None if it was not measured (the note says why), infinite for never
    unit: str
    target: float | None = None
    at_least: bool = True  # whether the target is a lower bound; otherwise it is an upper one
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Return whether the target is met; ``None`` without a figure or a target."""
        if self.value is None or self.target is None:
            return None
        return self.value >= self.target if self.at_least else self.value <= self.target

    def to_json(self) -> dict[str, Any]:
        """Return the line as JSON values; never is ``None``."""
        value = None if self.value == math.inf else self.value
        return {**asdict(self), "value": value, "met": self.met}

    def words(self) -> tuple[str, ...]:
        """Return the cells of the line."""
        value = "-" if self.value is None else f"{number(self.value)} {self.unit}".rstrip()
        bound = ">=" if self.at_least else "<="
        target = "-" if self.target is None else f"{bound} {number(self.target)}"
        verdict = {True: "met", False: "missed", None: "-"}[self.met]
        value = "never" if self.value == math.inf else value
        return self.name, value, target, verdict, self.note


HEADINGS = ("what", "measured", "target", "", "note")


@dataclass(frozen=True)
class Findings:
    """Everything that a benchmark found."""

    title: str
    measurements: Sequence[Measurement]
    tables: Sequence[Table] = ()  # printed below the measurements
    remarks: Sequence[str] = ()  # lines below the tables
    details: Mapping[str, Any] = field(default_factory=dict)  # JSON values that are written too
    draw: Callable[[Path], None] | None = None  # writes a figure


@dataclass(frozen=True)
class Benchmark:
    """A benchmark that writes a folder; the fields are its options."""

    name: ClassVar[str]
    stages: ClassVar[int]

    out: Path | None = None
    """The folder to write; by default runs/bench-SUBJECT."""
    force: bool = False
    """If the folder exists, move it aside (to OUT.1, OUT.2, ...)."""

    @property
    def folder(self) -> Path:
        """Return the folder to write."""
        return self.out or Path(f"runs/bench-{self.name}")

    def measure(self, advance: Advance) -> Findings:
        """Measure; call ``advance`` after each of ``stages`` stages."""
        raise NotImplementedError

    def run(self, command: str) -> bool:
        """Measure with a progress bar, print the tables, write JSON and the figure.

        Raises:
            RunError: the folder holds something already, and ``force`` is not set.
        """
        folder = claim_folder(self.folder, force=self.force)
        console, began, others = make_console(), perf_counter(), OtherLoad()
        with Progress(console=console, transient=True) as progress:
            task = progress.add_task(f"measuring {self.name}", total=self.stages)
            found = self.measure(lambda: progress.advance(task))
        record = {
            "command": command,
            "machine": describe_machine(),
            "seconds": perf_counter() - began,
            "other_cores": others.cores(),
        }
        print_findings(found, record, console)
        rows = [line.to_json() for line in found.measurements]
        write_json(folder / f"{self.name}.json", {**record, "rows": rows, **found.details})
        if found.draw is not None:
            found.draw(folder / f"{self.name}.png")
        console.print(f"written to {folder}: {', '.join(sorted(p.name for p in folder.iterdir()))}")
        return True


def print_findings(found: Findings, record: Mapping[str, Any], console: Console) -> None:
    """Print the machine, the tables, and whether others disturbed the measurement."""
    console.print(f"{machine_line(record['machine'])}\n", highlight=False)
    lines = [line.words() for line in found.measurements]
    console.print(table(found.title, HEADINGS, lines, wrapping=("what", "note")), *found.tables)
    console.print(*found.remarks, f"{record['seconds']:.0f} s in all", sep="\n", highlight=False)
    others = record["other_cores"]
    if others is not None and others > ALLOWED:
        console.print(
            f"[bold red]not valid[/]: other processes used {others:.2f} cores meanwhile, which "
            "bends ratios too; run it again on an idle machine",
            highlight=False,
        )


def table(
    title: str,
    headings: Sequence[str],
    lines: Sequence[Sequence[str]],
    wrapping: Sequence[str] = (),
) -> Table:
    """Return a table for a terminal: the first column and those that wrap left, others right."""
    made = Table(title=title)
    for index, heading in enumerate(headings):
        words = index == 0 or heading in wrapping
        side: Any = "left" if words or not heading else "right"
        made.add_column(heading, justify=side, no_wrap=heading not in wrapping)
    for line in lines:
        made.add_row(*line)
    return made


def number(value: float) -> str:
    """Return three digits, or all before the point."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


class OtherLoad:
    """Cores that other processes have used since this object was made.

    Contention bends ratios too, not only rates.
    """

    def __init__(self) -> None:
        self._start = perf_counter()
        self._others = _others()

    def cores(self) -> float | None:
        """Return the mean number of them, or ``None`` where the system does not tell."""
        now = _others()
        if now is None or self._others is None:
            return None
        return max(0.0, (now - self._others) / (perf_counter() - self._start))


def _others() -> float | None:
    """Seconds that cores have worked (or were withheld) but not for us or our ended children."""
    try:
        line = STAT.read_text(encoding="utf-8").splitlines()[0]
    except OSError:
        return None
    ticks = [int(count) for count in line.split()[1:9]]  # the guests after them are counted twice
    busy = sum(count for place, count in enumerate(ticks) if place not in IDLE)
    return busy / os.sysconf("SC_CLK_TCK") - sum(os.times()[:4])


def describe_machine() -> dict[str, Any]:
    """Return processor, usable cores, memory (GiB), and the versions of everything measured."""
    described = versions()
    installed = {found.name: found.version for found in importlib.metadata.distributions()}
    described["packages"] |= {name: installed.get(name) for name in PEERS}
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    except (AttributeError, ValueError, OSError):
        memory = None
    return {"processor": _processor(), "cores": cores, "memory_gib": memory, **described}


def _processor() -> str:
    """Return the processor's model; where Linux does not tell, what Python knows."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def machine_line(machine: Mapping[str, Any]) -> str:
    """Return the description in a line or two."""
    packages = ", ".join(
        f"{name} {version}" for name, version in machine["packages"].items() if version
    )
    memory = "" if machine["memory_gib"] is None else f", {machine['memory_gib']:.0f} GiB"
    return (
        f"{machine['processor']}, {machine['cores']} cores{memory}; {machine['platform']}; "
        f"Python {machine['python']}, {packages}"
    )
