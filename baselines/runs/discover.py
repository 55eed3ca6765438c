"""Run folders found inside other folders."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from baselines.runs.files import RunError, moved_aside, read_json


def run_folders(
    paths: Sequence[Path],
    note: Callable[[str], None] = lambda text: None,
    *,
    comparisons: bool = False,
) -> list[Path]:
    """Return the run folders at or anywhere inside ``paths``, each one once.

    Inside, studies, what ``--force`` moved aside, and unless asked for ``comparisons`` are left
    out; ``note`` receives a line about each.

    Raises:
        RunError: a path holds no run.
    """
    found = [folder for path in paths for folder in _inside(path, note, comparisons)]
    return list({folder.resolve(): folder for folder in found}.values())


def _inside(path: Path, note: Callable[[str], None], comparisons: bool) -> list[Path]:
    """Return the folders of runs at or below ``path``, sorted, but for what is left out."""
    if not path.is_dir():
        raise RunError(f"{path} is not a folder")
    if "database" in _config(path):
        raise RunError(f"{path} is a study, and holds no run to report on; draw it with --study")
    folders: list[Path] = []
    left_out: dict[Path, str] = {}
    for folder in sorted(file.parent for file in path.rglob("field.yaml")):
        below = (place for place in (*reversed(folder.parents), folder) if path in place.parents)
        for place in below:
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


def _why_left_out(folder: Path, comparisons: bool) -> str | None:
    """Return why what is in ``folder`` is left out; ``None`` if it is not."""
    if moved_aside(folder):
        return "moved aside by --force"
    config, is_run = _config(folder), (folder / "field.yaml").is_file()
    if "database" in config:
        return "a study; draw it with --study"
    if not is_run and not comparisons and "variants" in config:
        return "a comparison; name it to report on its runs"
    return None


def _config(folder: Path) -> Collection[str]:
    """Return the entries of ``config.json``; none without the file."""
    path = folder / "config.json"
    config = read_json(path) if path.is_file() else None
    return config if isinstance(config, dict) else ()
