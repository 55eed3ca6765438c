"""The arguments of the kernels: all arrays of an engine behind one address."""

# Passing some fifty arrays to a compiled function takes Numba longer than one world takes to step.
# So Python writes the descriptor of each array into a table, laid out as Numba's named tuples of
# arrays are, and compiled code reads the table: no code has to be compiled to make it.

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import typeof
from numba.core import cgutils, types
from numba.extending import NativeValue, models, register_model, unbox
from numpy.typing import NDArray

from mbn_marl.engine.constants import Constants, constants_of
from mbn_marl.jit.intrinsics import instruction

# Groups of constants. Those of a group that are all 0 are part of the arguments' type.
#
# Code that they exclude is not compiled then. Each other value in the type would compile it again.
SETTLED = ("rules", "team_sharing", "one_hot", "random_starts"), ("observation",)
NO_OWNER = (0, 0)


class ArgumentsType(types.Type):
    # The types of what ``worlds_of`` returns.
    def __init__(self, parts: tuple[Any, ...]) -> None:
        self.parts = parts
        super().__init__(name=f"Arguments({', '.join(map(str, parts))})")


register_model(ArgumentsType)(models.OpaqueModel)


class Arguments:
    """References to an engine's arrays: ``parts`` are geometry, memory, now, final and output."""

    # There is a scratch for each range of worlds that is stepped on another thread.
    def __init__(self, record: NDArray[Any], parts: Sequence[Any], scratch: Sequence[Any]) -> None:
        shared = [0, record.ctypes.data, *_words_of(parts)]
        self._held = record, parts, scratch
        self._tables = np.array([[*shared, *_words_of(one)] for one in scratch], np.int64)
        self.resets, self.step_address, self.address = False, 0, self._tables.ctypes.data
        constants = _kind_of_constants(constants_of(record))
        self._numba_type_ = ArgumentsType((constants, *map(typeof, (*parts, scratch[0]))))

    def reset_by(self, address: int) -> None:
        self._tables[:, 0] = address
        self.resets = True


def _words_of(part: Any) -> Iterator[int]:
    if isinstance(part, tuple):
        for one in part:
            yield from _words_of(one)
    else:
        yield from (*NO_OWNER, part.size, part.itemsize, part.ctypes.data)
        yield from (*part.shape, *part.strides)


def _kind_of_constants(constants: Constants) -> types.NamedTuple:
    off = {
        name for group in SETTLED if not any(getattr(constants, k) for k in group) for name in group
    }
    kinds = [
        types.literal(value) if name in off else typeof(value)
        for name, value in constants._asdict().items()
    ]
    return types.NamedTuple(kinds, Constants)


@unbox(ArgumentsType)  # type: ignore[untyped-decorator]
def _unbox(kind: ArgumentsType, held: Any, c: Any) -> NativeValue:
    number = c.pyapi.object_getattr_string(held, "address")
    address = c.pyapi.long_as_voidptr(number)
    c.pyapi.decref(number)
    return NativeValue(address, is_error=cgutils.is_not_null(c.builder, c.pyapi.err_occurred()))


def _table_of(context: Any, kind: ArgumentsType) -> ir.LiteralStructType:
    constants, *parts = map(context.get_value_type, kind.parts)
    return ir.LiteralStructType([ir.IntType(64), constants.as_pointer(), *parts])


@instruction
def worlds_of(typing: Any, kind: ArgumentsType) -> Any:
    """Return the constants, all parts and the scratch, without counting references."""
    # Scalars that live in registers cannot alias the arrays that a pass writes, so they leave its
    # loop.
    kinds = types.Tuple(kind.parts)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        table = _table_of(context, kind)
        held = builder.load(builder.bitcast(arguments[0], table.as_pointer()))
        _, address, *parts = (builder.extract_value(held, k) for k in range(len(table.elements)))
        return context.make_tuple(builder, kinds, [builder.load(address), *parts])

    return kinds(kind), generate


@instruction
def with_scratch(typing: Any, kind: ArgumentsType, k: Any) -> Any:

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        tables = builder.bitcast(arguments[0], _table_of(context, kind).as_pointer())
        return builder.bitcast(builder.gep(tables, [arguments[1]]), arguments[0].type)

    return kind(kind, k), generate


@instruction
def call_reset(typing: Any, kind: ArgumentsType, mask: Any, lo: Any, hi: Any) -> Any:
    """Call the ``reset_worlds`` at the address; what calls it need not be compiled with it."""
    kinds = (kind, mask, lo, hi, types.boolean)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        calls = context.call_conv
        function = calls.get_function_type(types.none, kinds)
        place = builder.bitcast(arguments[0], function.as_pointer().as_pointer())
        given = [*arguments, context.get_constant(types.boolean, False)]
        called = calls.call_function(builder, builder.load(place), types.none, kinds, given)
        with cgutils.if_unlikely(builder, called[0].is_error):
            calls.return_status_propagate(builder, called[0])
        return context.get_dummy_value()

    return types.none(kind, mask, lo, hi), generate
