"""Where a result comes from: the command, and the versions that it ran with."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

from baselines.runs.files import write_json, write_text

PACKAGES = (
    *("mbn-marl", "numpy", "numba", "gymnasium", "pettingzoo", "sb3-contrib", "stable-baselines3"),
    *("supersuit", "tensordict", "torch", "torchrl"),
)


def write_provenance(path: Path, command: str) -> None:
    """Record in the folder ``path`` the exact command, and the versions it ran with."""
    write_text(path / "command.txt", command + "\n")
    write_json(path / "versions.json", versions())


def versions(*more: str) -> dict[str, Any]:
    """Return Python, packages and ``more``, machine, git revision (``None`` outside a clone)."""
    packages: dict[str, str | None] = dict.fromkeys((*PACKAGES, *more))
    for name in packages:
        with suppress(importlib.metadata.PackageNotFoundError):
            packages[name] = importlib.metadata.version(name)
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processors": os.cpu_count(),
        "git_revision": _git_revision(),
        "packages": packages,
    }


def _git_revision() -> str | None:
    """Return the revision of the clone with this file, with ``-dirty`` if it was changed."""
    root = Path(__file__).resolve().parents[2]
    describe = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    if (root / ".git").exists():
        with suppress(OSError, subprocess.CalledProcessError):
            found = subprocess.run(describe, cwd=root, capture_output=True, text=True, check=True)
            return found.stdout.strip()
    return None
