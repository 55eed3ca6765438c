"""Atomic writes of files, and free names for them."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mbn_marl.errors import MbnError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that takes its place when the block succeeds.

    Missing folders are made. If the block fails or the machine stops, ``path`` is as it was.

    Raises:
        OSError: ``path`` cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; a file name is needed")
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        temporary = Path(folder) / path.name
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())  # before the rename, or a crash could leave an empty file
        temporary.replace(path)


def check_free(path: Path, *, force: bool = False) -> None:
    """Raise an MbnError if ``path`` is a folder, or a file and ``force`` is not set."""
    if path.is_dir():
        raise MbnError(f"{path} is a folder; the output must be a file")
    if path.exists() and not force:
        allowed = "choose another name, or pass --force to move it aside"
        raise MbnError(f"{path} already exists; {allowed}")


def check_ending(path: Path, *allowed: str) -> Path:
    if path.suffix.lower() not in allowed:
        raise MbnError(f"{path}: the file name has to end in {', '.join(allowed)}")
    return path


def claim_file(path: Path, *, force: bool = False) -> Path:
    """Make ``path`` free for a new file; with ``force`` an old one moves to :func:`free_name`."""
    check_free(path, force=force)
    if path.exists():
        path.rename(free_name(path))
    return path


def free_name(path: Path) -> Path:
    if path.name in ("", ".."):
        raise MbnError(f"{path} cannot be moved aside; choose another folder")
    number = 1
    while (candidate := path.with_name(f"{path.name}.{number}")).exists():
        number += 1
    return candidate
