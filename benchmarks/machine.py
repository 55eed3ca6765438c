"""The machine that the figures are from, in words."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

from baselines.runs.provenance import versions

PEERS = ("vmas", "mpe2")


def describe_machine() -> dict[str, Any]:
    """Processor, usable cores, memory (GiB), and the versions of everything measured."""
    described = versions()
    described["packages"] |= {name: _version(name) for name in PEERS}
    return {"processor": _processor(), "cores": _cores(), "memory_gib": _memory(), **described}


def machine_line(machine: dict[str, Any]) -> str:
    """The description in a line or two."""
    packages = ", ".join(
        f"{name} {version}" for name, version in machine["packages"].items() if version
    )
    memory = "" if machine["memory_gib"] is None else f", {machine['memory_gib']:.0f} GiB"
    return (
        f"{machine['processor']}, {machine['cores']} cores{memory}; {machine['platform']}; "
        f"Python {machine['python']}, {packages}"
    )


def _cores() -> int:
    """How many cores this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _processor() -> str:
    """The processor's model; where Linux does not tell, what Python knows."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def _memory() -> float | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    except (AttributeError, ValueError, OSError):
        return None


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
