"""Load fields, and samplers of random ones, by name or from files, and save them."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from mbn_marl.config import describe
from mbn_marl.errors import ConfigError, FieldError, unknown
from mbn_marl.field import authors
from mbn_marl.field.catalogue import catalogue_file, catalogue_names, sampler_file, sampler_names
from mbn_marl.field.field import Field
from mbn_marl.field.limits import MAX_NAME
from mbn_marl.field.safe_yaml import MAX_BYTES, parse_yaml
from mbn_marl.field.sampler import FieldSampler
from mbn_marl.field.schema import FORMAT, SAMPLER_FORMAT, FieldFile
from mbn_marl.files import replacing

FILE_SUFFIXES = (".yaml", ".yml", ".json", ".geojson", ".wkt", ".ini")
"""Names that end so are paths, not names of fields."""
_MAP = re.compile(
    rb"\W*((SRID=\d+;)?(MULTI)?(POLYGON|POINT)\b|GEOMETRYCOLLECTION\b|"
    rb"\{[^{]*\"type\"\s*:\s*\"(Feature|FeatureCollection|(Multi)?Polygon|GeometryCollection)\")",
    re.IGNORECASE,
)
"""The beginning of a map in WKT or GeoJSON."""


def load_field(source: str | os.PathLike[str] | Field) -> Field:
    """Load the field with a catalogue name or from a file; return a :class:`Field` unchanged.

    Args:
        source: a name of :func:`catalogue_names`, or the path of a file in the format
            ``mbn-field/1`` or in the authors' format. ``path#name`` picks one of several sets in
            an authors' file.

    Raises:
        FieldError: listing every problem: the name is unknown, the file cannot be read, or the
            field is not valid. No bad input raises anything else, and no tag runs code.
    """
    if isinstance(source, Field):
        return source
    if isinstance(source, str) and source in catalogue_names():
        return _catalogue_field(source)
    try:
        location = os.fspath(source)
    except TypeError:
        location = None
    if not isinstance(location, str):
        kind = type(source).__name__
        raise FieldError("field", [f"source: expected a name, a path or a Field, got {kind}"])
    return _field_of_file(location)


def load_fields(source: str | os.PathLike[str]) -> Field | FieldSampler:
    """Load a field as :func:`load_field` does, or a sampler of random fields.

    Args:
        source: as for :func:`load_field`; or a name of :func:`sampler_names`, or the path of a
            file in the format ``mbn-sampler/1``, whose other keys are the arguments of
            :class:`FieldSampler`.

    Raises:
        FieldError: as :func:`load_field`; or the sampler's arguments are not valid.
    """
    if source in sampler_names():
        return _sampler_of_document(parse_yaml(sampler_file(str(source)), str(source)), str(source))
    document = None
    with suppress(OSError, TypeError, ValueError):  # load_field says what is wrong
        if Path(source).is_file():
            document = parse_yaml(read_bytes(Path(source)), str(source))
    if _format_of(document) == SAMPLER_FORMAT:
        return _sampler_of_document(document, str(source))
    return load_field(source)


def save_field(field: Field | FieldSampler, path: str | os.PathLike[str]) -> None:
    """Write ``field`` to the file ``path`` in the format ``mbn-field/1``, atomically.

    A sampler is written in the format ``mbn-sampler/1``.

    Raises:
        OSError: the file cannot be written; an existing one is unchanged.
    """
    if isinstance(field, FieldSampler):
        given = ((name, list(v) if isinstance(v, tuple) else v) for name, v in field)
        content: dict[str, Any] = {"format": SAMPLER_FORMAT, **dict(given)}
    else:
        content = {"format": FORMAT, **field.to_dict()}
    known = {key: value for key, value in content.items() if value not in (None, [])}
    text = yaml.safe_dump(known, sort_keys=False, default_flow_style=None)
    with replacing(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")


@cache
def _catalogue_field(name: str) -> Field:
    return _field_of_document(parse_yaml(catalogue_file(name), name), name, name)


def _field_of_file(location: str) -> Field:
    """Load the field from the file at ``location``, which may end in ``#name``."""
    path, wanted = split_location(location)
    data = read_bytes(Path(path))
    if _MAP.match(data):
        say = f"a map (GeoJSON or WKT); 'mbn fields --from {path} -o FILE.yaml' makes a field of it"
        raise FieldError(path, [f"format: {say}"])
    if re.match(rb"\s*\[\w+\]\s*\n", data):  # as the authors' wheeled robots have
        raise FieldError(path, [f"format: an INI file; allowed: {FORMAT}, in YAML or JSON"])
    document = parse_yaml(data, path)
    name = name_from(Path(path).stem)
    if authors.is_collection(document):
        document, name = _chosen(document, wanted, path)
    elif wanted is not None and (authors.is_field_set(document) or _format_of(document) == FORMAT):
        raise FieldError(path, [f"file: holds one field, there is no {wanted!r} to pick"])
    return _field_of_document(document, location, name)


def split_location(location: str) -> tuple[str, str | None]:
    """Return a file's path, and the name after ``#``, if there is one, of what is picked in it."""
    if "#" in location and not os.path.lexists(location):
        path, wanted = location.rsplit("#", 1)
        return path, wanted
    return location, None


def read_bytes(path: Path, most: int = MAX_BYTES) -> bytes:
    """Read a regular file, at most one byte more than ``most``."""
    text = str(path)
    try:
        if not path.exists():
            is_path = os.sep in text or path.suffix in FILE_SUFFIXES
            name = f"{unknown('field', text, catalogue_names())}, or a file's path"
            if text in sampler_names():
                name = (
                    f"{text} is a sampler of random fields; allowed: one field, or where samplers "
                )
                name += f"are, the FieldSampler mbn_marl.field.load_fields({text!r})"
            raise FieldError(text, ["file: does not exist" if is_path else name])
        if not path.is_file():
            raise FieldError(text, ["file: not a regular file"])
        with path.open("rb") as stream:
            return stream.read(most + 1)
    except FieldError:  # a ValueError, too
        raise
    except (OSError, ValueError) as error:
        raise FieldError(text, [f"file: cannot be read: {error}"]) from None


def _format_of(document: object) -> object:
    return document.get("format") if isinstance(document, Mapping) else None


def _chosen(
    collection: Mapping[str, Any], wanted: str | None, path: str
) -> tuple[Mapping[str, Any], str]:
    if wanted is None and len(collection) == 1:
        (wanted,) = collection
    if wanted is not None and wanted in collection:
        return collection[wanted], name_from(wanted)
    names = ", ".join(collection)
    problem = "holds several sets" if wanted is None else f"holds no set {wanted!r}"
    raise FieldError(path, [f"file: {problem}; pick one as 'path#name', name one of: {names}"])


def _sampler_of_document(document: object, source: str) -> FieldSampler:
    """Return the sampler that a parsed document describes."""
    given = {**document} if isinstance(document, Mapping) else {}
    given.pop("format", None)
    try:
        return FieldSampler(**given)
    except ConfigError as error:
        raise FieldError(source, error.problems) from None


def _field_of_document(document: object, source: str, name: str) -> Field:
    """Return the field of a parsed document; ``name`` is used if the document has none."""
    if authors.is_field_set(document):
        return authors.field_from_set(document, source, name)
    if _format_of(document) == SAMPLER_FORMAT:
        raise FieldError(source, [f"format: {SAMPLER_FORMAT}, of random fields; allowed: {FORMAT}"])
    if not isinstance(document, Mapping) or "format" not in document:
        say = f"missing; a field file starts with 'format: {FORMAT}'"
        if authors.is_wheeled(document):
            say = f"the authors' wheeled robots; allowed: {FORMAT}, or the authors' field sets"
        raise FieldError(source, [f"format: {say}"])
    problems = []
    given = {key: value for key, value in document.items() if value is not None}
    content = {"vertices": [], "rois": [], "starts": [], **given}
    try:
        FieldFile.model_validate(content)
    except ValidationError as error:
        problems += describe(error, FieldFile)
    known = inspect.signature(Field).parameters
    try:
        field = Field(**{"name": name, **{key: content[key] for key in content if key in known}})
    except FieldError as error:
        problems += error.problems
    if problems:
        raise FieldError(source, problems)
    return field


def name_from(text: str) -> str:
    """Turn ``text`` into a valid field name."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", text).lstrip("_.-")[:MAX_NAME] or "custom"
