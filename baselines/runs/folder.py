"""The folder of a training run, which records everything about it.

Files of a run folder:
    config.json        the resolved configuration: what was asked, hyperparameters, environment
    field.yaml         the field
    command.txt        the exact command
    versions.json      Python, packages, machine, git revision
    resumed.json       if it was interrupted: from where it went on, with what command and versions
    progress.csv       one row per window of training, see baselines.training.run_logger
    tensorboard/       the same numbers and the library's own, as TensorBoard events
    evaluations.json   the fresh evaluations during training, in order
    checkpoints/       until the run is finished: the newest checkpoint, named by its env-steps
    policy/            the final policy
    evaluation.json    the final evaluation; its presence marks a finished run
    checksums.json     of what does not change any more; whoever reads a file checks it. There is
                       one in policy/ and in every checkpoint too, signed (see baselines.runs.trust)
    .lock              which process is at work here, if there is one
"""

from __future__ import annotations

import csv
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from baselines.runs.files import (
    RunError,
    read_json,
    read_text,
    replacing_folder,
    seal,
    write_json,
)
from baselines.runs.provenance import versions, write_provenance
from baselines.runs.trust import own_key
from mbn_marl.checksums import LIST, check, digest, listed
from mbn_marl.errors import ConfigError, DamageError
from mbn_marl.field import Field, load_field, save_field

FIXED = ("config.json", "field.yaml", "command.txt", "versions.json")
"""Files that a run folder has from the beginning, and that never change."""

RESULTS = ("progress.csv", "evaluations.json", "evaluation.json", "resumed.json")
"""Files that are final when the run is finished."""

PARTS = ("policy", "checkpoints", "tensorboard")
"""Folders inside a run folder."""


class RunFolder:
    """The folder of one run; see the module's docstring for its files.

    Args:
        path: the folder.
        trust: whether pickled files in it may be loaded whoever made them.
    """

    def __init__(self, path: Path, *, trust: bool = False) -> None:
        self.path = path
        self.trust = trust

    @classmethod
    def create(
        cls,
        path: Path,
        resolved: Mapping[str, Any],
        field: Field,
        command: str,
        *,
        trust: bool = False,
    ) -> Self:
        """Start a run in a folder that is claimed.

        Args:
            path: the folder.
            resolved: the resolved configuration (JSON values).
            field: the field to train on.
            command: the exact command of the run.
            trust: see the class.
        """
        folder = cls(path, trust=trust)
        folder._clear_leftovers()
        write_json(path / "config.json", resolved)
        save_field(field, path / "field.yaml")
        write_provenance(path, command)
        seal(path, FIXED)
        return folder

    @classmethod
    def resume(
        cls,
        path: Path,
        resolved: Mapping[str, Any],
        field: Field,
        command: str,
        *,
        trust: bool = False,
    ) -> Self:
        """Take up the folder of a run that was interrupted; a finished one is left as it is.

        Args:
            path: the folder.
            resolved: the resolved configuration; it must be the recorded one.
            field: the field to train on; it must be the recorded one.
            command: the exact command that goes on, recorded in the folder.
            trust: see the class.

        Raises:
            RunError: there is no run at ``path``.
            DamageError: a file is not what was written.
            ConfigError: naming every entry of the configuration that differs.
        """
        folder = cls.open(path, trust=trust)
        recorded, asked = folder.config, json.loads(json.dumps(resolved))
        problems = [
            f"{name}: the run has {recorded.get(name)!r}, this command {asked.get(name)!r}"
            for name in dict.fromkeys([*recorded, *asked])
            if recorded.get(name) != asked.get(name)
        ]
        if (path / "field.yaml").exists() and folder.field != field:
            problems.append("field: it has changed since the run was started")
        if problems:
            raise ConfigError(f"{path} cannot be resumed", problems)
        if not folder.finished:
            folder._take_up(field, command)
        elif (path / LIST).exists() and "evaluation.json" not in listed(path):
            folder._seal_results()  # it was killed between the two
        return folder

    def _take_up(self, field: Field, command: str) -> None:
        """Record that the run goes on."""
        self._clear_leftovers()
        entry = {
            "env_steps": 0 if self.checkpoint is None else int(self.checkpoint.name),
            "command": command,
            "versions": versions(),
        }
        history = self.path / "resumed.json"
        write_json(history, [*(read_json(history) if history.exists() else []), entry])
        if not (self.path / "versions.json").exists():  # it was killed while it began
            write_provenance(self.path, command)
        save_field(field, self.path / "field.yaml")
        seal(self.path, FIXED)

    def _clear_leftovers(self) -> None:
        """Clear what a killed process left half-written."""
        names = (*FIXED, *RESULTS, LIST, "policy")
        patterns = (*(f".{name}.*" for name in names), ".*.tmp")  # the last one is of save_field
        for leftover in (file for pattern in patterns for file in self.path.glob(pattern)):
            if leftover.is_dir():
                shutil.rmtree(leftover)
            else:
                leftover.unlink()

    @classmethod
    def open(cls, path: Path, *, trust: bool = False) -> Self:
        """Open the folder of an earlier run.

        Args:
            path: the folder.
            trust: see the class.

        Raises:
            RunError: there is no run at ``path``, or a link in it.
        """
        if not (path / "config.json").is_file():
            raise RunError(f"{path} is not a run folder: it has no config.json")
        inside = (file for part in PARTS for file in (path / part).rglob("*"))
        for file in (*path.iterdir(), *inside):
            if file.is_symlink():
                raise RunError(f"{file} is a link; a run folder has its files in it")
        return cls(path, trust=trust)

    @property
    def config(self) -> dict[str, Any]:
        """The resolved configuration."""
        config: dict[str, Any] = read_json(self.path / "config.json")
        return config

    @property
    def field(self) -> Field:
        """The field that the run was trained on, as it was then."""
        path = self.path / "field.yaml"
        if path.is_file():
            check(path)
        return load_field(path)

    @property
    def command(self) -> str:
        """The exact command that began it."""
        return read_text(self.path / "command.txt").strip()

    @property
    def evaluations(self) -> list[dict[str, Any]]:
        """The summaries of the fresh evaluations during training, in order."""
        evaluations: list[dict[str, Any]] = read_json(self.path / "evaluations.json")
        return evaluations

    @property
    def evaluation(self) -> dict[str, Any]:
        """The final evaluation of a finished run."""
        evaluation: dict[str, Any] = read_json(self.path / "evaluation.json")
        return evaluation

    @property
    def finished(self) -> bool:
        """Whether the run came to its end."""
        return (self.path / "evaluation.json").is_file()

    @property
    def checkpoint(self) -> Path | None:
        """The newest checkpoint, if there is one; its name is its number of env-steps."""
        found = (self.path / "checkpoints").glob("[0-9]*")
        return max(found, key=lambda path: int(path.name), default=None)

    @contextmanager
    def new_checkpoint(self, env_steps: int) -> Iterator[Path]:
        """A folder to fill; when the block ends well it is the newest checkpoint, and the only one.

        Whatever interrupts this leaves the one before in place.
        """
        path = self.path / "checkpoints" / f"{env_steps:012d}"
        with replacing_folder(path) as folder:
            yield folder
            for part in (folder, folder / "policy"):
                if part.exists():
                    seal(part, key=own_key())
        for other in path.parent.iterdir():
            if other != path:
                shutil.rmtree(other)

    @contextmanager
    def new_policy(self) -> Iterator[Path]:
        """A folder to fill; when the block ends well it is the final policy's."""
        with replacing_folder(self.path / "policy") as folder:
            yield folder
            seal(folder, key=own_key())

    def finish(self, evaluation: Mapping[str, Any]) -> None:
        """Write the final evaluation (JSON values), and drop what a finished run has no use for."""
        write_json(self.path / "evaluation.json", evaluation)
        self._seal_results()
        shutil.rmtree(self.path / "checkpoints", ignore_errors=True)

    def _seal_results(self) -> None:
        seal(self.path, (*FIXED, *RESULTS))

    @property
    def policy(self) -> Path:
        """The folder of the latest policy: the final one, or the newest checkpoint's."""
        final, checkpoint = self.path / "policy", self.checkpoint
        return final if final.exists() or checkpoint is None else checkpoint / "policy"

    @property
    def progress(self) -> Path:
        """The table of training's windows."""
        return self.path / "progress.csv"

    @property
    def progress_mark(self) -> dict[str, Any]:
        """How ``progress.csv`` is now, for :meth:`cut_progress` (JSON values)."""
        data = self.progress.read_bytes() if self.progress.exists() else b""
        return {"progress_bytes": len(data), "progress_sha256": digest(data)}

    def cut_progress(self, size: int, sha256: str | None) -> None:
        """Leave only the first ``size`` bytes of ``progress.csv``; of nothing, no file.

        Raises:
            DamageError: they do not have the checksum ``sha256``, if there is one.
        """
        if size == 0:
            self.progress.unlink(missing_ok=True)
            return
        data = self.progress.read_bytes()[:size] if self.progress.exists() else b""
        if digest(data) != (sha256 or digest(data)):
            raise DamageError(
                f"{self.progress} is damaged: its first {size} bytes are not the checkpoint's"
            )
        os.truncate(self.progress, size)

    def append_progress(self, row: Mapping[str, float]) -> None:
        """Append a row to ``progress.csv``; the first row fixes the columns.

        Raises:
            ValueError: the columns differ from the first row's.
        """
        path = self.progress
        new = not path.exists()
        if not new:
            with path.open(newline="") as file:
                columns = next(csv.reader(file))
            if columns != list(row):
                raise ValueError(f"progress columns {list(row)} differ from {columns}")
        with path.open("a", newline="") as file:
            writer = csv.writer(file)
            if new:
                writer.writerow(row)
            writer.writerow([f"{value:.6g}" if value % 1 else int(value) for value in row.values()])
