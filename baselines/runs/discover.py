"""Find run folders inside other folders."""

from collections.abc import Callable, Sequence
from pathlib import Path

from baselines.runs.files import RunError, read_text


def run_folders(
    paths: Sequence[Path],
    note: Callable[[str], None] = lambda text: None,
    *,
    comparisons: bool = False,
) -> list[Path]:
    """Return the run folders at or inside ``paths``; ``note`` receives those that are left out."""
    found: dict[Path, Path] = {}
    left_out: dict[Path, str] = {}
    for path in paths:
        if not path.is_dir():
            raise RunError(f"{path} is not a folder")
        if _is_study(path):
            raise RunError(
                f"{path} is a study, and holds no run to report on; draw it with --study"
            )
        runs = sorted(file.parent for file in path.rglob("field.yaml"))
        for run in runs:
            inside = [place for place in (*reversed(run.parents), run) if path in place.parents]
            reasons = {place: why for place in inside if (why := _why_left_out(place, comparisons))}
            if reasons:
                place = next(iter(reasons))
                left_out[place] = reasons[place]
            else:
                found[run.resolve()] = run
        if not found.keys() & {run.resolve() for run in runs}:
            raise RunError(f"{path} is not a run folder, and holds none")
    for place, why in left_out.items():
        note(f"left out: {place}, {why}")
    return list(found.values())


def _why_left_out(folder: Path, comparisons: bool) -> str | None:
    if folder.suffix[1:].isdecimal() and folder.with_suffix("").exists():
        return "moved aside by --force"
    if _is_study(folder):
        return "a study; draw it with --study"
    if comparisons or (folder / "field.yaml").is_file():
        return None
    config = folder / "config.json"
    is_comparison = config.is_file() and '"variants"' in read_text(config)
    return "a comparison; name it to report on its runs" if is_comparison else None


def _is_study(folder: Path) -> bool:
    return (folder / "study.log").is_file()
