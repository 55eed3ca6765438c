"""The folder of a training run; docs/baselines.md lists its files."""

import csv
import itertools
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from baselines.runs import files
from baselines.runs.files import RunError, read_json, replacing_folder, write_json
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, FieldSampler, load_fields, save_field

FILES = (
    *("config.json", "field.yaml", "command.txt", "versions.json", "resumed.json"),
    *("progress.csv", "evaluations.json", "evaluation.json"),
)
FOLDERS = ("policy", "checkpoints", "tensorboard")


class RunFolder:
    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(
        cls, path: Path, resolved: Mapping[str, Any], field: Field | FieldSampler, command: str
    ) -> Self:
        folder = cls(path)
        folder._clear_leftovers()
        write_json(path / "config.json", resolved)
        save_field(field, path / "field.yaml")
        files.write_provenance(path, command)
        return folder

    @classmethod
    def resume(
        cls, path: Path, resolved: Mapping[str, Any], field: Field | FieldSampler, command: str
    ) -> Self:
        """Resume the run in ``path``, if it was interrupted; a finished one is left as it is."""
        folder = cls.open(path)
        recorded, asked = folder.config, json.loads(json.dumps(resolved))
        problems = files.differences(recorded, {**dict.fromkeys(recorded), **asked})
        if (path / "field.yaml").exists() and folder.fields != field:
            problems.append("field: it has changed since the run was started")
        if problems:
            raise ConfigError(f"{path} cannot be resumed", problems)
        if folder.finished:
            return folder
        folder._clear_leftovers()
        entry = {"env_steps": folder.saved_steps, "command": command, "versions": files.versions()}
        history = path / "resumed.json"
        write_json(history, [*(read_json(history) if history.exists() else []), entry])
        if not (path / "versions.json").exists():  # it was killed too early to write these
            save_field(field, path / "field.yaml")
            files.write_provenance(path, command)
        return folder

    @classmethod
    def open(cls, path: Path) -> Self:
        if not (path / "config.json").is_file():
            raise RunError(f"{path} is not a run folder: it has no config.json")
        walks = (step for name in FOLDERS for step in os.walk(path / name))
        # A walk, unlike rglob, does not fail where a run replaces a checkpoint.
        inside = (Path(top) / one for top, *names in walks for one in itertools.chain(*names))
        for file in (*path.iterdir(), *inside):
            if file.is_symlink():  # to resume would write to the link's target
                raise RunError(f"{file} is a link; a run folder has its files in it")
        return cls(path)

    def _clear_leftovers(self) -> None:
        for name in (*FILES, "policy"):
            for leftover in self.path.glob(f".{name}.*"):
                shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()

    @property
    def config(self) -> dict[str, Any]:
        return dict(read_json(self.path / "config.json", dict))

    @property
    def fields(self) -> Field | FieldSampler:
        return load_fields(self.path / "field.yaml")

    @property
    def field(self) -> Field:
        if isinstance(fields := self.fields, FieldSampler):
            raise RunError(f"{self.path} was trained on random fields; allowed here: one field")
        return fields

    @property
    def command(self) -> str:
        return files.read_text(self.path / "command.txt").strip()

    @property
    def evaluations(self) -> list[dict[str, Any]]:
        return list(read_json(self.path / "evaluations.json", list))

    @property
    def evaluation(self) -> dict[str, Any]:
        return dict(read_json(self.path / "evaluation.json", dict))

    @property
    def finished(self) -> bool:
        return (self.path / "evaluation.json").is_file()

    @property
    def state(self) -> str:
        """The progress in words, such as ``1,000 of 5,000 env-steps``."""
        if self.finished:
            return "finished"
        if (self.path / "policy").exists():
            return "not evaluated"
        if not self.saved_steps:
            return "begun" if (self.path / "config.json").is_file() else "not begun"
        return f"{self.saved_steps:,} of {self.config['steps']:,} env-steps"

    @property
    def unfinished(self) -> str | None:
        """The progress of a run without a final policy, in words; ``None`` if it has one."""
        return None if (self.path / "policy").exists() else f"unfinished: {self.state}"

    @property
    def checkpoint(self) -> Path | None:
        return max(self._checkpoints(), key=lambda path: int(path.name), default=None)

    def _checkpoints(self) -> list[Path]:
        """Folders whose names are numbers; any other is not a checkpoint."""
        found = (self.path / "checkpoints").glob("[0-9]*")
        return [path for path in found if re.fullmatch("[0-9]{1,18}", path.name) and path.is_dir()]

    @property
    def saved_steps(self) -> int:
        return 0 if self.checkpoint is None else int(self.checkpoint.name)

    @contextmanager
    def new_checkpoint(self, env_steps: int) -> Iterator[Path]:
        """Yield a folder to fill; then it is the newest checkpoint, and the only one."""
        self._check_there()
        path = self.path / "checkpoints" / f"{env_steps:012d}"
        with replacing_folder(path) as folder:
            yield folder
        for other in (*self._checkpoints(), *path.parent.glob(".[0-9]*")):
            if other != path:
                shutil.rmtree(other)

    @contextmanager
    def new_policy(self) -> Iterator[Path]:
        self._check_there()
        with replacing_folder(self.path / "policy") as folder:
            yield folder

    def _check_there(self) -> None:
        if not (self.path / "config.json").is_file():
            raise RunError(f"{self.path} has lost its config.json, so the run ends here")

    def finish(self, evaluation: Mapping[str, Any]) -> None:
        write_json(self.path / "evaluation.json", evaluation)
        shutil.rmtree(self.path / "checkpoints", ignore_errors=True)

    @property
    def policy(self) -> Path:
        final, checkpoint = self.path / "policy", self.checkpoint
        return final if final.exists() or checkpoint is None else checkpoint / "policy"

    @property
    def progress(self) -> Path:
        return self.path / "progress.csv"

    @property
    def progress_bytes(self) -> int:
        return self.progress.stat().st_size if self.progress.exists() else 0

    def cut_progress(self, size: int) -> None:
        if not 0 <= size <= self.progress_bytes:
            raise RunError(f"{self.progress} is damaged: it ends before the checkpoint")
        if size == 0:
            self.progress.unlink(missing_ok=True)
        else:
            os.truncate(self.progress, size)

    def append_progress(self, row: Mapping[str, float]) -> None:
        self._check_there()
        with self.progress.open("a", newline="") as file:
            writer = csv.writer(file)
            if not self.progress_bytes:
                writer.writerow(row)
            writer.writerow([f"{value:.6g}" if value % 1 else int(value) for value in row.values()])


def saved_at(checkpoint: Path, env_steps: Any) -> int:
    if env_steps != int(checkpoint.name):
        raise ValueError(f"env_steps {env_steps!r}; allowed: {int(checkpoint.name)}, its name")
    return int(checkpoint.name)
