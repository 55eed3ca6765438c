"""Load fields, and samplers of random ones, by name or from files, and save them.

A file has the format ``mbn-field/1`` or ``mbn-sampler/1``, or that of the paper's authors: a set
is a mapping with ``field`` (the outline), ``init_positions``, ``infected_locations`` and
``grid_size`` (the side of the square arena; 100 when absent), all in tens of units. Such a file
contains one set, or a mapping of names to sets.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import yaml
from yaml.constructor import ConstructorError, SafeConstructor

from mbn_marl.errors import ConfigError, FieldError, unknown
from mbn_marl.field.field import Field
from mbn_marl.field.generator.sampler import FieldSampler
from mbn_marl.field.schema import FORMAT, MAX_NAME, SAMPLER_FORMAT, check
from mbn_marl.files import replacing

MAX_BYTES = 64 * 1024  # twice the size of the largest field allowed
MAX_DEPTH = 12
MAP_HINT = "a map (GeoJSON, WKT) becomes one by 'mbn fields --from MAP -o FILE.yaml'"
AUTHORS_KEYS = {"field": "vertices", "init_positions": "starts", "infected_locations": "rois"}
AUTHORS_UNIT = 10.0
IS_SAMPLER = "a sampler of random fields; load_fields({!r}) loads it; allowed: a field"
_CATALOGUE = files("envs_catalog")
_SAMPLERS = _CATALOGUE / "samplers"


def catalogue_names() -> list[str]:
    """Return the names of the catalogue's fields, sorted."""
    return _names_in(_CATALOGUE)


def sampler_names() -> list[str]:
    """Return the names of the catalogue's samplers of random fields, sorted."""
    return _names_in(_SAMPLERS)


def _names_in(folder: Traversable) -> list[str]:
    names = (Path(entry.name) for entry in folder.iterdir())
    return sorted(name.stem for name in names if name.suffix == ".yaml")


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
    location = location_of(source, "a name, a path or a Field")
    path, wanted = split_location(location)
    document, name = parse_yaml(read_bytes(Path(path)), path), name_from(Path(path).stem)
    if isinstance(document, dict) and document and all(map(_is_set, document.values())):
        only = next(iter(document)) if len(document) == 1 else ""
        chosen = only if wanted is None else wanted
        if chosen not in document:
            problem = f"holds the sets {', '.join(document)}; pick one as 'path#name'"
            raise FieldError(path, [f"file: {problem}"])
        document, name = document[chosen], name_from(chosen)
    elif wanted is not None:
        raise FieldError(path, [f"file: holds one field, there is no {wanted!r} to pick"])
    return _field_of(document, location, name)


def load_fields(source: str | os.PathLike[str]) -> Field | FieldSampler:
    """Load a field as :func:`load_field` does, or a sampler of random fields.

    Args:
        source: as for :func:`load_field`; or a name of :func:`sampler_names`, or the path of a
            file in the format ``mbn-sampler/1``, whose other keys are the arguments of
            :class:`FieldSampler`.

    Raises:
        FieldError: as :func:`load_field`; or the sampler's arguments are not valid.
    """
    document: object = None
    if source in sampler_names():
        document = parse_yaml((_SAMPLERS / f"{source}.yaml").read_bytes(), str(source))
    else:
        with suppress(OSError, TypeError, ValueError):  # load_field says what is wrong
            if Path(source).is_file():
                document = parse_yaml(read_bytes(Path(source)), str(source))
    if not isinstance(document, dict) or document.pop("format", None) != SAMPLER_FORMAT:
        return load_field(source)
    try:
        return FieldSampler(**document)
    except ConfigError as error:
        raise FieldError(str(source), error.problems) from None


def save_field(field: Field | FieldSampler, path: str | os.PathLike[str]) -> None:
    """Write ``field`` to the file ``path`` in the format ``mbn-field/1``, atomically.

    A sampler is written in the format ``mbn-sampler/1``.

    Raises:
        OSError: the file cannot be written; an existing one is unchanged.
    """
    if isinstance(field, FieldSampler):
        given = {name: list(v) if isinstance(v, tuple) else v for name, v in field}
        content: dict[str, Any] = {"format": SAMPLER_FORMAT, **given}
    else:
        content = {"format": FORMAT, **field.to_dict()}
    known = {key: value for key, value in content.items() if value not in (None, [])}
    text = yaml.dump(known, Dumper=_Dumper, sort_keys=False, default_flow_style=None)
    with replacing(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")


@cache
def _catalogue_field(name: str) -> Field:
    return _field_of(parse_yaml((_CATALOGUE / f"{name}.yaml").read_bytes(), name), name, name)


def location_of(source: object, allowed: str) -> str:
    """Return a name, or a path as text."""
    location = os.fspath(source) if isinstance(source, str | os.PathLike) else None
    if not isinstance(location, str):
        problem = f"source: expected {allowed}, got {type(source).__name__}"
        raise FieldError("field", [problem])
    return location


def split_location(location: str) -> tuple[str, str | None]:
    """Return a file's path, and the name after ``#``, if there is one, of what is picked in it."""
    if "#" in location and not os.path.lexists(location):
        path, wanted = location.rsplit("#", 1)
        return path, wanted
    return location, None


def read_bytes(path: Path, most: int = MAX_BYTES) -> bytes:
    """Read a regular file of at most ``most`` bytes."""
    text = str(path)
    try:
        if not path.exists():
            if text in sampler_names():
                say = IS_SAMPLER.format(text)
            elif os.sep in text or path.suffix:
                say = "file: does not exist"
            else:
                say = f"{unknown('field', text, catalogue_names())}, or a file's path"
            raise FieldError(text, [say])
        if not path.is_file():
            raise FieldError(text, ["file: not a regular file"])
        with path.open("rb") as stream:
            data = stream.read(most + 1)
    except FieldError:  # a ValueError, too
        raise
    except (OSError, ValueError) as error:
        raise FieldError(text, [f"file: cannot be read: {error}"]) from None
    if len(data) > most:
        raise FieldError(text, [f"file: larger than {most} bytes; {MAP_HINT}"])
    return data


def _field_of(document: object, source: str, name: str) -> Field:
    """Return the field of a parsed document; ``name`` is used if the document has none."""
    if _is_set(document):
        return _field_of_set(document, source, name)
    if not isinstance(document, Mapping) or "format" not in document:
        say = f"missing; a field file begins with 'format: {FORMAT}'; {MAP_HINT}"
        raise FieldError(source, [f"format: {say}"])
    if document["format"] == SAMPLER_FORMAT:
        raise FieldError(source, [f"format: {IS_SAMPLER.format(source)}"])
    given = {key: value for key, value in document.items() if value is not None}
    values = check({"vertices": [], "rois": [], "starts": [], "name": name, **given}, source)
    del values["format"]
    return Field(**values)


def name_from(text: str) -> str:
    """Turn ``text`` into a valid field name."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", text).lstrip("_.-")[:MAX_NAME] or "custom"


def _is_set(document: object) -> bool:
    """Return whether ``document`` is one set: a mapping with any of the authors' keys."""
    return isinstance(document, Mapping) and not AUTHORS_KEYS.keys().isdisjoint(document)


def _field_of_set(document: Any, source: str, name: str) -> Field:
    """Return the field of one set; problems name places in the set, and coordinates in units."""
    known = [*AUTHORS_KEYS, "grid_size"]
    problems = [f"{key}: {unknown('name', key, known)}" for key in document if key not in known]
    grid = _in_units(document.get("grid_size", 100))
    lists = {ours: _in_units(document.get(key, [])) for key, ours in AUTHORS_KEYS.items()}
    try:
        field = Field(**lists, arena=(grid, grid), name=name)
    except FieldError as error:
        for problem in error.problems:
            problem = re.sub(r"^arena(\.[xy])?(?=:)", "grid_size", problem)
            for theirs, ours in AUTHORS_KEYS.items():
                problem = re.sub(rf"\b{ours}(?=[\[:])", theirs, problem)
            problems.append(problem)
    if problems:
        raise FieldError(source, dict.fromkeys(problems))
    return field


def _in_units(value: Any) -> Any:
    """Scale the numbers in ``value``; leave anything else to the checks."""
    if isinstance(value, list | tuple):
        return [_in_units(entry) for entry in value]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    with suppress(OverflowError):
        return value * AUTHORS_UNIT if is_number else value
    return value


_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Base):  # type: ignore[misc]  # the base is chosen at run time
    """Safe YAML with the authors' tuples and JSON's numbers; all keys are different words."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        known: set[str] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if key.tag != "tag:yaml.org,2002:str" or key.value in known:
                problem = f"{str(key.value)[:80]!r}: a key must be a word, and there only once"
                raise ConstructorError(None, None, problem, key.start_mark)
            known.add(key.value)
        return super().construct_mapping(node, deep)


_Loader.add_constructor("tag:yaml.org,2002:python/tuple", SafeConstructor.construct_yaml_seq)


class _Dumper(yaml.SafeDumper):
    """Quotes the words that the loader reads as numbers."""


for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver(  # JSON numbers that YAML 1.1 reads as text
        *("tag:yaml.org,2002:float", re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+$")),
        list("-+0123456789"),
    )


def parse_yaml(data: bytes, source: str) -> object:
    """Parse one document of plain data: UTF-8, at most 64 KiB, without anchors or aliases.

    Raises:
        FieldError: for anything else, with line and column where they are known.
    """
    if len(data) > MAX_BYTES:
        raise FieldError(source, [f"file: larger than {MAX_BYTES} bytes"])
    try:
        text, depth = data.decode("utf-8"), 0
        # LibYAML builds nodes by recursion: its stack is saved by a look at the events first.
        event: Any
        for event in yaml.parse(text, Loader=_Loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > MAX_DEPTH or getattr(event, "anchor", None) is not None:
                problem = f"allowed: nested at most {MAX_DEPTH} deep, no anchors, no aliases"
                raise ConstructorError(None, None, problem, event.start_mark)
        return yaml.load(text, Loader=_Loader)  # stricter than SafeLoader
    except yaml.MarkedYAMLError as error:
        mark, problem = error.problem_mark, str(error.problem or error.context)
        place = f"line {mark.line + 1}, column {mark.column + 1}" if mark else "file"
        raise FieldError(source, [f"{place}: {problem}"]) from None
    except (yaml.YAMLError, ValueError, LookupError, ArithmeticError, AttributeError) as error:
        # Raised by PyYAML's own scalar readers, e.g. KeyError for ``!!bool maybe``.
        raise FieldError(source, [f"file: not readable as YAML: {str(error)[:200]}"]) from None
