"""Features that are on or off for a whole engine: code of those that are off is not compiled."""

# Numba compiles a function once for each set of argument types, and the arrays of a feature that is
# off have another number of dimensions. So the types tell which features are on.

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

from numba.core.rewrites.registry import Rewrite, register_rewrite
from numba.core.types import Literal


class Feature:
    """A test of arrays' dimensions, which compiled code knows before it is compiled."""

    # ``may_rest = Feature(lambda ep: ep.status.ndim == 2)`` lets Numba leave out one of the
    # branches of ``if may_rest(ep):``.
    def __init__(self, test: Callable[..., bool]) -> None:
        self.test = test

    def __call__(self, *parts: Any) -> bool:
        return self.test(*parts)


class _Kind:
    """A type in place of its value: fields of a named tuple, or the ``ndim`` of an array."""

    def __init__(self, kind: Any) -> None:
        self.kind = kind

    def __getattr__(self, name: str) -> Any:
        fields: Any = getattr(self.kind, "fields", ())
        return _Kind(self.kind.types[fields.index(name)]) if name in fields else self.kind.ndim


class _Parts(NamedTuple):
    types: list[Any]


class Settle(Rewrite):
    """Replaces what the types tell by its value; Numba prunes the branches afterwards."""

    # That are calls of a ``Feature``, and fields of named tuples whose types are literals. The IR
    # of Numba and that of numba-cuda are two modules, so classes are found by the code's module.
    def __init__(self, state: Any) -> None:
        self.kinds = state.args

    def match(self, code: Any, block: Any, *_: Any) -> bool:
        self.ir, self.code, self.block = sys.modules[type(block).__module__], code, block
        self.settled: list[tuple[Any, Any]] = []
        for assignment in block.find_insts(self.ir.Assign):
            operation = getattr(assignment.value, "op", None)
            if operation == "call":
                self._settle_call(assignment)
            elif operation == "getattr":
                kind = self._kind_of(assignment.target)
                if isinstance(kind, Literal):
                    self.settled.append((assignment, kind.literal_value))
        return bool(self.settled)

    def apply(self) -> Any:
        for assignment, value in self.settled:
            assignment.value = self.ir.Const(value, assignment.loc)
            self.code._definitions[assignment.target.name] = [assignment.value]
        return self.block

    def _settle_call(self, assignment: Any) -> None:
        call = assignment.value
        called = self._definition(call.func)
        # Numba's expressions raise a KeyError, not an AttributeError, for a name that they lack.
        feature = called.value if isinstance(called, (self.ir.Global, self.ir.FreeVar)) else None
        if isinstance(feature, Feature):
            kinds = [self._kind_of(part) for part in call.args]
            if None in kinds:
                found = f"a Feature's arguments at {assignment.loc}"
                raise TypeError(f"{found}; allowed: those of the function, and parts of them")
            result = feature.test(*map(_Kind, kinds))
            loads = [one for one in self.block.find_insts(self.ir.Assign) if one.value is called]
            self.settled += [(assignment, result), *((load, None) for load in loads)]

    def _definition(self, name: Any) -> Any:
        try:
            return self.code.get_definition(name)
        except KeyError:  # there are several
            return None

    def _kind_of(self, name: Any) -> Any:
        """The type of an argument, of a field of one, or of a part of a tuple; else ``None``."""
        value = self._definition(name)
        if isinstance(value, self.ir.Arg):
            return self.kinds[value.index]
        operation = getattr(value, "op", None)
        if operation == "build_tuple":
            return _Parts([self._kind_of(item) for item in value.items])
        if operation not in ("getattr", "static_getitem", "exhaust_iter"):
            return None
        kind = self._kind_of(value.value)
        if operation == "getattr":
            fields = getattr(kind, "fields", ())
            return kind.types[fields.index(value.attr)] if value.attr in fields else None
        if operation == "static_getitem":
            return kind.types[value.index] if hasattr(kind, "types") else None
        return kind


register_rewrite("before-inference")(Settle)  # type: ignore[no-untyped-call]
