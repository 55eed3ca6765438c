"""``mbn runs``: the runs in some folders, and how far each is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from baselines.runs.folder import RunFolder


@dataclass(frozen=True)
class Runs:
    """List runs: finished, interrupted or under way, with success and makespan so far."""

    folders: Positional[Annotated[tuple[Path, ...], arg(metavar="[FOLDER ...]")]] = (Path("runs"),)
    """Run folders, or folders that hold some."""

    def run(self, command_line: str) -> None:
        """Print the table."""
        from baselines.compare.text_table import TextTable
        from baselines.runs.discover import run_folders
        from baselines.runs.folder import RunFolder

        found = run_folders(self.folders, comparisons=True)
        lines = tuple(line_of(RunFolder.open(path)) for path in found)
        headings = ("run", "algorithm", "field", "seed", "state", "success", "makespan")
        caption = "sampled actions in the final evaluation, or the last one so far"
        TextTable(caption, headings, lines, words=5).print("runs")


def line_of(run: RunFolder) -> tuple[str, ...]:
    """Return a run's line of the table; of one that cannot be read, why."""
    from baselines.compare.records import Listed, Summary, validate
    from mbn_marl.errors import MbnError

    here = Path.cwd()
    name = str(run.path.relative_to(here) if run.path.is_relative_to(here) else run.path)
    try:
        asked = validate(Listed, run.config, run.path / "config.json")
        if run.finished:
            last = run.evaluation.get("stochastic")
        else:
            history = run.evaluations if (run.path / "evaluations.json").exists() else []
            last = history[-1] if history else None
        known = None if last is None else validate(Summary, last, run.path)
    except MbnError as error:
        return name, "-", "-", "-", str(error).removeprefix(f"{run.path}/"), "-", "-"
    state = run.state
    success = "-" if known is None else f"{known.success_rate:.1%}"
    makespan = "-" if known is None or known.makespan is None else f"{known.makespan:.1f}"
    return name, asked.algorithm, Path(asked.field).stem, str(asked.seed), state, success, makespan
