"""A table of words, as Markdown, LaTeX, HTML and a terminal show it."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table

from baselines.console import console

if TYPE_CHECKING:
    from pandas import DataFrame

DASH = "–"  # noqa: RUF001  (a dash, not a minus)

_MARKDOWN = str.maketrans({"|": r"\|", "<": "&lt;", "\n": "<br>", "\r": " "})
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def shown(value: Any, form: str = "{:,.0f}") -> str:
    return "-" if value is None else form.format(value)


@dataclass(frozen=True)
class TextTable:
    """A heading may have several lines; an empty first word belongs to the word above it.

    The first ``words`` columns hold words, the others numbers.
    """

    caption: str
    headings: Sequence[str]
    lines: Sequence[Sequence[str]]
    words: int = 1

    def markdown(self, title: str = "") -> str:
        """Return GitHub's Markdown below its caption, under ``title`` if there is one."""
        rule = ["---"] * self.words + ["--:"] * (len(self.headings) - self.words)
        headings = [word.replace("-\n", "").replace("\n", " ") for word in self.headings]
        rows = [
            [cell.translate(_MARKDOWN) for cell in row] for row in (headings, rule, *self.lines)
        ]
        heading = [f"## {title}", ""] if title else []
        return "\n".join([*heading, self.caption, "", *(f"| {' | '.join(row)} |" for row in rows)])

    def latex(self, label: str) -> str:
        r"""Return a ``table`` that needs the package ``booktabs``; ``\ref`` calls it ``label``."""
        from pandas import DataFrame

        columns = "l" * self.words + "r" * (len(self.headings) - self.words)
        how = {"column_format": columns, "caption": self.caption, "label": label}
        table = DataFrame(self.lines, columns=list(self.headings))
        text: str = table.to_latex(index=False, escape=True, **how)
        return text.replace("& -", "& $-$")  # a real minus

    def html(self, title: str) -> str:
        """Return HTML with the title above and the caption below; its style is report.css."""

        def row(tag: str, cells: Sequence[str]) -> str:
            kinds = [' class="word"'] * self.words + [""] * (len(cells) - self.words)
            made = map(f"<{tag}{{}}>{{}}</{tag}>".format, kinds, map(escape, cells))
            return f"<tr>{''.join(made)}</tr>"

        body = row("th", self.headings) + "".join(row("td", line) for line in self.lines)
        return (
            f'<h3>{escape(title)}</h3><div class="table"><table>{body}</table></div>'
            f'<p class="caption">{escape(self.caption)}</p>'
        )

    def print(self, title: str = "", screen: Console | None = None) -> None:
        """Print it, by default on the standard output, with its caption below."""
        screen = screen or console()
        look: dict[str, Any] = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0), "pad_edge": False}
        if title:
            screen.print(title, style="table.title", highlight=False, soft_wrap=True)
        for block in self._blocks(screen.width):
            table = Table(**look)
            for k in block:
                side: Any = "left" if k < self.words else "right"
                table.add_column(self.headings[k], justify=side, overflow="fold")
            for line in self.lines:
                table.add_row(*(line[k] for k in block))
            screen.print(table)
        if self.caption:
            screen.print(self.caption)

    def _blocks(self, width: int) -> list[list[int]]:
        # Columns that fit side by side, each block after the columns that name the row: a cell is
        # broken only if it is too wide alone.
        columns = zip(self.headings, *self.lines, strict=True)
        wide = [2 + max(len(part) for cell in one for part in cell.split("\n")) for one in columns]
        lead = [*range(min(self.words, len(wide) - 1))]
        blocks = [[*lead]]
        for k in range(len(lead), len(wide)):
            if blocks[-1] != lead and sum(wide[j] for j in (*blocks[-1], k)) > width:
                blocks.append([*lead])
            blocks[-1].append(k)
        return blocks


def csv_text(table: "DataFrame", form: str | None = None) -> str:
    """Return CSV with numbers in ``form``; a word that a spreadsheet would run gets a quote."""

    def safe(cell: object) -> object:
        return f"'{cell}" if isinstance(cell, str) and cell.startswith(_FORMULA) else cell

    return str(table.map(safe).to_csv(index=False, float_format=form, lineterminator="\n"))
