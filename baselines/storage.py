"""Folders and files of runs: claimed without overwriting, written whole or not at all."""

from __future__ import annotations

import json
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from mbn_marl.errors import MbnError
from mbn_marl.render.files import free_name, replacing

LOCK = ".lock"


class RunError(MbnError):
    """A run folder is missing, incomplete, at work, or would be overwritten."""


def claim_folder(path: Path, *, force: bool = False) -> Path:
    """Create the folder ``path`` for a new run or comparison.

    Args:
        path: the folder; parents are created.
        force: a folder that is already there is moved aside to ``<path>.1``, ``<path>.2``, ...
            (the first free name), so nothing is lost.

    Raises:
        RunError: ``path`` is a file, or a folder with something in it and ``force`` is not set or
            a process is at work there.
    """
    if path.exists() and not path.is_dir():
        raise RunError(f"{path} is a file; the output must be a folder")
    if path.is_dir() and any(path.iterdir()):
        if not force:
            raise RunError(
                f"{path} already exists; choose another --out, or pass --force to move it aside"
            )
        for lock in path.rglob(LOCK):
            with alone(lock.parent, "mbn"):
                pass
        path.rename(free_name(path))
    path.mkdir(parents=True, exist_ok=True)
    return path


@contextmanager
def alone(folder: Path, command: str, hint: str = "") -> Iterator[None]:
    """Hold the lock of ``folder``; the system frees it whatever becomes of this process.

    Args:
        folder: it has to be there.
        command: what works there, such as ``"mbn train"``.
        hint: what to do instead.

    Raises:
        RunError: another process holds it.
    """
    lock = FileLock(folder / LOCK, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise RunError(f"{folder}: another {command} is at work here{hint}") from None
    try:
        yield
    finally:
        lock.release()


def moved_aside(path: Path) -> bool:
    """Whether ``path`` has a name that ``force`` gives, and what took its place is there."""
    return path.suffix[1:].isdecimal() and path.with_suffix("").exists()


def write_text(path: Path, text: str) -> None:
    """Write ``text`` atomically: a reader sees the old file or the new one, never a part."""
    with replacing(path) as temporary:
        temporary.write_text(text)


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON, atomically. NaN and infinity are refused."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file of a run.

    Raises:
        RunError: the file is missing or is not JSON.
    """
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise RunError(f"{path} is missing: {path.parent} is not a finished run") from None
    except (ValueError, RecursionError) as error:  # not text, not JSON, or nested without end
        raise RunError(f"{path} is not valid JSON: {error}") from None


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]], *, compress: bool = False) -> None:
    """Write arrays by name as ``.npz``, atomically."""
    save = np.savez_compressed if compress else np.savez
    with replacing(path) as temporary:
        save(temporary, allow_pickle=False, **arrays)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read what :func:`write_arrays` wrote; no file can make this run code.

    Raises:
        RunError: the file is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return dict(arrays)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise RunError(f"{path} cannot be read: {error}") from None


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """A new folder that takes the place of ``path`` when the block ends well, whole or not at all.

    If the block fails or is killed, ``path`` is left as it was.
    """
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
