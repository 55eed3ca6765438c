"""The field sets of the paper's authors, in the format of their released code.

A set is a mapping with ``field`` (the outline), ``init_positions`` (the starts),
``infected_locations`` (the ROIs) and ``grid_size`` (the side of the square arena; 100 when
absent), all in tens of units. A file contains one set, or a mapping of names to sets.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, TypeGuard

from mbn_marl.errors import FieldError, unknown
from mbn_marl.field.field import Field

UNITS = 10.0  # arena units per unit of these files
DEFAULT_GRID = 100
_KEYS = {"field": "vertices", "init_positions": "starts", "infected_locations": "rois"}
_PLACES = {ours: theirs for theirs, ours in _KEYS.items()} | {"arena": "grid_size"}


def is_field_set(document: object) -> TypeGuard[Mapping[str, Any]]:
    """Return whether ``document`` is one set: a mapping with any of the authors' keys."""
    return isinstance(document, Mapping) and not _KEYS.keys().isdisjoint(document)


def is_collection(document: object) -> TypeGuard[Mapping[str, Any]]:
    """Return whether ``document`` is a mapping of names to sets."""
    if not isinstance(document, Mapping) or not document:
        return False
    return all(map(is_field_set, document.values()))


def is_wheeled(document: object) -> bool:
    """Return whether ``document`` is of the authors' wheeled robots, or names of such."""
    if not isinstance(document, Mapping):
        return False
    return {"screen", "robots"} <= document.keys() or any(map(is_wheeled, document.values()))


def field_from_set(document: Mapping[str, Any], source: str, name: str) -> Field:
    """Return the field of one set, in arena units.

    Raises:
        FieldError: listing every problem, with its place in the set (coordinates in units).
    """
    known = [*_KEYS, "grid_size"]
    problems = [f"{key}: {unknown('name', key, known)}" for key in document if key not in known]
    grid = _scaled(document.get("grid_size", DEFAULT_GRID))
    lists = {ours: _scaled(document.get(key, [])) for key, ours in _KEYS.items()}
    try:
        field = Field(**lists, arena=(grid, grid), name=name)
    except FieldError as error:
        problems += map(_in_authors_words, error.problems)
    if problems:
        raise FieldError(source, dict.fromkeys(problems))
    return field


def _scaled(value: Any) -> Any:
    """Scale the numbers in ``value`` to units; leave anything else to the checks."""
    if isinstance(value, list):
        return [_scaled(entry) for entry in value]
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return value * UNITS
    return value


def _in_authors_words(problem: str) -> str:
    """Rename the places of a problem: ``starts[1]: ...`` becomes ``init_positions[1]: ...``."""
    problem = re.sub(r"^arena(\.[xy])?(?=:)", "grid_size", problem)
    return re.sub(r"\b(vertices|starts|rois)(?=[\[:])", lambda match: _PLACES[match[1]], problem)
