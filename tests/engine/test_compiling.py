"""Compiled code is reused between processes, and never after a rule has changed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import mbn_marl

PROBE = """
import numpy as np
from mbn_marl.config import make_config
from mbn_marl.engine.reset import in_field
from mbn_marl.engine.state import make_geometry
from mbn_marl.field import Field

field = Field([(0, 0), (100, 0), (100, 100), (0, 100)], rois=[(20, 20)], starts=[(50, 50)])
inside = in_field(make_geometry([field], make_config({}), 1, 1), 0, np.float32(50), np.float32(50))
print(inside, sum(in_field.alone.stats.cache_hits.values()))
"""


def probe(folder: Path) -> list[str]:
    environment = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / "nb")}
    command = [sys.executable, "-c", PROBE]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.split()


def test_cache_is_used_and_renewed(tmp_path: Path) -> None:
    package = Path(mbn_marl.__file__).parent
    for name in ("mbn_marl", "envs_catalog"):
        shutil.copytree(package.parent / name, tmp_path / name)
    assert probe(tmp_path) == ["True", "0"]
    assert probe(tmp_path) == ["True", "1"]
    rules = tmp_path / "mbn_marl" / "engine" / "rules.py"  # in_field itself is in another file
    source = rules.read_text(encoding="utf-8")
    assert "return (seen ^ " in source
    rules.write_text(source.replace("return (seen ^ ", "return 0 * (seen ^ ", 1), encoding="utf-8")
    assert probe(tmp_path) == ["False", "0"]
