"""Writing a file as a whole or not at all, and never over another one unasked."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mbn_marl.errors import MbnError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends well.

    Missing folders are made. If the block fails, ``path`` is left as it was.

    Raises:
        OSError: naming the place, if it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; a file name is needed")
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        temporary = Path(folder) / path.name
        yield temporary
        temporary.replace(path)


def claim_file(path: Path, *, force: bool = False) -> Path:
    """Make sure that no file is at ``path``.

    Args:
        path: where a new file is to be.
        force: a file that is already there is moved aside to ``<path>.1``, ``<path>.2``, ... (the
            first free name), so nothing is lost.

    Returns:
        The path.

    Raises:
        MbnError: ``path`` is a folder, or a file and ``force`` is not set.
    """
    if path.is_dir():
        raise MbnError(f"{path} is a folder; the output must be a file")
    if path.exists():
        if not force:
            raise MbnError(
                f"{path} already exists; choose another name, or pass --force to move it aside"
            )
        path.rename(free_name(path))
    return path


def free_name(path: Path) -> Path:
    """The first of ``<path>.1``, ``<path>.2``, ... that is not there."""
    number = 1
    while (candidate := path.with_name(f"{path.name}.{number}")).exists():
        number += 1
    return candidate
