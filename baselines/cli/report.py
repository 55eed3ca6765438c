"""``mbn report``: what runs recorded, as a page with tables and figures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from baselines.cli.options import check_options


@dataclass(frozen=True)
class Report:
    """Report on runs: the paper's tables and figures with ours beside them, or a comparison."""

    runs: Positional[Annotated[tuple[Path, ...], arg(metavar="RUN ...")]]
    """Run folders, or folders that hold some; studies and what --force moved aside are left out
    there, with --paper comparisons too. With --paper also folders of earlier reports."""
    out: Path
    """The folder to write, with the page paper.md or comparison.md in it; NAME.md for the page,
    beside its folder NAME; or NAME.html for a comparison on one self-contained page."""
    paper: bool = False
    """The paper's experiments: its tables as Markdown, CSV and LaTeX, and its figures."""
    comparison: bool = False
    """The statistics of `mbn compare`, on runs that are there already."""
    study: Path | None = None
    """The folder of an `mbn tune`, to draw."""
    notes: Path | None = None
    """A Markdown file to put at the top of the page."""
    force: bool = False
    """If there is a report already, move it aside (to OUT.1, OUT.2, ...)."""

    def run(self, command_line: str) -> None:
        """Write the report."""
        from functools import partial

        from baselines.compare.report import is_page, report_comparison
        from baselines.compare.tables import print_comparison
        from baselines.console import console

        page = is_page(self.out)
        wrong = {
            f"out: --paper writes a folder or .md, not {self.out}": page and self.paper,
            "kind: --paper or --comparison is needed, or an out that ends in .html": not page
            and self.paper == self.comparison,
            "study and notes: allowed with --paper": not self.paper and (self.study or self.notes),
            "RUN: at least one folder is needed": not self.runs,
        }
        check_options("report", wrong)
        screen = console()
        note = partial(screen.print, soft_wrap=True, highlight=False)
        how: dict[str, Any] = {"command": command_line, "force": self.force, "note": note}
        if self.paper:
            from baselines.paper.report import write_report

            write_report(self.runs, self.out, study=self.study, notes=self.notes, **how)
        else:
            found = report_comparison(self.runs, self.out, **how)
            print_comparison(found, screen)
        note(f"written to {self.out}")
