"""A table of words, as Markdown, LaTeX and a terminal show it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich import box
from rich.table import Table

from baselines.console import console

if TYPE_CHECKING:
    from pandas import DataFrame

DASH = "–"  # noqa: RUF001  (a dash, not a minus)

_LATEX = str.maketrans(
    {
        **{sign: f"\\{sign}" for sign in "_%&#${}"},
        **{"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}"},
        **{"<": r"\textless{}", ">": r"\textgreater{}", "\n": " ", DASH: "--"},
    }
)
_MARKDOWN = str.maketrans({"|": r"\|", "<": "&lt;", "\n": " ", "\r": " "})
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


@dataclass(frozen=True)
class TextTable:
    """A table of words.

    Attributes:
        caption: sentences about it.
        headings: of the columns; one may have several lines.
        lines: each as long as the headings; an empty first word belongs to the word above it.
        words: how many columns, from the left, hold words; the others hold numbers.
    """

    caption: str
    headings: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]
    words: int = 1

    def markdown(self, title: str = "") -> str:
        """As a table of GitHub's Markdown below its caption, under ``title`` if there is one."""
        rule = ["---"] * self.words + ["--:"] * (len(self.headings) - self.words)
        headings = [word.replace("-\n", "").replace("\n", " ") for word in self.headings]
        rows = [" | ".join(map(_markdown, row)) for row in (headings, rule, *self.lines)]
        heading = [f"## {title}", ""] if title else []
        return "\n".join([*heading, self.caption, "", *(f"| {row} |" for row in rows)])

    def latex(self, label: str) -> str:
        r"""As a ``table`` that needs the package ``booktabs``; ``\ref`` calls it ``label``."""
        columns = "l" * self.words + "r" * (len(self.headings) - self.words)
        rows = [_latex_row(self.lines[0])]
        for above, line in itertools.pairwise(self.lines):
            if line[0] and not above[0]:
                rows.append(r"\addlinespace")
            rows.append(_latex_row(line))
        parts = [
            *(r"\begin{table}", r"\centering"),
            *(rf"\caption{{{_latex(self.caption)}}}", rf"\label{{{label}}}"),
            *(rf"\begin{{tabular}}{{{columns}}}", r"\toprule"),
            *(_latex_row(self.headings), r"\midrule"),
            *rows,
            *(r"\bottomrule", r"\end{tabular}", r"\end{table}", ""),
        ]
        return "\n".join(parts)

    def rich(self, title: str) -> Table:
        """For a terminal, see :func:`baselines.console.console`; without the caption."""
        table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
        for index, heading in enumerate(self.headings):
            table.add_column(heading, justify="left" if index < self.words else "right")
        for line in self.lines:
            table.add_row(*line)
        return table

    def print(self, title: str) -> None:
        """Print it on the standard output, with its caption below."""
        screen = console()
        screen.print(self.rich(title))
        if self.caption:
            screen.print(self.caption, markup=False)


def csv_text(table: DataFrame, form: str | None = None) -> str:
    """A table as CSV, numbers in ``form``; a word that a spreadsheet would run gets a quote."""

    def safe(cell: object) -> object:
        return f"'{cell}" if isinstance(cell, str) and cell.startswith(_FORMULA) else cell

    return str(table.map(safe).to_csv(index=False, float_format=form, lineterminator="\n"))


def _markdown(cell: str) -> str:
    """A cell with the signs escaped that would end it or begin HTML."""
    return cell.translate(_MARKDOWN)


def _latex_row(words: tuple[str, ...]) -> str:
    return " & ".join(map(_latex, words)) + r" \\"


def _latex(text: str) -> str:
    """``text`` with LaTeX's special characters escaped, and numbers with a real minus."""
    if text.startswith("-"):
        return f"$-${text[1:].translate(_LATEX)}"
    return text.translate(_LATEX)
