"""The runs that a report is made from, found in folders and read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from baselines.paper.windows import Windows
from baselines.runs import RunFolder
from baselines.storage import RunError, moved_aside, read_json
from baselines.tuning.study import JOURNAL
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
            command=(path / "command.txt").read_text().strip(),
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
    found = [folder for path in paths for folder in _run_folders(path, note)]
    folders = {folder.resolve(): folder for folder in found}
    trainings = [Training.read(folder) for folder in folders.values()]
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


def _run_folders(path: Path, note: Callable[[str], None]) -> list[Path]:
    """The folders of runs at or below ``path``, sorted, but for what is left out."""
    if not path.is_dir():
        raise RunError(f"{path} is not a folder")
    if (path / JOURNAL).is_file():
        raise RunError(f"{path} is a study, and holds no run to report on; draw it with --study")
    folders: list[Path] = []
    left_out: dict[Path, str] = {}
    for folder in sorted(file.parent for file in path.rglob("field.yaml")):
        for place in _from_to(path, folder):
            if why := _why_left_out(place):
                left_out[place] = why
                break
        else:
            folders.append(folder)
    for place, why in left_out.items():
        note(f"left out: {place}, {why}")
    if not folders:
        raise RunError(f"{path} is not a run folder, and holds none")
    return folders


def _from_to(path: Path, folder: Path) -> list[Path]:
    """The folders below ``path`` on the way to ``folder`` inside it, and that one."""
    return [place for place in (*reversed(folder.parents), folder) if path in place.parents]


def _why_left_out(folder: Path) -> str | None:
    """Why what is in ``folder`` is not reported on; ``None`` if it is."""
    if moved_aside(folder):
        return "moved aside by --force"
    if (folder / JOURNAL).is_file():
        return "a study; draw it with --study"
    config = folder / "config.json"
    is_run = (folder / "field.yaml").is_file()
    if not is_run and config.is_file() and "algorithms" in read_json(config):
        return "a comparison; name it to report on its runs"
    return None


def _field_name(field: str) -> str:
    """A catalogue name as it is; for a file its name, marked if the catalogue has it too."""
    if field in catalogue_names():
        return field
    name = Path(field).stem
    return f"{name} (file)" if name in catalogue_names() else name
