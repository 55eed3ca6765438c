"""Values that differ from the recorded ones, as ``NAME=VALUE`` on the command line."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic_core import to_jsonable_python

from mbn_marl.errors import ConfigError

ENVIRONMENT = "environment"
"""Names that begin with this and a point are settings of the environment."""


def parse(words: Sequence[str]) -> dict[str, Any]:
    """Read ``NAME=VALUE`` words into nested mappings.

    ``["model.gamma=0.9", "sharing=full"]`` is ``{"model": {"gamma": 0.9}, "sharing": "full"}``: a
    value is JSON, or else the word as it is.

    Raises:
        ConfigError: naming every word of another form, and every name that is set twice.
    """
    values: dict[str, Any] = {}
    problems = []
    for word in words:
        name, equals, text = word.partition("=")
        *path, last = name.split(".")
        if not equals or not all([*path, last]):
            problems.append(f"{word}: must be NAME=VALUE, for example model.gamma=0.9")
            continue
        place: Any = values
        for part in path:
            place = place.setdefault(part, {}) if isinstance(place, dict) else None
        if not isinstance(place, dict) or last in place:
            problems.append(f"{word}: {name} is set twice")
            continue
        place[last] = _value(text)
    if not isinstance(values.get(ENVIRONMENT, {}), dict):
        problems.append(f"{ENVIRONMENT}: must be {ENVIRONMENT}.NAME=VALUE")
    if problems:
        raise ConfigError("set", problems)
    return values


def words_of(values: Mapping[str, Any]) -> list[str]:
    """Return the words that :func:`parse` reads ``values`` from."""
    words = []
    for name, value in to_jsonable_python(dict(values)).items():
        if isinstance(value, Mapping) and value:
            words += [f"{name}.{word}" for word in words_of(value)]
        else:
            is_word = isinstance(value, str) and _value(value) == value
            words.append(f"{name}={value if is_word else json.dumps(value)}")
    return words


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
