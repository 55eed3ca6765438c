"""Configurations that tests share, and how the processes of a run share what they compile."""

import fcntl
import hashlib
import tempfile
from pathlib import Path
from typing import Any

import numba
import pytest
from numba.core.caching import NullCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

from mbn_marl import Failures, Uniform
from mbn_marl.config import CONDITIONS
from mbn_marl.field import FieldSampler
from mbn_marl.field.generator.layout import FAMILIES

# The engine is compiled for each combination of a precision with what is on, for many seconds each.
# So a test takes one of these configurations, unless what it checks needs another.
PRECISIONS = ["float32", pytest.param("float64", marks=pytest.mark.slow)]
NOUGHT = Uniform(0.0, 0.0)  # is compiled and changes nothing, not even by rounding
EVERYTHING: dict[str, Any] = {
    **{"dtype": "float64", "dynamics": ("point_mass", "holonomic", "unicycle")},
    **{"gust": NOUGHT, "action_loss": NOUGHT, "dropout": NOUGHT},
    **{"gust_time": Uniform(10.0, 10.0), "failures": Failures()},
}  # Headings, drawn numbers, disturbances and failures; a test says which of them do something
SIGHTS: dict[str, dict[str, Any]] = {
    **{name: {"observation": name} for name in ("relative", "local", "state")},
    **{name: {"observation": name} for name in ("lidar", "lidar_local")},
    "entities": {"observation": "entities", "assignment": True, "dtype": "float32"},
}  # Settings beside `EVERYTHING` for each observation
STORM: dict[str, Any] = {
    **{"observation": "entities", "assignment": True, **CONDITIONS["storm"]},
    **{"dynamics": "mixed", "mass": Uniform(0.8, 1.5), "tau": Uniform(0.8, 1.2)},
    **{"roi_radius": 20.0, "max_steps": 90},
}  # The same with entities and an assignment, in float32; all of it does something
STORM_OF_THREE = STORM | {"dynamics": ("holonomic", "unicycle", "bicycle")}
SAMPLER = FieldSampler(FAMILIES, robots=(2, 4), rois=(2, 6), seed=5)


def pytest_configure() -> None:
    """Let a process wait for a function that another one compiles, and load it then."""
    compile_here = Dispatcher.compile
    folder = Path(numba.config.CACHE_DIR or tempfile.gettempdir()) / "locks"
    folder.mkdir(parents=True, exist_ok=True)

    def compile_once(self: Any, signature: Any) -> Any:
        if isinstance(self._cache, NullCache):
            return compile_here(self, signature)
        function = f"{self.py_func.__module__}.{self.py_func.__qualname__}{signature}"
        name = hashlib.sha256(function.encode()).hexdigest()[:32]
        with global_compiler_lock, (folder / name).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            return compile_here(self, signature)

    Dispatcher.compile = compile_once


def entries(engine: Any, robot: int, world: int = 0) -> dict[str, float]:
    row = engine._backend.output.observations[world, robot]
    assert ((row >= engine.observation_low) & (row <= engine.observation_high)).all()
    return dict(zip((entry.name for entry in engine.observation_table), row.tolist(), strict=True))
