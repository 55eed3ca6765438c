"""HTML pages of tables, figures and replays that need no other file."""

import base64
import io
from collections.abc import Mapping, Sequence
from html import escape

import matplotlib
from matplotlib.figure import Figure

from baselines.compare.text_table import TextTable
from mbn_marl.episode import Episode
from mbn_marl.render import style, web
from mbn_marl.render.figures import trajectory_panels


def report_page(title: str, summary: str, sections: Mapping[str, Sequence[str]]) -> str:
    """Return a page with a link to each section; the parts of a section are HTML."""
    links, bodies = [], []
    for number, (name, parts) in enumerate(sections.items()):
        links.append(f'<a href="#section-{number}">{escape(name)}</a>')
        content = "\n".join([f"<h2>{escape(name)}</h2>", *parts])
        bodies.append(f'<section id="section-{number}">\n{content}\n</section>')
    body = '<p class="faint">{}</p>\n<nav>{}</nav>\n<main>\n{}\n</main>'
    body = body.format(escape(summary), "\n".join(links), "\n".join(bodies))
    return web.whole(title, body, "report.css")


def tables_html(tables: Mapping[str, TextTable]) -> list[str]:
    return [table.html(title) for title, table in tables.items() if table.lines]


def figures_html(figures: Mapping[str, Figure]) -> str:
    return f'<div class="figures">{"".join(map(_figure, figures, figures.values()))}</div>'


@matplotlib.rc_context(style.MATPLOTLIB)
def _figure(title: str, figure: Figure) -> str:
    # An image, not parts of the page: names inside two pictures may be the same.
    stream = io.BytesIO()
    figure.savefig(stream, format="svg", metadata={"Date": None})
    data, name = base64.b64encode(stream.getvalue()).decode("ascii"), escape(title)
    picture = f'<div><img alt="{name}" src="data:image/svg+xml;base64,{data}"></div>'
    return f"<figure>{picture}<figcaption>{name}</figcaption></figure>"


def episodes_html(place: str, episodes: Sequence[Episode]) -> list[str]:
    """Return the paths of episodes as a figure, and their replay side by side."""
    lasts = {one.source: one.snapshot(one.steps) for one in episodes}
    name, data = escape(f"episodes-{place}"), web.episodes_data(episodes)
    return [
        figures_html({f"Paths in {place}": trajectory_panels(lasts, columns=2)}),
        f'<div data-replay="{name}"></div>',
        f'<script type="application/json" id="{name}">{data}</script>',
    ]


def folded_html(texts: Mapping[str, str]) -> list[str]:
    row = "<details><summary>{}</summary><pre>{}</pre></details>"
    return [row.format(escape(name), escape(text)) for name, text in texts.items()]
