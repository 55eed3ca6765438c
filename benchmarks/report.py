"""Run a benchmark in a folder of its own; print and write what it measured."""

from __future__ import annotations

import math
import os
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

from rich.console import Console
from rich.progress import Progress

from baselines.compare.text_table import TextTable
from baselines.console import console
from baselines.runs.files import claim_folder, write_json
from baselines.runs.provenance import versions

Advance = Callable[[], object]
"""Called after each stage of a benchmark."""
STAT, CPU = Path("/proc/stat"), Path("/proc/cpuinfo")
ALLOWED = 0.1  # cores that others may use before a result is doubtful


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
        return bool(self.value >= self.target if self.at_least else self.value <= self.target)

    def to_json(self) -> dict[str, Any]:
        """Return the line as JSON values; never is ``None``."""
        value = None if self.value == math.inf else self.value
        return {**asdict(self), "value": value, "met": self.met}

    def words(self) -> tuple[str, ...]:
        """Return the cells of the line."""
        value = "-" if self.value is None else f"{number(self.value)} {self.unit}".rstrip()
        value = "never" if self.value == math.inf else value
        bound = ">=" if self.at_least else "<="
        target = "-" if self.target is None else f"{bound} {number(self.target)}"
        verdict = {True: "met", False: "missed", None: "-"}[self.met]
        return self.name, value, target, verdict, self.note


def number(value: float) -> str:
    """Return three digits, or all before the point."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def measurement_table(rows: Sequence[Measurement], caption: str = "") -> TextTable:
    """Return measurements as a table."""
    headings = ("what", "measured", "target", "", "note")
    return TextTable(caption, headings, tuple(row.words() for row in rows))


@dataclass(frozen=True)
class Findings:
    """Everything that a benchmark found."""

    title: str
    measurements: Sequence[Measurement]
    tables: Mapping[str, TextTable] = field(default_factory=dict)  # by title, printed below
    remarks: Sequence[str] = ()  # lines below the tables
    details: Mapping[str, Any] = field(default_factory=dict)  # JSON values to write, too
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
        """Measure with a progress bar, print the tables, write JSON and the figure."""
        folder = claim_folder(self.folder, force=self.force)
        screen, began, others = console(), perf_counter(), OtherLoad()
        with Progress(console=screen, transient=True) as progress:
            task = progress.add_task(f"measuring {self.name}", total=self.stages)
            found = self.measure(lambda: progress.advance(task))
        record: dict[str, Any] = {"command": command, "machine": describe_machine()}
        record |= {"seconds": perf_counter() - began, "other_cores": others.cores()}
        record |= {"load_average": os.getloadavg()}
        print_findings(found, record, screen)
        rows = [line.to_json() for line in found.measurements]
        write_json(folder / f"{self.name}.json", {**record, "rows": rows, **found.details})
        if found.draw is not None:
            found.draw(folder / f"{self.name}.png")
        screen.print(f"written to {folder}: {', '.join(sorted(p.name for p in folder.iterdir()))}")
        return True


def print_findings(found: Findings, record: Mapping[str, Any], screen: Console) -> None:
    """Print the machine, the tables, and whether others disturbed the measurement."""
    machine = record["machine"]
    packages = (f"{name} {known}" for name, known in machine["packages"].items() if known)
    screen.print(
        f"{machine['processor']}, {machine['cores']} cores, {machine['memory_gib']:.0f} GiB; "
        f"{machine['platform']}; Python {machine['python']}, {', '.join(packages)}\n",
        highlight=False,
    )
    tables = {found.title: measurement_table(found.measurements), **found.tables}
    for title, table in tables.items():
        screen.print(table.rich(title) if table.lines else title)
    load = ", ".join(f"{average:.2f}" for average in record["load_average"])
    spent = f"{record['seconds']:.0f} s in all; load average {load} (1, 5 and 15 minutes)"
    screen.print(*found.remarks, spent, sep="\n", highlight=False)
    others = record["other_cores"]
    if others is not None and others > ALLOWED:
        screen.print(
            f"[bold red]not valid[/]: other processes used {others:.2f} cores meanwhile, which "
            "bends ratios too; run it again on an idle machine",
            highlight=False,
        )


class OtherLoad:
    """Cores that other processes have used since this object was made."""

    def __init__(self) -> None:
        self._start, self._others = perf_counter(), _others()

    def cores(self) -> float | None:
        """Return the mean number of them, or ``None`` where the system does not tell."""
        now = _others()
        if now is None or self._others is None:
            return None
        return max(0.0, (now - self._others) / (perf_counter() - self._start))


def _others() -> float | None:
    """Seconds that cores have worked (or were withheld) but not for us or our ended children."""
    if not STAT.exists():
        return None
    words = STAT.read_text(encoding="utf-8").splitlines()[0].split()
    user, nice, system, _idle, _waiting, *stolen = map(int, words[1:9])  # the rest counts twice
    busy = user + nice + system + sum(stolen)
    return busy / os.sysconf("SC_CLK_TCK") - sum(os.times()[:4])


def describe_machine() -> dict[str, Any]:
    """Return processor, usable cores, memory (GiB), and the versions of everything measured."""
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    text = CPU.read_text(encoding="utf-8") if CPU.exists() else ""
    model = re.search(r"^model name\s*: *(.+)", text, re.MULTILINE)
    name = model[1] if model else platform.processor() or platform.machine()
    return {"processor": name, "cores": cores, "memory_gib": memory, **versions("vmas", "mpe2")}
