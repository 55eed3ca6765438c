"""A report as one self-contained page: sections of tables, figures and players."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

from mbn_marl.episode import Episode
from mbn_marl.render import web


@dataclass(frozen=True)
class Table:
    """A table whose lines are as long as its headings; cells may have line breaks.

    The first ``words`` columns hold words, the others numbers.
    """

    title: str
    caption: str
    headings: Sequence[str]
    lines: Sequence[Sequence[str]]
    words: int = 1


@dataclass(frozen=True)
class Section:
    """A part of a report.

    It has tables, SVG pictures by what they show, episodes to play side by side, and long texts by
    title, folded away.
    """

    title: str
    tables: Sequence[Table] = ()
    figures: Mapping[str, bytes] = field(default_factory=dict)
    episodes: Sequence[Episode] = ()
    texts: Mapping[str, str] = field(default_factory=dict)


def report_page(title: str, summary: str, sections: Sequence[Section]) -> str:
    """Return a self-contained HTML page of ``sections``, with links to each and to its player.

    The ``summary`` is a sentence below the title.
    """
    links = []
    for number, section in enumerate(sections):
        replay = f' (<a href="#replay-{number}">replay</a>)' if section.episodes else ""
        link = f'<a href="#section-{number}">{escape(section.title)}</a>'
        links.append(f"<span>{link}{replay}</span>")
    values = {
        "summary": escape(summary),
        "contents": "\n".join(links),
        "sections": "\n".join(_section(*numbered) for numbered in enumerate(sections)),
    }
    return web.whole("report.html", title, values, extra_styles=("report.css",))


def _section(number: int, section: Section) -> str:
    parts = [f"<h2>{escape(section.title)}</h2>", *map(_table, section.tables)]
    if section.figures:
        pictures = "".join(_figure(*named) for named in section.figures.items())
        parts.append(f'<div class="figures">{pictures}</div>')
    if section.episodes:
        data = web.episodes_data(section.episodes)
        parts += [
            f'<div id="replay-{number}" data-replay="episodes-{number}"></div>',
            f'<script type="application/json" id="episodes-{number}">{data}</script>',
        ]
    parts += [
        f"<details><summary>{escape(name)}</summary><pre>{escape(text)}</pre></details>"
        for name, text in section.texts.items()
    ]
    body = "\n".join(parts)
    return f'<section id="section-{number}">\n{body}\n</section>'


def _table(table: Table) -> str:
    def row(tag: str, cells: Sequence[str]) -> str:
        kinds = [' class="word"'] * table.words + [""] * (len(cells) - table.words)
        made = map(f"<{tag}{{}}>{{}}</{tag}>".format, kinds, map(escape, cells))
        return f"<tr>{''.join(made)}</tr>"

    head = row("th", table.headings)
    body = "".join(row("td", line) for line in table.lines)
    shown = f"<table><thead>{head}</thead><tbody>{body}</tbody></table>"
    return (
        f'<h3>{escape(table.title)}</h3><div class="table">{shown}</div>'
        f'<p class="caption">{escape(table.caption)}</p>'
    )


def _figure(title: str, svg: bytes) -> str:
    """Embed an image, not parts of the page: names inside two pictures may be the same."""
    data = base64.b64encode(svg).decode("ascii")
    name = escape(title)
    picture = f'<div><img alt="{name}" src="data:image/svg+xml;base64,{data}"></div>'
    return f"<figure>{picture}<figcaption>{name}</figcaption></figure>"
