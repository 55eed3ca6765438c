"""What others did on this machine meanwhile: contention bends ratios too, not only rates."""

from __future__ import annotations

import os
from pathlib import Path
from time import perf_counter

STAT = Path("/proc/stat")
IDLE = (3, 4)
"""Places of the idle and the waiting time among the counters of ``/proc/stat``."""
ALLOWED = 0.1
"""Cores that others may use before a result is doubtful."""


class OtherLoad:
    """Cores that other processes have used since this object was made."""

    def __init__(self) -> None:
        self._start = perf_counter()
        self._others = _others()

    def cores(self) -> float | None:
        """The mean number of them, or ``None`` where the system does not tell."""
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
