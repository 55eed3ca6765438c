"""How long a fresh process takes to its first step: with an empty cache, and with a filled one."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from time import perf_counter

from benchmarks.results import Row

FIRST_STEP = """
import numpy as np
from mbn_marl import BatchEngine
engine = BatchEngine("field_01", 4096)
engine.reset()
engine.step(np.zeros((4096, 3, 2), np.float32))
"""


def measure_startup() -> list[Row]:
    """Seconds from starting Python to the end of the first step."""
    with tempfile.TemporaryDirectory() as cache:
        first = _seconds(cache)
        later = sorted(_seconds(cache) for _ in range(3))[1]
    return [
        Row("first call on a machine (compiles)", first, "s", 20.0, False, "a fresh process"),
        Row("later starts (cached)", later, "s", 2.0, False, "a fresh process, median of 3"),
    ]


def _seconds(cache: str) -> float:
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    start = perf_counter()
    subprocess.run([sys.executable, "-c", FIRST_STEP], env=environment, check=True)
    return perf_counter() - start
