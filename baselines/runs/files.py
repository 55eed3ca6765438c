"""Folders and files of runs: claimed without overwriting, written whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import socket
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from baselines.runs.checksums import LIST, check, digests_of
from mbn_marl.errors import MbnError
from mbn_marl.files import free_name, replacing

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
    # A process that is killed before its first write leaves at most these.
    if path.is_dir() and any(
        file.name != LOCK and not file.name.startswith(".config.json.") for file in path.iterdir()
    ):
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


@contextmanager
def alone(folder: Path, command: str, hint: str = "") -> Iterator[None]:
    """Hold the lock of a folder that exists; the system frees it however this process ends.

    Raises:
        RunError: another process holds it; with its command, or else this one's, and ``hint``.
    """
    place = folder / LOCK
    lock = FileLock(place, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        holder = command
        with suppress(OSError, ValueError, TypeError, KeyError):  # it is not recorded yet
            recorded = json.loads(place.read_text())
            holder = "{command} (process {pid} on {host} since {since})".format(**recorded)
        raise RunError(f"{folder}: another {holder} is running here{hint}") from None
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


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read what :func:`write_arrays` wrote; nothing in a file is run.

    Raises:
        RunError: the file is missing or damaged, or is another kind of archive.
        DamageError: it does not have the checksum that its folder lists.
    """
    try:
        check(path)
        _check_members(path)
        with np.load(path, allow_pickle=False) as arrays:
            return dict(arrays)
    except MbnError:
        raise
    except UNREADABLE as error:
        raise RunError(f"{path} cannot be read: {error}") from None


UNREADABLE = (OSError, ValueError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""The errors of Python's and NumPy's readers for damaged archives."""


def _check_members(path: Path) -> None:
    """Check that an archive names only files inside it; raise an error if it does not."""
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            name = PurePosixPath(member.filename.replace("\\", "/"))
            leaves = name.is_absolute() or ".." in name.parts or ":" in member.filename
            if leaves or stat.S_ISLNK(member.external_attr >> 16):
                raise RunError(f"{path}: {member.filename!r} in it leads out of the archive")


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
