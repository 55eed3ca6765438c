"""A table of words, and how Markdown and LaTeX write it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

MISSING = "missing"
"""Stands for what no run has given."""
NOT_IN_PAPER = "–"  # noqa: RUF001  (a dash, not a minus)
"""Stands for a number that the paper does not have."""

_LATEX = str.maketrans({"_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", NOT_IN_PAPER: "--"})


@dataclass(frozen=True)
class Grid:
    """A table of words.

    Attributes:
        caption: sentences that stand with it.
        headings: of the columns.
        lines: each as long as the headings; an empty first word belongs to the word above it.
        words: how many columns, from the left, hold words; the others hold numbers.
    """

    caption: str
    headings: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]
    words: int = 1

    def markdown(self) -> str:
        """As a table of GitHub's Markdown, below its caption."""
        rule = ["---"] * self.words + ["--:"] * (len(self.headings) - self.words)
        rows = [" | ".join(row) for row in (self.headings, rule, *self.lines)]
        return "\n".join([self.caption, "", *(f"| {row} |" for row in rows)])

    def latex(self, label: str) -> str:
        r"""As a ``table`` that needs the package ``booktabs``; ``\ref`` calls it ``label``."""
        columns = "l" * self.words + "r" * (len(self.headings) - self.words)
        rows = [_latex_row(self.lines[0])]
        for above, line in itertools.pairwise(self.lines):
            if line[0] and not above[0]:
                rows.append(r"\addlinespace")
            rows.append(_latex_row(line))
        return "\n".join(
            [
                r"\begin{table}",
                r"\centering",
                rf"\caption{{{_latex(self.caption)}}}",
                rf"\label{{{label}}}",
                rf"\begin{{tabular}}{{{columns}}}",
                r"\toprule",
                _latex_row(self.headings),
                r"\midrule",
                *rows,
                r"\bottomrule",
                r"\end{tabular}",
                r"\end{table}",
                "",
            ]
        )


def _latex_row(words: tuple[str, ...]) -> str:
    return " & ".join(map(_latex, words)) + r" \\"


def _latex(text: str) -> str:
    """``text`` with LaTeX's special characters escaped, and numbers with a real minus."""
    if text.startswith("-"):
        return f"$-${text[1:].translate(_LATEX)}"
    return text.translate(_LATEX)
