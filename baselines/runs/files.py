"""Folders and files of runs: claimed without overwriting, written whole, with their origin."""

import errno
import importlib.metadata
import json
import os
import platform
import shutil
import socket
import subprocess
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import MbnError, check_text
from mbn_marl.files import check_free, claim_file, free_name, replacing

# Errors of drives without locks; for ``ENOSYS`` the library uses a file instead.
NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP)
PACKAGES = (
    *("mbn-marl", "numpy", "numba", "gymnasium", "pettingzoo", "sb3-contrib", "stable-baselines3"),
    *("supersuit", "tensordict", "torch", "torchrl"),
)
# The file in the folder of a running process that names this process.
LOCK = ".lock"


class RunError(MbnError):
    """A run folder is missing, incomplete, damaged, in use, or would be overwritten."""


def claim_folder(path: Path, *, force: bool = False) -> Path:
    """Create the folder ``path``; ``force`` moves one that is there aside to ``<path>.1``, ..."""
    check_text(str(path))
    if path.exists() and not path.is_dir():
        raise RunError(f"{path} is a file; the output must be a folder")
    if path.is_dir() and not is_untouched(path):
        if not force:
            raise RunError(
                f"{path} already exists; choose another folder, or pass --force to move it aside"
            )
        aside = free_name(path)  # raises for ".", before locks are touched
        for lock in list(path.rglob(LOCK)):
            with alone(lock.parent, "mbn"):
                pass
        path.rename(aside)
    path.mkdir(parents=True, exist_ok=True)
    return path


def is_untouched(path: Path) -> bool:
    """Return whether a folder has at most what a process leaves that is killed at its start."""
    names = [file.name for file in path.iterdir()]
    return all(name == LOCK or name.startswith(".config.json.") for name in names)


@contextmanager
def reading(place: Path) -> Iterator[None]:
    """Turn every error that the content of ``place`` causes into a RunError that names it."""
    try:
        yield
    except MbnError as error:
        if str(place) in str(error):
            raise
        raise RunError(f"{place}: {error}") from None
    except (OSError, ImportError):
        raise
    except Exception as error:
        raise RunError(f"{place} holds what no run writes: {error!r}") from error


@contextmanager
def alone(folder: Path, command: str, hint: str = "", patience: float = 0) -> Iterator[None]:
    """Hold the lock of a folder, which the system frees however this process ends."""
    from filelock import FileLock, Timeout

    place = folder / LOCK
    lock = FileLock(place, timeout=patience)
    try:
        lock.acquire()
    except Timeout:
        holder = command
        with suppress(OSError, ValueError, TypeError, KeyError):  # it is not recorded yet
            recorded = json.loads(place.read_text())
            holder = "{command} (process {pid} on {host} since {since})".format(**recorded)
        raise RunError(f"{folder}: another {holder} is running here{hint}") from None
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        warnings.warn(f"{folder}: no locks on this drive; start no second process", stacklevel=3)
    try:
        with suppress(OSError):  # the name is a courtesy; the lock itself is the system's
            since = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
            who = {"pid": os.getpid(), "host": socket.gethostname(), "since": since}
            place.write_text(json.dumps({"command": command, **who}) + "\n")
        yield
    finally:
        with suppress(OSError):
            place.unlink()  # while the lock is held, so that nobody locks a removed file
        lock.release()


def differences(recorded: Mapping[str, Any], asked: Mapping[str, Any]) -> list[str]:
    return [
        f"{name}: recorded is {recorded.get(name)!r}, asked for is {value!r}"
        for name, value in asked.items()
        if recorded.get(name) != value
    ]


def write_text(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, "utf-8")


def write_json(path: Path, value: Any) -> None:
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_json(path: Path, kind: type[Any] = object) -> Any:
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise RunError(f"{path} is missing: {path.parent} is not a finished run") from None
    except (ValueError, RecursionError) as error:  # no text, no JSON, or nested without end
        raise RunError(f"{path} is not valid JSON: {error}") from None
    if not isinstance(content, kind):
        raise RunError(f"{path} is {type(content).__name__}; allowed: {kind.__name__}")
    return content


def read_text(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{path} cannot be read: {error}") from None


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]], *, compress: bool = False) -> None:
    save = np.savez_compressed if compress else np.savez
    with replacing(path) as temporary:
        save(temporary, allow_pickle=False, **arrays)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return dict(arrays)
    except Exception as error:  # the readers of damaged archives raise many kinds
        raise RunError(f"{path} cannot be read: {error}") from None


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder that replaces ``path`` when the block succeeds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        new = temporary / path.name
        new.mkdir()
        yield new
        if path.exists():
            path.rename(temporary / "old")
        new.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_provenance(path: Path, command: str) -> None:
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
    root = Path(__file__).resolve().parents[2]
    describe = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    if (root / ".git").exists():
        with suppress(OSError, subprocess.CalledProcessError):
            found = subprocess.run(describe, cwd=root, capture_output=True, text=True, check=True)
            return found.stdout.strip()
    return None


@dataclass(frozen=True)
class Place:
    """The Markdown page of a report, and the folder of everything else."""

    page: Path
    folder: Path

    @classmethod
    def of(cls, out: Path, page: str) -> Self:
        if out.suffix == ".md":
            return cls(out, out.with_suffix(""))
        return cls(out / page, out)

    def claim(self, *, force: bool) -> None:
        beside = self.page.parent != self.folder
        if beside:
            check_free(self.page, force=force)
        claim_folder(self.folder, force=force)
        if beside:
            claim_file(self.page, force=force)

    def link(self, name: str) -> str:
        return (self.folder / name).relative_to(self.page.parent).as_posix()
