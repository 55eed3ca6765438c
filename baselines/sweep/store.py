"""Stores of run folders, and notes about the progress of each run.

A store is the only memory of a sweep: whoever trains a run, on whatever machine, reads and writes
here. ``.grid/NAME.json`` is the last note about a run; it informs people and decides nothing.

In a folder (:class:`Store`) runs are trained in place, and the lock of each run folder keeps two
processes apart. Elsewhere (:class:`RemoteStore`), where there may be no locks, a run is trained in
a scratch folder and copied as one file: ``.grid/NAME-STEPS.zip`` at checkpoints, ``NAME.zip`` at
its end.
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
import shutil
import tempfile
import time
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

from filelock import FileLock
from fsspec.core import url_to_fs
from pydantic import BaseModel, ConfigDict, ValidationError

from baselines.runs.files import LOCK, UNREADABLE, RunError, replacing_folder, write_json
from baselines.runs.folder import RunFolder
from mbn_marl.errors import MbnError

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

NOTES = ".grid"
LOST = 900.0
"""Seconds after its last note from which a run no longer counts as running."""


class Note(BaseModel):
    """The progress of a run, as the last process that trained it noted it.

    ``attempt`` counts how often it has been begun or resumed; ``steps_per_second`` is of this
    attempt, with evaluations; ``updated`` is in seconds since 1970.
    """

    model_config = ConfigDict(frozen=True)

    state: Literal["running", "done", "diverged", "failed"] = "running"
    attempt: int = 1
    machine: str = ""
    process: int = 0
    env_steps: int = 0
    steps_per_second: float = 0.0
    updated: float = 0.0
    error: str | None = None

    @property
    def alive(self) -> bool:
        """Return whether the run is being trained, as far as can be seen from here."""
        if self.state != "running" or time.time() - self.updated > LOST:
            return False
        processes = Path("/proc")
        elsewhere = self.machine != platform.node() or not processes.is_dir()
        return elsewhere or (processes / str(self.process)).exists()


class Store:
    """A folder of run folders that every machine sees under the same path, and a note about each.

    Raises:
        MbnError: a URL is of an unknown kind, or its package is not installed.
    """

    refresh = 1.0
    """Seconds between two looks at all of it."""

    def __init__(self, place: str) -> None:
        try:
            found: tuple[AbstractFileSystem, str] = url_to_fs(place)
        except (ImportError, ValueError) as error:
            raise MbnError(f"{place}: {error}") from None
        self._files, root = found
        self._root = root.rstrip("/")

    def finished(self, names: Collection[str]) -> set[str]:
        """Return those of ``names`` whose run is finished."""
        return {name for name in names if RunFolder(self.folder(name)).finished}

    def config(self, name: str) -> dict[str, Any]:
        """Return the ``config.json`` of a finished run."""
        return RunFolder(self.folder(name)).config

    def folder(self, name: str) -> Path:
        """Return where a run is trained on this machine."""
        return Path(self._root) / name

    def source(self, name: str) -> Path:
        """Return the folder of a finished run on this machine."""
        return self.folder(name)

    def restore(self, name: str) -> None:
        """Copy the newest checkpoint of a run to where it is trained; in a folder, do nothing."""

    def keep(self, name: str) -> None:
        """Copy the newest checkpoint of a run into the store; in a folder, do nothing."""

    def finish(self, name: str) -> None:
        """Copy a finished run into the store; in a folder, do nothing."""

    def note(self, name: str, note: Note) -> None:
        """Write a note, whole or not at all."""
        with self._replacing(f"{NOTES}/{name}.json") as place:
            self._files.pipe_file(place, note.model_dump_json(indent=2).encode())

    def notes(self) -> dict[str, Note]:
        """Return every note, by the run's name; raise a RunError that names an unreadable one."""
        paths = [path for path in self._list(NOTES) if path.endswith(".json")]
        notes = {}
        for path, text in (self._files.cat(paths) if paths else {}).items():
            try:
                notes[PurePosixPath(path).stem] = Note.model_validate_json(text)
            except ValidationError as error:
                why = error.errors()[0]["msg"]
                raise RunError(f"{path} is not a note about a run ({why}); remove it") from None
        return notes

    def last_note(self, name: str) -> Note | None:
        """Return the note about a run; ``None`` if there is none that can be read."""
        with suppress(FileNotFoundError, ValidationError):
            text = self._files.cat_file(f"{self._root}/{NOTES}/{name}.json")
            return Note.model_validate_json(text)
        return None

    def _list(self, folder: str = "") -> list[str]:
        """Return the paths in a folder of the store, as they are now."""
        self._files.invalidate_cache()
        with suppress(FileNotFoundError):
            return sorted(self._files.ls(f"{self._root}/{folder}".rstrip("/"), detail=False))
        return []

    @contextmanager
    def _replacing(self, name: str) -> Iterator[str]:
        """Yield a path to write, which then replaces the file ``name``."""
        target = f"{self._root}/{name}"
        self._files.makedirs(target.rpartition("/")[0], exist_ok=True)
        new = f"{target}.{uuid4().hex}"
        yield new
        self._files.mv(new, target)


class RemoteStore(Store):
    """A place that fsspec knows, such as ``s3://bucket/folder``: a file for each run."""

    refresh = 10.0

    def __init__(self, place: str) -> None:
        super().__init__(place)
        own = hashlib.sha256(place.encode()).hexdigest()[:12]
        self._scratch = Path(tempfile.gettempdir()).resolve() / f"mbn-grid-{own}"

    def finished(self, names: Collection[str]) -> set[str]:
        """Return those of ``names`` whose run is finished; refuse folders of older versions."""
        there = {PurePosixPath(path).name for path in self._list()}
        done = {name for name in names if f"{name}.zip" in there}
        if older := sorted((there & set(names)) - done):
            raise RunError(
                f"{self._root} has runs of an older version; pack the files of each folder NAME "
                f"into NAME.zip (cd NAME; zip -r ../NAME.zip .): {', '.join(older)}"
            )
        return done

    def config(self, name: str) -> dict[str, Any]:
        """Return the ``config.json`` of a finished run."""
        with self._files.open(f"{self._root}/{name}.zip") as file, zipfile.ZipFile(file) as archive:
            return dict(json.loads(archive.read("config.json")))

    def folder(self, name: str) -> Path:
        """Return the scratch folder that a run is trained in on this machine."""
        return self._scratch / name

    def source(self, name: str) -> Path:
        """Return a copy of a finished run, made once a machine."""
        folder = self._scratch / "sources" / name
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{folder}.lock"):
            self.fetch(name, folder)
        return folder

    def restore(self, name: str) -> None:
        """Copy the newest checkpoint of a run here, unless there is one as new or newer."""
        kept, run = self._checkpoints(name), RunFolder(self.folder(name))
        if kept and (run.checkpoint is None or run.saved_steps < max(kept)):
            self._unpack(kept[max(kept)], run.path)
            if source := run.config["transferred_from"]:
                moved = {"transferred_from": str(self.source(Path(source).name))}
                write_json(run.path / "config.json", {**run.config, **moved})

    def keep(self, name: str) -> None:
        """Copy the newest checkpoint of a run into the store."""
        newest = RunFolder(self.folder(name)).checkpoint
        older = self._checkpoints(name)
        if newest is not None:
            self._pack(name, f"{NOTES}/{name}-{newest.name}.zip")
            for path in (path for steps, path in older.items() if steps < int(newest.name)):
                self._files.rm_file(path)

    def finish(self, name: str) -> None:
        """Copy a finished run into the store, and remove its checkpoints there and its folder."""
        self._pack(name, f"{name}.zip")
        for path in self._checkpoints(name).values():
            self._files.rm_file(path)
        shutil.rmtree(self.folder(name))

    def fetch(self, name: str, out: Path) -> None:
        """Copy a finished run into the folder ``out``, unless it is there already."""
        if not RunFolder(out).finished:
            self._unpack(f"{self._root}/{name}.zip", out)

    def _checkpoints(self, name: str) -> dict[int, str]:
        """Return the archives of a run's checkpoints by their env-steps."""
        archive = re.compile(rf".*/{re.escape(name)}-(\d+)\.zip")
        found = map(archive.fullmatch, self._list(NOTES))
        return {int(match[1]): match[0] for match in found if match}

    def _pack(self, name: str, target: str) -> None:
        """Copy the folder of a run into the store as one file, whole or not at all."""
        folder = self.folder(name)
        with tempfile.NamedTemporaryFile(suffix=".zip") as made, self._replacing(target) as place:
            with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
                for path in sorted(folder.rglob("*")):
                    if path.is_file() and path.name != LOCK:
                        archive.write(path, path.relative_to(folder))
            made.flush()
            self._files.put_file(made.name, place)

    def _unpack(self, path: str, folder: Path) -> None:
        """Copy an archive of the store into a folder, whole or not at all.

        Raises:
            RunError: it is damaged.
        """
        with tempfile.NamedTemporaryFile(suffix=".zip") as copy:
            self._files.get_file(path, copy.name)
            try:
                with replacing_folder(folder) as new, zipfile.ZipFile(copy.name) as archive:
                    archive.extractall(new)
            except UNREADABLE as error:
                raise RunError(f"{path} is damaged ({error}); remove it to begin again") from None


def open_store(place: str) -> Store:
    """Return the store at a path or a URL."""
    return RemoteStore(place) if "://" in place else Store(str(Path(place).resolve()))
