"""Which errors of the suite a function is seen to raise, from its source."""

from __future__ import annotations

import ast
import builtins
import inspect
import textwrap
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbn_marl.errors import MbnError

Function = Callable[..., Any]
Errors = set[type[MbnError]]


def is_subclass(value: Any, kind: type) -> bool:
    """Return whether ``value`` is a class derived from ``kind``."""
    return inspect.isclass(value) and issubclass(value, kind)


def raised_by(
    function: Function, owner: Any = None, seen: frozenset[Function] = frozenset()
) -> Errors:
    """The errors of the suite that a function is seen to raise.

    By itself, or through the functions and classes of this package that it calls by name and the
    methods of its own object; calls through other objects are not followed.
    """
    function = inspect.unwrap(function)
    if function in seen or not _has_source(function):
        return set()
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    caller = _Caller(function, owner, seen | {function})
    return caller.errors_in(tree)


def _has_source(function: Function) -> bool:
    """Return whether somebody wrote this function of the package; a dataclass's are made."""
    return inspect.isfunction(function) and Path(function.__code__.co_filename).is_file()


@dataclass(frozen=True)
class _Caller:
    """A function whose statements are looked at."""

    function: Function
    owner: Any
    seen: frozenset[Function]

    def errors_in(self, node: ast.AST) -> Errors:
        """The errors that leave a statement."""
        if isinstance(node, ast.Try):
            rest = [*node.handlers, *node.orelse, *node.finalbody]
            caught = tuple(kind for handler in node.handlers for kind in self._caught(handler))
            leaving = {error for error in self._in_all(node.body) if not issubclass(error, caught)}
            return leaving | self._in_all(rest)
        own = self._raised(node) if isinstance(node, ast.Raise) else set()
        called = self._called(node) if isinstance(node, ast.Call) else set()
        return own | called | self._in_all(ast.iter_child_nodes(node))

    def _in_all(self, statements: Iterable[ast.AST]) -> Errors:
        return set().union(*map(self.errors_in, statements))

    def _caught(self, handler: ast.ExceptHandler) -> list[type]:
        """The errors that a handler names; all of them if it names none."""
        if handler.type is None:
            return [Exception]
        found = [self._named(part) for part in ast.walk(handler.type) if isinstance(part, ast.expr)]
        return [kind for kind in found if is_subclass(kind, Exception)]

    def _raised(self, node: ast.Raise) -> Errors:
        what = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
        value = self._named(what)
        return {value} if is_subclass(value, MbnError) else set()

    def _called(self, node: ast.Call) -> Errors:
        value = self._named(node.func)
        home = getattr(value, "__module__", "")
        if not (home.startswith("mbn_marl") or home == self.function.__module__):
            return set()
        if inspect.isclass(value):
            return raised_by(value.__init__, value, self.seen)
        owner = self.owner if isinstance(node.func, ast.Attribute) else None
        return raised_by(value, owner, self.seen)

    def _named(self, node: ast.expr | None) -> Any:
        """The object that a name or a method of ``self`` refers to, if that can be seen."""
        match node:
            case ast.Name(id=name):
                return self.function.__globals__.get(name, getattr(builtins, name, None))
            case ast.Attribute(value=ast.Name(id="self"), attr=method):
                return inspect.getattr_static(self.owner, method, None)
            case _:
                return None
