"""Run folders found inside other folders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from baselines.runs.files import RunError, moved_aside, read_json


def run_folders(
    paths: Sequence[Path],
    note: Callable[[str], None] = lambda text: None,
    *,
    comparisons: bool = False,
) -> list[Path]:
    """The run folders at ``paths``, which are some, or hold some anywhere inside; each one once.

    Studies and what ``--force`` moved aside are left out inside; a path itself is always read.

    Args:
        paths: where to look.
        note: is told what is left out.
        comparisons: read those inside too.

    Raises:
        RunError: a path holds no run.
    """
    found = [folder for path in paths for folder in _inside(path, note, comparisons)]
    return list({folder.resolve(): folder for folder in found}.values())


def _inside(path: Path, note: Callable[[str], None], comparisons: bool) -> list[Path]:
    """The folders of runs at or below ``path``, sorted, but for what is left out."""
    if not path.is_dir():
        raise RunError(f"{path} is not a folder")
    if is_study(path):
        raise RunError(f"{path} is a study, and holds no run to report on; draw it with --study")
    folders: list[Path] = []
    left_out: dict[Path, str] = {}
    for folder in sorted(file.parent for file in path.rglob("field.yaml")):
        for place in _from_to(path, folder):
            if why := _why_left_out(place, comparisons):
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


def _why_left_out(folder: Path, comparisons: bool) -> str | None:
    """Why what is in ``folder`` is not reported on; ``None`` if it is."""
    if moved_aside(folder):
        return "moved aside by --force"
    if is_study(folder):
        return "a study; draw it with --study"
    config = folder / "config.json"
    is_run = (folder / "field.yaml").is_file()
    is_comparison = not is_run and config.is_file() and "variants" in read_json(config)
    if is_comparison and not comparisons:
        return "a comparison; name it to report on its runs"
    return None


def is_study(folder: Path) -> bool:
    """Return whether ``folder`` is that of a study."""
    path = folder / "config.json"
    config = read_json(path) if path.is_file() else None
    return isinstance(config, dict) and "database" in config
