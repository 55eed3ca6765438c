"""Putting a page together from its template, styles, scripts and data."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from typing import Any

from mbn_marl.episode import Episode
from mbn_marl.episode.files import to_file
from mbn_marl.render import style

STYLES = ("page.css", "replay.css")
SCRIPTS = ("dom.js", "episode.js", "stage.js", "chart.js", "replay.js")


def static(name: str) -> str:
    """Return the text of a file of the package."""
    return (files("mbn_marl.web") / "static" / name).read_text(encoding="utf-8")


def fill(template: str, values: Mapping[str, str]) -> str:
    """Return ``template`` with every ``{{name}}`` replaced, once."""
    return re.sub(r"{{(\w+)}}", lambda match: values[match[1]], template)


def whole(
    body: str, title: str, values: Mapping[str, str], extra_styles: Sequence[str] = ()
) -> str:
    """Return a self-contained page, with the player, that may load nothing from elsewhere.

    Args:
        body: the name of the body's template.
        title: as plain text.
        values: of the body's names, as HTML.
        extra_styles: names of style sheets besides the player's.
    """
    return fill(
        static("page.html"),
        {
            "title": text(title),
            "colours": str(len(style.LIGHT_PAGE.robots)),
            "styles": _styles((*STYLES, *extra_styles)),
            "body": fill(static(body), values),
            "scripts": "\n".join(map(static, SCRIPTS)),
        },
    )


def text(plain: str) -> str:
    """Return ``plain`` escaped for HTML."""
    return html.escape(plain)


def episodes_data(episodes: Sequence[Episode]) -> str:
    """Return what the player needs of the episodes, as JSON for a script element."""
    return script_data(
        [to_file(one).model_dump(mode="json", exclude={"actions"}) for one in episodes]
    )


def script_data(value: Any) -> str:
    """Return ``value`` as JSON for a script element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _styles(names: Iterable[str]) -> str:
    """Return the colours as CSS variables, light and dark, and the style sheets."""
    light, dark = (_variables(palette) for palette in (style.LIGHT_PAGE, style.DARK_PAGE))
    colours = (
        f":root {{\n{light}}}\n@media (prefers-color-scheme: dark) {{ :root {{\n{dark}}} }}\n"
        f"@media print {{ :root {{\n{light}}} }}\n"
    )
    return colours + "\n".join(map(static, names))


def _variables(palette: style.PagePalette) -> str:
    named = {name.replace("_", "-"): colour for name, colour in palette._asdict().items()}
    for index, colour in enumerate(named.pop("robots")):
        named[f"robot-{index}"] = colour
        named[f"ink-on-robot-{index}"] = style.ink_on(colour)
    return "".join(f"  --{name}: {colour};\n" for name, colour in named.items())
