"""Random fields: how fast they are made, and whether all are valid."""

from __future__ import annotations

from dataclasses import dataclass
from time import process_time
from typing import Any, ClassVar

import numpy as np

from benchmarks.report import Advance, Benchmark, Findings, Measurement
from mbn_marl.errors import ConfigError, FieldError
from mbn_marl.field import FieldSampler
from mbn_marl.field.families import make_fields
from mbn_marl.field.layout import FAMILIES, make_tables
from mbn_marl.field.sampler import field_of

RANGES: tuple[dict[str, Any], ...] = (
    {},
    {"robots": (1, 6), "rois": (1, 10), "size": (140, 420)},
    {"robots": 3, "rois": 6, "size": 100},
    {"robots": (1, 64), "rois": (1, 24), "size": (410, 1000)},
    {"robots": (1, 7), "rois": (1, 24), "size": (200, 100_000), "arena": (1e6, 1e5)},
)
"""Of robots, ROIs and sizes; the first are the usual ones: 3 robots, 6 ROIs, 110 to 420 units."""
AT_ONCE = 1000
"""How many fields one compiled call makes."""


@dataclass(frozen=True)
class Fields(Benchmark):
    """Make random fields of every family and of several ranges; validate each by `Field`."""

    name: ClassVar[str] = "fields"

    count: int = 10_000
    """How many in all, in equal parts; rounded up."""
    seed: int = 0
    """Of the samplers."""

    @property
    def stages(self) -> int:  # type: ignore[override]
        """One for each family and range."""
        return len(FAMILIES) * len(RANGES)

    def measure(self, advance: Advance) -> Findings:
        """Make the fields of each family and range."""
        if self.count < 1:
            raise ConfigError("fields", [f"count: at least 1, not {self.count}"])
        each = -(-self.count // self.stages)
        rows, problems, total = [], [], 0.0
        for k, ranges in enumerate(RANGES):
            for family in FAMILIES:
                sampler = FieldSampler((family,), **ranges, seed=self.seed)
                making, checking, found = self._make(sampler, each)
                problems += found
                total += making + checking
                if k == 0:
                    name = f"{family}: fields a second, not validated"
                    rows.append(Measurement(name, each / making, "1/s", 2000.0))
                advance()
        count = each * self.stages
        rows.append(Measurement("all: fields a second, each validated", count / total, "1/s"))
        rows.append(Measurement("invalid", len(problems), "", 0.0, at_least=False))
        title = f"{count:,} random fields, seed {self.seed}; seconds of processor time"
        return Findings(title, rows, remarks=problems[:10], details={"invalid": problems})

    def _make(self, sampler: FieldSampler, count: int) -> tuple[float, float, list[str]]:
        """Return the seconds of making and of validating, and what was not valid."""
        tables = make_tables(sampler.most_edges, sampler.most_rois, sampler.most_robots, AT_ONCE)
        scratch = np.zeros((sampler.scratch_rows, AT_ONCE), np.int64)
        families = np.zeros(AT_ONCE, np.int64)
        make_fields(sampler.numbers(), sampler.seed, 0, 0, scratch, tables, families[:1])
        making, checking, problems = 0.0, 0.0, list[str]()
        for first in range(0, count, AT_ONCE):
            own = families[: min(AT_ONCE, count - first)]
            began = process_time()
            make_fields(sampler.numbers(), sampler.seed, first, 0, scratch, tables, own)
            making += process_time() - began
            began = process_time()
            for f in range(len(own)):
                name = f"{sampler.families[0]}-{sampler.seed}-{first + f}-0"
                try:
                    field_of(tables, sampler.arena, name, f)
                except FieldError as error:
                    problems.append(f"{name}, {sampler}: {error}")
            checking += process_time() - began
        return making, checking, problems
