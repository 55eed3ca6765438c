"""Command lines from dataclasses: their fields are the options, their docstrings the help."""

from __future__ import annotations

import ast
import contextlib
import inspect
import io
import os
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass, replace
from itertools import pairwise
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.conf import arg
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from mbn_marl.errors import ConfigError, MbnError, unknown

Command = TypeVar("Command")
Reading = PrimitiveConstructorSpec[Any]
REGISTRY = ConstructorRegistry()
WIDTH = 80
CORES = os.cpu_count() or 1
"""The default number of runs at a time; each takes one core."""
SHORT = (
    (r"^Error parsing (\S+): ", r"\1: "),
    (r"^Missing value for argument '(\S+)'. Expected (\d+) values", r"\1: needs \2 value(s)"),
    (r"^Unrecognized options", "unknown"),
)
"""Tyro's messages, and ours for them."""
ATTRIBUTE = re.compile(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", re.MULTILINE)


class UsageError(MbnError):
    """A command line is not valid."""


def check_options(command: str, wrong: Mapping[str, object]) -> None:
    """Check that options fit together.

    Raises:
        ConfigError: listing the keys of ``wrong``, each a problem, whose value is true.
    """
    if problems := [problem for problem, found in wrong.items() if found]:
        raise ConfigError(command, problems)


def read_options(command: type[Command], words: Sequence[str], prog: str) -> Command:
    """Make a command, a dataclass, from the words that follow its name on the command line.

    Raises:
        UsageError: an option is unknown, missing, or has a wrong value.
        MbnError: what the checks of a configuration say.
        SystemExit: after ``--help``.
    """
    told, said = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(told), contextlib.redirect_stderr(said):
            config = (tyro.conf.FlagCreatePairsOff,)
            return tyro.cli(command, prog=prog, args=words, config=config, registry=REGISTRY)
    except SystemExit as end:
        if end.code:
            raise UsageError(f"{_in_short(said.getvalue())}; see {prog} --help") from None
        for line in told.getvalue().splitlines():  # those of the options begin with a space
            print(line.rstrip() if line.startswith(" ") else textwrap.fill(line, WIDTH))
        raise


def _in_short(said: str) -> str:
    """Return what tyro says as one line: of its parts, the problem and what may be meant."""
    _, problem, *rest = re.split(r"^ *---+ *$", said, flags=re.MULTILINE)
    options = re.compile(r"^ {6}(\S.*?) *$", re.MULTILINE)
    names = [re.findall(r"(?<!\S)-[\w-]+", line) for line in options.findall(rest[0])]
    named = [several[-1] for several in names if several]
    text = " ".join(problem.split()).rstrip(".")
    if "Missing from" in problem:
        text = f"needed: {' and '.join(options.findall(problem))}"
        text += f"; unknown: {', '.join(named)}" if "Unrecognized" in rest[0] else ""
    if missing := re.match(r"Missing value for argument '(\w+)'", text):
        text = f"needed: {missing[1].upper()}"
    for pattern, short in SHORT:
        text = re.sub(pattern, short, text)
    return text + (f" (did you mean {' or '.join(named)}?)" if "Perhaps you" in rest[0] else "")


@REGISTRY.struct_rule
def _dataclass(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Read a dataclass from an option for each of its fields."""
    if not is_dataclass(info.type):
        return None
    hints, texts = get_type_hints(info.type, include_extras=True), _help_texts(info.type)
    options = [_option(field, hints[field.name], texts) for field in fields(info.type)]
    return StructConstructorSpec(info.type, tuple(options))


def _option(field: Field[Any], hint: Any, texts: dict[str, str]) -> StructFieldSpec:
    default = field.default
    if default is MISSING:
        made = field.default_factory
        default = tyro.MISSING if made is MISSING else made()
    if default is None and isinstance(hint, type):
        hint = hint | None
    aliases = ["-o"] if field.name == "out" else None
    silent = any(default is nothing for nothing in (None, False, (), tyro.MISSING))
    shown = "" if silent else "(default: {})".format
    hint = Annotated[hint, arg(aliases=aliases, help_behavior_hint=shown)]
    return StructFieldSpec(field.name, hint, default, texts.get(field.name))


def _help_texts(command: type) -> dict[str, str]:
    """Return what a class says of each field: under ``Attributes:``, or in a string below it."""
    texts: dict[str, str] = {}
    for owner in reversed(command.__mro__[:-1]):
        texts |= dict(ATTRIBUTE.findall(inspect.getdoc(owner) or ""))
        body = ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0].body  # type: ignore[attr-defined]
        for above, below in pairwise(body):
            match above, below:
                case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                    texts[name] = text
    for name, text in texts.items():
        first, *rest = text.split()
        capital = first[0].upper() + first[1:] if first.isalpha() else first  # else it is a name
        texts[name] = " ".join([capital, *rest])
    return texts


@REGISTRY.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> Reading | None:
    """Read ``X | None`` as X: to leave the option out is ``None``."""
    kinds = get_args(info.type)
    if info.type_origin not in (Union, UnionType) or NoneType not in kinds or len(kinds) != 2:
        return None
    one = _reading(next(kind for kind in kinds if kind is not NoneType), info)
    return replace(
        one,
        is_instance=lambda value: value is None or one.is_instance(value),
        str_from_instance=lambda value: [] if value is None else one.str_from_instance(value),
    )


@REGISTRY.primitive_rule
def _several(info: PrimitiveTypeInfo) -> Reading | None:
    """Read ``tuple[X, ...]`` and ``tuple[X, X]``, naming the word that is wrong."""
    if info.type_origin is not tuple:
        return None
    kind, *rest = get_args(info.type)
    one, any_number = _reading(kind, info), rest == [Ellipsis]
    return replace(
        one,
        nargs="*" if any_number else 1 + len(rest),
        metavar=f"{one.metavar} ..." if any_number else " ".join([one.metavar] * (1 + len(rest))),
        instance_from_str=lambda words: tuple(one.instance_from_str([word]) for word in words),
        is_instance=lambda values: isinstance(values, tuple),
        str_from_instance=lambda values: [one.str_from_instance(value)[0] for value in values],
    )


@REGISTRY.primitive_rule
def _choice(info: PrimitiveTypeInfo) -> Reading | None:
    """Read one of some words; another one is answered with those that may be meant."""
    if get_origin(info.type) is not Literal:
        return None
    choices = get_args(info.type)

    def read(words: list[str]) -> str:
        if words[0] not in choices:
            raise ValueError(f"{words[0]!r}: {unknown('choice', words[0], choices)}")
        return words[0]

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(choices)}}}",
        instance_from_str=read,
        is_instance=lambda value: value in choices,
        str_from_instance=lambda value: [value],
    )


@REGISTRY.primitive_rule
def _number(info: PrimitiveTypeInfo) -> Reading | None:
    """Read a number; a whole one may be written as 1e6."""
    if info.type not in (int, float):
        return None
    whole = info.type is int
    allowed = "a whole number, such as 5000 or 1e6" if whole else "a number"

    def read(words: list[str]) -> float:
        try:
            return whole_number(words[0]) if whole else float(words[0])
        except (ValueError, OverflowError):
            raise ValueError(f"{words[0]!r}; allowed: {allowed}") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT" if whole else "NUMBER",
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, int | float),
        str_from_instance=lambda value: [str(value) if whole else f"{value:g}"],
    )


def whole_number(text: str) -> int:
    """Return the whole number that ``text`` is, such as ``5000``, ``1_000_000`` or ``1e6``."""
    try:
        return int(text)
    except ValueError:
        number = float(text)
        if number != int(number):
            raise
        return int(number)


def _reading(kind: Any, info: PrimitiveTypeInfo) -> Reading:
    """Return how a part of a type is read."""
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, info.markers))
    assert isinstance(spec, PrimitiveConstructorSpec), spec
    return spec
