"""Run a benchmark, print its tables, and write its figures as JSON into a folder."""

import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

from baselines.cli.options import OptionalOutput, Writes
from baselines.compare.text_table import TextTable
from baselines.runs.files import claim_folder, versions, write_json

CPU = Path("/proc/cpuinfo")


@dataclass(frozen=True)
class Measurement:
    name: str
    value: float | None  # None if it was not measured; the note says why
    unit: str
    target: float | None = None
    at_least: bool = True  # the target is a lower bound; otherwise it is an upper one
    note: str = ""

    @property
    def met(self) -> bool | None:
        if self.value is None or self.target is None:
            return None
        return bool(self.value >= self.target if self.at_least else self.value <= self.target)

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "met": self.met}

    def words(self) -> tuple[str, ...]:
        value = "-" if self.value is None else f"{number(self.value)} {self.unit}".rstrip()
        bound = ">=" if self.at_least else "<="
        target = "-" if self.target is None else f"{bound} {number(self.target)}"
        verdict = {True: "met", False: "missed", None: "-"}[self.met]
        return self.name, value, target, verdict, self.note


def number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def measurement_table(rows: Sequence[Measurement], caption: str = "") -> TextTable:
    headings = ("what", "measured", "target", "", "note")
    return TextTable(caption, headings, [row.words() for row in rows])


@dataclass(frozen=True)
class Findings:
    tables: dict[str, TextTable]
    values: dict[str, Any]


@dataclass(frozen=True)
class Benchmark(Writes):
    """A benchmark that writes a folder; the fields are its options."""

    name: ClassVar[str]

    out: OptionalOutput = None
    """The folder to write; by default runs/bench-SUBJECT."""

    def measure(self) -> Findings:
        raise NotImplementedError

    def run(self, command: str) -> bool:
        folder = claim_folder(self.out or Path(f"runs/bench-{self.name}"), force=self.force)
        began = perf_counter()
        found = self.measure()
        seconds = perf_counter() - began
        for title, table in found.tables.items():
            table.print(title)
        lines = CPU.read_text(encoding="utf-8").splitlines() if CPU.exists() else []
        models = [line.partition(": ")[2] for line in lines if line.startswith("model name")]
        processor = models[0] if models else platform.processor() or platform.machine()
        machine = {"processor": processor, "cores": os.cpu_count(), **versions("vmas", "mpe2")}
        # Other work on the machine bends ratios too: an idle one has a load of about 1.
        load = os.getloadavg()
        print(f"{processor}, {os.cpu_count()} cores; {seconds:.0f} s in all")
        print(f"load average {load[0]:.2f}; written to {folder}")
        record = {"command": command, "machine": machine, "seconds": seconds, "load": load}
        write_json(folder / f"{self.name}.json", {**record, **found.values})
        return True
