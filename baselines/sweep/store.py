"""Where a grid keeps its run folders, and how each of its cells stands.

A store is the only memory of a grid: whoever works on a cell, on whatever machine, reads and writes
here. ``NAME/`` is a run folder as ``mbn train`` makes it, ``.grid/NAME.json`` says who works on it.

In a folder (:class:`FolderStore`) runs are trained in place, and the lock of each run folder keeps
two processes apart. A store elsewhere (:class:`RemoteStore`) is any file system of fsspec, which
may know no locks and no renaming of folders: a run is trained in a scratch folder, kept in
``.grid/NAME-STEPS.zip`` at checkpoints, and uploaded when it is finished. ``.grid/NAME.json`` is
written last each time, and what it does not name does not count.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import time
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

from filelock import FileLock
from pydantic import BaseModel, ConfigDict, ValidationError

from baselines.runs.files import (
    RunError,
    check_members,
    read_json,
    replacing_folder,
    seal,
    write_json,
    write_text,
)
from baselines.runs.folder import FIXED, RunFolder
from mbn_marl.errors import ConfigError

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

NOTES = ".grid"
BEAT = 15.0
"""Seconds between two signs of life of a cell at work."""
LOST = 4 * BEAT
"""Seconds without one after which it is not at work any more."""
MARKER = "evaluation.json"


class State(BaseModel):
    """How a cell stands, as the one who worked on it last has noted.

    Attributes:
        state: what it does, or how it ended.
        grid: which call of ``mbn grid`` it belongs to.
        attempt: how often it has been begun or taken up.
        machine: where.
        process: the process's number there.
        env_steps: env-steps taken.
        steps_per_second: env-steps per second of this attempt, with everything.
        updated: when this was noted, seconds since 1970.
        error: what went wrong.
        archive: a store elsewhere: the file of the newest checkpoint.
        sha256: of that file.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    state: Literal["running", "done", "failed"]
    grid: str
    attempt: int
    machine: str
    process: int
    env_steps: int = 0
    steps_per_second: float = 0.0
    updated: float = 0.0
    error: str | None = None
    archive: str | None = None
    sha256: str | None = None

    @property
    def alive(self) -> bool:
        """Whether somebody is at work on it."""
        return self.state == "running" and time.time() - self.updated < LOST


class Store(ABC):
    """Run folders by name, and a note about each cell."""

    refresh: float
    """Seconds between two looks at all of it."""

    @abstractmethod
    def finished(self, names: Collection[str]) -> set[str]:
        """Those of ``names`` whose run is finished and here."""

    @abstractmethod
    def states(self) -> dict[str, State]:
        """Every note, by the run's name.

        Raises:
            RunError: one cannot be read; the message names it.
        """

    @abstractmethod
    def state(self, name: str) -> State | None:
        """The note about a run, if there is one.

        Raises:
            RunError: it cannot be read.
        """

    @abstractmethod
    def note(self, name: str, state: State) -> None:
        """Write a note, whole or not at all."""

    @abstractmethod
    def config(self, name: str) -> dict[str, Any]:
        """The ``config.json`` of a finished run."""

    @abstractmethod
    def folder(self, name: str) -> Path:
        """Where a run is trained on this machine."""

    @abstractmethod
    def take_up(self, name: str, state: State | None) -> None:
        """Put what is known of a run where it is trained.

        Args:
            name: of the run.
            state: the note about it.

        Raises:
            RunError: the checkpoint is not what was uploaded.
        """

    @abstractmethod
    def source(self, name: str) -> Path:
        """The folder of a finished run, on this machine."""

    @abstractmethod
    def keep(self, name: str, state: State) -> State:
        """Keep a new checkpoint for other machines; the note to write."""

    @abstractmethod
    def hand_in(self, name: str, state: State) -> None:
        """A run is finished: have it in the store, with the last note about it."""


class FolderStore(Store):
    """A folder that every machine sees under the same path.

    Args:
        path: of it.
    """

    refresh = 1.0

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()

    def finished(self, names: Collection[str]) -> set[str]:
        """See :class:`Store`."""
        return {name for name in names if RunFolder(self.folder(name)).finished}

    def states(self) -> dict[str, State]:
        """See :class:`Store`."""
        paths = sorted((self.path / NOTES).glob("*.json"))
        return {path.stem: _state(path.read_bytes(), str(path)) for path in paths}

    def state(self, name: str) -> State | None:
        """See :class:`Store`."""
        path = self._note(name)
        return _state(path.read_bytes(), str(path)) if path.exists() else None

    def note(self, name: str, state: State) -> None:
        """See :class:`Store`."""
        write_text(self._note(name), state.model_dump_json(indent=2) + "\n")

    def config(self, name: str) -> dict[str, Any]:
        """See :class:`Store`."""
        return RunFolder(self.folder(name)).config

    def folder(self, name: str) -> Path:
        """See :class:`Store`."""
        return self.path / name

    def take_up(self, name: str, state: State | None) -> None:
        """See :class:`Store`: it is there."""

    def source(self, name: str) -> Path:
        """See :class:`Store`."""
        return self.folder(name)

    def keep(self, name: str, state: State) -> State:
        """See :class:`Store`: it is there."""
        return state

    def hand_in(self, name: str, state: State) -> None:
        """See :class:`Store`: it is there."""
        self.note(name, state)

    def _note(self, name: str) -> Path:
        return self.path / NOTES / f"{name}.json"


class RemoteStore(Store):
    """A place that fsspec knows, such as ``s3://bucket/folder``.

    Args:
        url: of it.

    Raises:
        ConfigError: there is no such kind of place, or its package is not installed.
    """

    refresh = 10.0

    def __init__(self, url: str) -> None:
        from fsspec.core import url_to_fs

        try:
            found: tuple[AbstractFileSystem, str] = url_to_fs(url)
        except (ImportError, ValueError) as error:
            raise ConfigError("grid", [f"store: {url}: {error}"]) from None
        self._files, root = found
        self._root = root.rstrip("/")
        place = hashlib.sha256(url.encode()).hexdigest()[:12]
        self._scratch = Path(tempfile.gettempdir()) / f"mbn-grid-{place}"

    def finished(self, names: Collection[str]) -> set[str]:
        """See :class:`Store`."""
        states = self.states()
        return {name for name in names if name in states and states[name].state == "done"}

    def states(self) -> dict[str, State]:
        """See :class:`Store`."""
        self._files.invalidate_cache()
        try:
            there = self._files.ls(f"{self._root}/{NOTES}", detail=False)
        except FileNotFoundError:
            return {}
        texts = self._files.cat([path for path in there if path.endswith(".json")])
        return {Path(path).stem: _state(text, path) for path, text in sorted(texts.items())}

    def state(self, name: str) -> State | None:
        """See :class:`Store`."""
        path = f"{self._root}/{NOTES}/{name}.json"
        try:
            return _state(self._files.cat_file(path), path)
        except FileNotFoundError:
            return None

    def note(self, name: str, state: State) -> None:
        """See :class:`Store`."""
        path = f"{self._root}/{NOTES}/{name}.json"
        self._files.makedirs(f"{self._root}/{NOTES}", exist_ok=True)
        new = f"{path}.{uuid4().hex}"
        self._files.pipe_file(new, state.model_dump_json(indent=2).encode())
        self._files.mv(new, path)

    def config(self, name: str) -> dict[str, Any]:
        """See :class:`Store`."""
        config: dict[str, Any] = json.loads(
            self._files.cat_file(f"{self._root}/{name}/config.json")
        )
        return config

    def folder(self, name: str) -> Path:
        """See :class:`Store`."""
        return self._scratch / name

    def take_up(self, name: str, state: State | None) -> None:
        """See :class:`Store`; what this machine has is taken where it is as new."""
        folder = self.folder(name)
        here = RunFolder(folder).checkpoint
        if state is None or state.archive is None or state.archive == _archive(name, here):
            return
        with tempfile.TemporaryDirectory() as temporary:
            archive = Path(temporary) / state.archive
            self._files.get_file(f"{self._root}/{NOTES}/{state.archive}", str(archive))
            if _digest(archive) != state.sha256:
                raise RunError(
                    f"{self._root}/{NOTES}/{state.archive}: the checkpoint is damaged; remove "
                    f"{NOTES}/{name}.json to train {name} anew"
                )
            check_members(archive)
            with replacing_folder(folder) as new, zipfile.ZipFile(archive) as file:
                file.extractall(new)
        self._relocate(folder)

    def source(self, name: str) -> Path:
        """See :class:`Store`; a copy, made once a machine."""
        folder = self._scratch / "sources" / name
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{folder}.lock"):
            if not RunFolder(folder).finished:
                with replacing_folder(folder) as new:
                    self.fetch(name, new)
        return folder

    def keep(self, name: str, state: State) -> State:
        """See :class:`Store`."""
        archive = _archive(name, RunFolder(self.folder(name)).checkpoint)
        with tempfile.TemporaryDirectory() as temporary:
            made = shutil.make_archive(f"{temporary}/run", "zip", self.folder(name))
            self._files.makedirs(f"{self._root}/{NOTES}", exist_ok=True)
            self._files.put_file(made, f"{self._root}/{NOTES}/{archive}")
            kept = state.model_copy(update={"archive": archive, "sha256": _digest(Path(made))})
        self.note(name, kept)
        if state.archive is not None and state.archive != archive:
            self._files.rm_file(f"{self._root}/{NOTES}/{state.archive}")
        return kept

    def hand_in(self, name: str, state: State) -> None:
        """See :class:`Store`: every file, then the marker of a finished run, then the note."""
        target = f"{self._root}/{name}"
        if self._files.exists(target):
            self._files.rm(target, recursive=True)
        folder = self.folder(name)
        files = [path for path in sorted(folder.rglob("*")) if path.is_file() and _goes(path)]
        for path in sorted(files, key=lambda path: path.name == MARKER):
            place = f"{target}/{path.relative_to(folder).as_posix()}"
            self._files.makedirs(place.rpartition("/")[0], exist_ok=True)
            self._files.put_file(str(path), place)
        self.note(name, state.model_copy(update={"archive": None, "sha256": None}))
        if state.archive is not None:
            self._files.rm_file(f"{self._root}/{NOTES}/{state.archive}")
        shutil.rmtree(folder)

    def fetch(self, name: str, out: Path) -> None:
        """Copy a finished run into the folder ``out``."""
        self._files.get(f"{self._root}/{name}/", f"{out}/", recursive=True)

    def _relocate(self, folder: Path) -> None:
        """Name the place that the run's source has on this machine, where it has one."""
        config = read_json(folder / "config.json")
        if config["transferred_from"] is not None:
            config["transferred_from"] = str(self.source(Path(config["transferred_from"]).name))
            write_json(folder / "config.json", config)
            seal(folder, FIXED)


def open_store(place: str) -> FolderStore | RemoteStore:
    """The store at a path or a URL.

    Raises:
        ConfigError: a URL that fsspec does not know.
    """
    return RemoteStore(place) if "://" in place else FolderStore(Path(place))


def fetch_all(store: RemoteStore, names: Iterable[str], out: Path) -> None:
    """Copy finished runs into folders of their names in ``out``; those there are left alone."""
    for name in names:
        if not RunFolder(out / name).finished:
            with replacing_folder(out / name) as new:
                store.fetch(name, new)


def _state(text: bytes, place: str) -> State:
    try:
        return State.model_validate_json(text)
    except ValidationError as error:
        raise RunError(
            f"{place} is not a note of a grid ({error.errors()[0]['msg']}); remove it, and the "
            "cell is taken up anew"
        ) from None


def _archive(name: str, checkpoint: Path | None) -> str | None:
    """What the file of a checkpoint is called."""
    return None if checkpoint is None else f"{name}-{checkpoint.name}.zip"


def _goes(path: Path) -> bool:
    """Whether a file of a run folder goes into the store: not the lock."""
    return not path.name.startswith(".")


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
