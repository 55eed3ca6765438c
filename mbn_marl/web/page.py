"""Put a page together from its template, styles, scripts and data."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files

from mbn_marl.episode import Episode
from mbn_marl.episode.files import to_file
from mbn_marl.render import style

_STYLES = ("page.css", "replay.css")
_SCRIPTS = ("dom.js", "episode.js", "stage.js", "chart.js", "replay.js")


def whole(
    body: str, title: str, values: Mapping[str, str], extra_styles: Sequence[str] = ()
) -> str:
    """Return a self-contained page, with the player, that may load nothing from elsewhere.

    Args:
        body: the name of the body's template.
        title: as plain text.
        values: of the template's names, as HTML.
        extra_styles: names of style sheets besides the player's.
    """
    return _fill(
        _static("page.html"),
        {
            "title": html.escape(title),
            "colours": str(len(style.ROBOTS)),
            "styles": _styles((*_STYLES, *extra_styles)),
            "body": _fill(_static(body), values),
            "scripts": "\n".join(map(_static, _SCRIPTS)),
        },
    )


def episodes_data(episodes: Sequence[Episode]) -> str:
    """Return what the player needs of the episodes, as JSON for a script element."""
    found = [to_file(one).model_dump(mode="json", exclude={"actions"}) for one in episodes]
    return json.dumps(found, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _static(name: str) -> str:
    """Return the text of a file of the package."""
    return (files("mbn_marl.web") / "static" / name).read_text(encoding="utf-8")


def _fill(template: str, values: Mapping[str, str]) -> str:
    """Return ``template`` with every ``{{name}}`` replaced, once."""
    return re.sub(r"{{(\w+)}}", lambda match: values[match[1]], template)


def _styles(names: Iterable[str]) -> str:
    """Return the colours as CSS variables, light and dark, and the style sheets."""
    light, dark = map(_variables, (0, 1))
    colours = (
        f":root {{\n{light}}}\n@media (prefers-color-scheme: dark) {{ :root {{\n{dark}}} }}\n"
        f"@media print {{ :root {{\n{light}}} }}\n"
    )
    return colours + "\n".join(map(_static, names))


def _variables(theme: int) -> str:
    named = {name: themes[theme] for name, themes in style.PAGE.items()}
    robots = [name for name in named if name.startswith("robot-")]
    named |= {f"ink-on-{name}": style.ink_on(named[name]) for name in robots}
    return "".join(f"  --{name}: {colour};\n" for name, colour in named.items())
