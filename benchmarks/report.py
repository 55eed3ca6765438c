"""Run a benchmark, print its tables, and write its figures as JSON into a folder."""

from __future__ import annotations

import math
import os
import platform
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

from baselines.compare.text_table import TextTable
from baselines.console import console
from baselines.runs.files import claim_folder, write_json
from baselines.runs.provenance import versions

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
    """The results of a benchmark: tables to print, by title, and JSON values to write."""

    tables: dict[str, TextTable]
    values: dict[str, Any]


@dataclass(frozen=True)
class Benchmark:
    """A benchmark that writes a folder; the fields are its options."""

    name: ClassVar[str]

    out: Path | None = None
    """The folder to write; by default runs/bench-SUBJECT."""
    force: bool = False
    """If the folder exists, move it aside (to OUT.1, OUT.2, ...)."""

    @property
    def folder(self) -> Path:
        """Return the folder to write."""
        return self.out or Path(f"runs/bench-{self.name}")

    def measure(self) -> Findings:
        """Measure."""
        raise NotImplementedError

    def run(self, command: str) -> bool:
        """Measure, print the tables and a warning if others disturbed, write JSON."""
        folder = claim_folder(self.folder, force=self.force)
        began, before = perf_counter(), other_seconds()
        found = self.measure()
        seconds, after = perf_counter() - began, other_seconds()
        others = None if before is None or after is None else max(0.0, after - before) / seconds
        machine = describe_machine()
        for title, table in found.tables.items():
            table.print(title)
        load = ", ".join(f"{average:.2f}" for average in os.getloadavg())
        screen = console()
        screen.print(f"{machine['processor']}, {machine['cores']} cores; {seconds:.0f} s in all")
        screen.print(f"load average {load}; written to {folder}")
        if others is not None and others > ALLOWED:
            screen.print(
                f"[bold red]not valid[/]: other processes used {others:.2f} cores meanwhile, which "
                "bends ratios too; run it again on an idle machine"
            )
        record = {"command": command, "machine": machine, "seconds": seconds, "other_cores": others}
        write_json(folder / f"{self.name}.json", {**record, **found.values})
        return True


def other_seconds() -> float | None:
    """Return the cores' seconds spent on others; ``None`` where the system does not count."""
    if not STAT.exists():
        return None
    words = STAT.read_text(encoding="utf-8").splitlines()[0].split()
    user, nice, system, _idle, _waiting, *stolen = map(int, words[1:9])  # the rest counts twice
    busy = user + nice + system + sum(stolen)
    return busy / os.sysconf("SC_CLK_TCK") - sum(os.times()[:4])  # ours, and our ended children's


def describe_machine() -> dict[str, Any]:
    """Return processor, usable cores, and the versions of everything measured."""
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    text = CPU.read_text(encoding="utf-8") if CPU.exists() else ""
    model = re.search(r"^model name\s*: *(.+)", text, re.MULTILINE)
    name = model[1] if model else platform.processor() or platform.machine()
    return {"processor": name, "cores": cores, **versions("vmas", "mpe2")}
