"""Self-contained HTML pages, put together from the files in ``static``: no server, no network."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from mbn_marl.episode import Episode
from mbn_marl.episode.files import PackedArray, to_file
from mbn_marl.errors import MbnError
from mbn_marl.render import style
from mbn_marl.version import __version__

_STYLES = ("page.css", "replay.css")
_SCRIPTS = ("dom.js", "episode.js", "stage.js", "chart.js", "replay.js")


def replay_page(episodes: Sequence[Episode]) -> str:
    """Return a page that plays ``episodes``, at least one, on one clock."""
    if not episodes:
        raise MbnError("replay: at least one episode is needed")
    fields = ", ".join(dict.fromkeys(episode.field.name for episode in episodes))
    note = f"Recorded and replayed exactly by mbn_marl {__version__}."
    values = {"note": note, "episodes": episodes_data(episodes)}
    return whole(f"Replay: {fields}", _fill(_static("replay.html"), values))


def whole(title: str, body: str, *extra_styles: str) -> str:
    """Return a page with the player; ``body`` is HTML."""
    light, dark = ("".join(_variables(theme)) for theme in (0, 1))
    colours = (
        f":root {{\n{light}}}\n@media (prefers-color-scheme: dark) {{ :root {{\n{dark}}} }}\n"
        f"@media print {{ :root {{\n{light}}} }}\n"
    )
    return _fill(
        _static("page.html"),
        {
            "title": html.escape(title),
            "colours": str(len(style.ROBOTS)),
            "styles": colours + "\n".join(map(_static, (*_STYLES, *extra_styles))),
            "body": body,
            "scripts": "\n".join(map(_static, _SCRIPTS)),
        },
    )


def episodes_data(episodes: Sequence[Episode]) -> str:
    found = [*map(_data, episodes)]
    return json.dumps(found, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _data(episode: Episode) -> dict[str, Any]:
    data = to_file(episode).model_dump(mode="json", exclude={"actions"})
    if (known := episode.knowledge) is not None:
        heard = np.packbits(known.heard.reshape(len(known.heard), -1), axis=1)
        parts = {name: getattr(known, name).tolist() for name in ("empty", "done", "found")}
        data["knowledge"] = {**parts, "heard": PackedArray.pack(heard).model_dump()}
    return data


def _static(name: str) -> str:
    return (files("mbn_marl.render") / "static" / name).read_text(encoding="utf-8")


def _fill(template: str, values: Mapping[str, str]) -> str:
    return re.sub(r"{{(\w+)}}", lambda match: values[match[1]], template)


def _variables(theme: int) -> list[str]:
    named = {name: themes[theme] for name, themes in style.PAGE.items()}
    robots = [name for name in named if name.startswith("robot-")]
    named |= {f"ink-on-{name}": style.ink_on(named[name]) for name in robots}
    return [f"  --{name}: {colour};\n" for name, colour in named.items()]
