"""The runs that a report is made from, found in folders and read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from baselines.paper.windows import Windows
from baselines.runs.discover import run_folders
from baselines.runs.files import RunError, read_json
from baselines.runs.folder import RunFolder
from mbn_marl.field import Field, catalogue_names

NEEDED = ("algorithm", "setting", "field", "seed")
"""What a run's ``config.json`` has to say."""


class Cell(NamedTuple):
    """A cell of the experiment; its runs differ in their seeds."""

    algorithm: str
    setting: str
    field: str


@dataclass(frozen=True)
class Training:
    """One run.

    Attributes:
        path: its folder.
        cell: what it is a run of; a field from a file is called by the file's name.
        seed: its seed.
        windows: what it recorded about its training episodes.
        evaluation: the final evaluation; ``None`` while the run is not finished.
        field: the field.
        command: the exact command.
    """

    path: Path
    cell: Cell
    seed: int
    windows: Windows
    evaluation: dict[str, Any] | None
    field: Field
    command: str

    @classmethod
    def read(cls, path: Path) -> Training:
        """Read a run folder.

        Raises:
            RunError: a file is missing or is not as it should be; the message names it.
        """
        run = RunFolder.open(path)
        config = run.config
        missing = [name for name in NEEDED if name not in config]
        if missing:
            raise RunError(f"{path / 'config.json'} has no {', '.join(missing)}")
        final = path / "evaluation.json"
        return cls(
            path=path,
            cell=Cell(config["algorithm"], config["setting"], _field_name(config["field"])),
            seed=config["seed"],
            windows=Windows.read(path / "progress.csv"),
            evaluation=read_json(final) if final.exists() else None,
            field=run.field,
            command=run.command,
        )

    @property
    def env_steps(self) -> int:
        """Env-steps that the run has recorded."""
        return int(self.windows.env_steps[-1]) if self.windows.env_steps.size else 0


def find_trainings(
    paths: Sequence[Path], note: Callable[[str], None] = lambda text: None
) -> list[Training]:
    """Read the runs at ``paths``: run folders, or folders with run folders anywhere inside.

    Studies, comparisons and what ``--force`` moved aside are left out inside; a comparison or a
    folder moved aside that is a path itself is read.

    Args:
        paths: where to look.
        note: is told what is left out.

    Raises:
        RunError: a path holds no run, a run cannot be read, or two are of one cell and seed.
    """
    trainings = [Training.read(folder) for folder in run_folders(paths, note)]
    seen: dict[tuple[Cell, int], Path] = {}
    for training in trainings:
        other = seen.setdefault((training.cell, training.seed), training.path)
        if other != training.path:
            raise RunError(
                f"{other} and {training.path} are of the same algorithm, setting, field and "
                "seed; give one of them"
            )
    return trainings


def windows_of(trainings: Iterable[Training]) -> list[Windows]:
    """What they recorded."""
    return [training.windows for training in trainings]


def _field_name(field: str) -> str:
    """A catalogue name as it is; for a file its name, marked if the catalogue has it too."""
    if field in catalogue_names():
        return field
    name = Path(field).stem
    return f"{name} (file)" if name in catalogue_names() else name
