"""Folders and files of runs: claimed without overwriting, written whole or not at all."""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
import socket
import stat
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.runs.checksums import LIST, check, digests_of
from mbn_marl.errors import DamageError, MbnError
from mbn_marl.files import free_name, replacing

NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP)
"""Errors of drives without locks; for ``ENOSYS`` the library takes a file in their place."""
LOCK = ".lock"
"""In the folder of a running process: which process that is."""


class RunError(MbnError):
    """A run folder is missing, incomplete, in use, or would be overwritten."""


def claim_folder(path: Path, *, force: bool = False) -> Path:
    """Create the folder ``path``; with ``force`` move one that is there aside to ``<path>.1``, ...

    Raises:
        RunError: ``path`` is a file, or a folder with something in it and ``force`` is not set or
            a process is running there.
    """
    if path.exists() and not path.is_dir():
        raise RunError(f"{path} is a file; the output must be a folder")
    check_text(str(path))
    if path.is_dir() and not is_untouched(path):
        if not force:
            raise RunError(
                f"{path} already exists; choose another --out, or pass --force to move it aside"
            )
        for lock in list(path.rglob(LOCK)):
            with alone(lock.parent, "mbn"):
                pass
        path.rename(free_name(path))
    path.mkdir(parents=True, exist_ok=True)
    return path


def is_untouched(path: Path) -> bool:
    """Return whether a folder has at most what a process leaves that is killed at its start."""
    names = [file.name for file in path.iterdir()]
    return all(name == LOCK or name.startswith(".config.json.") for name in names)


def check_text(words: str) -> None:
    """Check that a path or a command can be written to a file.

    Raises:
        RunError: it has bytes that are not UTF-8.
    """
    try:
        words.encode()
    except UnicodeEncodeError:
        raise RunError(f"{words!a} is not UTF-8; allowed: names in UTF-8") from None


@contextmanager
def reading(place: Path) -> Iterator[None]:
    """Name ``place`` in any error that its content causes.

    Raises:
        RunError: in place of what a value of a wrong kind makes others raise.
    """
    try:
        yield
    except MbnError as error:
        if isinstance(error, DamageError) or str(place) in str(error):
            raise
        raise RunError(f"{place}: {error}") from None
    except WRONG_CONTENT as error:
        raise RunError(f"{place} holds what no run writes: {error!r}") from error


WRONG_CONTENT = (
    *(ArithmeticError, AttributeError, LookupError, MemoryError),
    *(RuntimeError, TypeError, ValueError),
)


@contextmanager
def alone(folder: Path, command: str, hint: str = "", patience: float = 0) -> Iterator[None]:
    """Hold the lock of a folder that exists; the system frees it however this process ends.

    Raises:
        RunError: another process holds it for longer than ``patience`` seconds; with its command,
            or else this one's, and ``hint``.
    """
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
    """Return a line for each entry of ``asked`` that was recorded otherwise, of JSON values."""
    return [
        f"{name}: recorded is {recorded.get(name)!r}, asked for is {value!r}"
        for name, value in asked.items()
        if recorded.get(name) != value
    ]


def moved_aside(path: Path) -> bool:
    """Return whether ``path`` was moved aside by ``force``, and its successor is there."""
    return path.suffix[1:].isdecimal() and path.with_suffix("").exists()


def write_text(path: Path, text: str) -> None:
    """Write ``text`` atomically: a reader sees the old file or the new one, never a part."""
    with replacing(path) as temporary:
        temporary.write_text(text, "utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON, atomically. NaN and infinity are refused."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file of a run.

    Raises:
        RunError: the file is missing or is not JSON.
        DamageError: see :func:`~baselines.runs.checksums.check`.
    """
    try:
        check(path)
        return json.loads(path.read_bytes())
    except FileNotFoundError:
        raise RunError(f"{path} is missing: {path.parent} is not a finished run") from None
    except MbnError:
        raise
    except (ValueError, RecursionError) as error:  # no text, no JSON, or nested without end
        raise RunError(f"{path} is not valid JSON: {error}") from None


def read_text(path: Path) -> str:
    """Read a text file of a run; raise a RunError if it is missing or no text."""
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{path} cannot be read: {error}") from None


def seal(folder: Path) -> None:
    """List the checksums of the files in ``folder``, none of which may change from now on."""
    write_json(folder / LIST, {"sha256": digests_of(folder)})


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]], *, compress: bool = False) -> None:
    """Write arrays by name as ``.npz``, atomically."""
    save = np.savez_compressed if compress else np.savez
    with replacing(path) as temporary:
        save(temporary, allow_pickle=False, **arrays)


def read_arrays(
    path: Path, like: Mapping[str, NDArray[Any]] | None = None
) -> dict[str, NDArray[Any]]:
    """Read what :func:`write_arrays` wrote; nothing in a file is run.

    Args:
        path: the file.
        like: arrays that are as large as its own may be, even if those shrank to nearly nothing.

    Raises:
        RunError: the file is missing or damaged, or is another kind of archive.
        DamageError: it does not have the checksum that its folder lists.
    """
    try:
        check(path)
        own = 2 * sum(array.nbytes for array in (like or {}).values())
        _check_members(path, max(own, ROOM, EXPANSION * path.stat().st_size))
        with np.load(path, allow_pickle=False) as arrays:
            return dict(arrays)
    except MbnError:
        raise
    except UNREADABLE as error:
        raise RunError(f"{path} cannot be read: {error}") from None


ROOM, EXPANSION = 1 << 26, 100
"""The bytes that the arrays of any file may have, and how many times those of the file."""
UNREADABLE = (
    *(OSError, ValueError, EOFError, NotImplementedError, MemoryError),
    *(zipfile.BadZipFile, zlib.error),
)
"""The errors of Python's and NumPy's readers for damaged archives."""
HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def _check_members(path: Path, room: int) -> None:
    """Check that an archive names only files inside it, whose arrays fit into ``room`` bytes."""
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            name = PurePosixPath(member.filename.replace("\\", "/"))
            leaves = name.is_absolute() or ".." in name.parts or ":" in member.filename
            if leaves or stat.S_ISLNK(member.external_attr >> 16):
                raise RunError(f"{path}: {member.filename!r} in it leads out of the archive")
        if (size := sum(member.file_size for member in archive.infolist())) > room:
            raise RunError(f"{path}: {size:,} bytes in it; allowed: {room:,}")
        for member in archive.infolist():
            with archive.open(member) as file:
                shape, _, dtype = HEADERS[np.lib.format.read_magic(file)](file)
                if math.prod(shape) * dtype.itemsize > member.file_size:
                    wrong = f"has no room for {shape} of {dtype}"
                    raise RunError(f"{path}: {member.filename!r} in it {wrong}")


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
