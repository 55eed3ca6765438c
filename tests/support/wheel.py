"""The wheel of this checkout."""

import shutil
import subprocess
import sys
from pathlib import Path

from tests.support.pages import ROOT

SOURCES = ("mbn_marl", "baselines", "benchmarks", "envs_catalog", "tests")
FILES = ("pyproject.toml", "README.md", "LICENSE")


def build_wheel(folder: Path) -> Path:
    source, built = folder / "source", folder / "wheel"
    for name in SOURCES:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, source / name, ignore=ignored)
    for name in FILES:
        shutil.copy(ROOT / name, source / name)
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "-w", str(built), str(source)], check=True)
    (wheel,) = built.glob("*.whl")
    return wheel
