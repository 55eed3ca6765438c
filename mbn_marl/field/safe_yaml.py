"""Safe YAML: plain data only, of limited size and depth, and no tag can run code."""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any, ClassVar

import yaml
from yaml.constructor import BaseConstructor, ConstructorError, SafeConstructor

from mbn_marl.errors import FieldError

MAX_BYTES = 64 * 1024  # twice the size of the largest field allowed
MAX_DEPTH = 12
MAX_SCALAR = 200  # the longest word or number; huge integers are slow to handle
MAX_TEXT = 4000  # the longest text in files with sentences

_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _PlainLoader(_Base):  # type: ignore[misc]  # the base is chosen at run time
    """Reads null, bool, int, float, str, lists and mappings; any other tag is an error."""

    yaml_multi_constructors: ClassVar[dict[str, Any]] = {}


def _sequence(loader: BaseConstructor, node: yaml.SequenceNode) -> list[Any]:
    return list(loader.construct_sequence(node, deep=True))


def _mapping(loader: BaseConstructor, node: yaml.Node) -> dict[Hashable, Any]:
    if not isinstance(node, yaml.MappingNode):
        raise ConstructorError(None, None, "expected a mapping", node.start_mark)
    seen: set[str] = set()
    for key, _ in node.value:
        if key.tag != "tag:yaml.org,2002:str":
            raise ConstructorError(None, None, "a key must be a plain word", key.start_mark)
        if key.value in seen:
            raise ConstructorError(None, None, f"duplicate key {key.value!r}", key.start_mark)
        seen.add(key.value)
    return BaseConstructor.construct_mapping(loader, node, deep=True)


def _unknown_tag(loader: BaseConstructor, node: yaml.Node) -> None:
    message = f"the tag {node.tag[:MAX_SCALAR]!r} is not allowed"
    raise ConstructorError(None, None, message, node.start_mark)


_PlainLoader.yaml_constructors = {
    "tag:yaml.org,2002:null": SafeConstructor.construct_yaml_null,
    "tag:yaml.org,2002:bool": SafeConstructor.construct_yaml_bool,
    "tag:yaml.org,2002:int": SafeConstructor.construct_yaml_int,
    "tag:yaml.org,2002:float": SafeConstructor.construct_yaml_float,
    "tag:yaml.org,2002:str": SafeConstructor.construct_yaml_str,
    "tag:yaml.org,2002:seq": _sequence,
    "tag:yaml.org,2002:python/tuple": _sequence,
    "tag:yaml.org,2002:map": _mapping,
    None: _unknown_tag,
}
_PlainLoader.add_implicit_resolver(  # JSON numbers that YAML 1.1 reads as text
    "tag:yaml.org,2002:float", re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+$"), list("-+0123456789")
)


def parse_yaml(data: bytes, source: str, *, max_scalar: int = MAX_SCALAR) -> object:
    """Parse the one document in ``data``: nested dicts with word keys, lists, and plain scalars.

    Args:
        data: UTF-8 text, at most 64 KiB, nested at most 12 deep, without anchors or aliases.
        source: the name of the text in errors.
        max_scalar: the most characters of a word or number.

    Raises:
        FieldError: for anything else, with line and column where they are known.
    """
    if len(data) > MAX_BYTES:
        raise FieldError(source, [f"file: larger than {MAX_BYTES} bytes"])
    try:
        text = data.decode("utf-8")
        _refuse_bombs(text, source, max_scalar)
        return yaml.load(text, Loader=_PlainLoader)  # stricter than SafeLoader
    except yaml.MarkedYAMLError as error:
        problem = f"{_place(error.problem_mark)}: {error.problem or error.context}"
        raise FieldError(source, [problem]) from None
    except FieldError:
        raise
    except (yaml.YAMLError, ValueError, LookupError, ArithmeticError) as error:
        # Raised by PyYAML's own scalar readers, e.g. KeyError for ``!!bool maybe``.
        raise FieldError(source, [f"file: not readable as YAML: {str(error)[:200]}"]) from None


def _refuse_bombs(text: str, source: str, max_scalar: int) -> None:
    """Check for text that would cost memory, stack or time before anything is built from it."""
    depth = 0
    for event in yaml.parse(text, Loader=_PlainLoader):
        place = _place(event.start_mark)
        if getattr(event, "anchor", None) is not None:
            raise FieldError(source, [f"{place}: anchors and aliases are not allowed"])
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > MAX_DEPTH:
                raise FieldError(source, [f"{place}: nested deeper than {MAX_DEPTH}"])
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.ScalarEvent) and len(event.value) > max_scalar:
            raise FieldError(source, [f"{place}: longer than {max_scalar} characters"])


def _place(mark: Any) -> str:
    return f"line {mark.line + 1}, column {mark.column + 1}" if mark else "file"
