"""All arrays of an engine behind one address, which makes calling a kernel cheap.

Passing some fifty arrays to a compiled function takes Numba longer than one world takes to step.
So Python writes the descriptor of each array into a table, laid out as Numba's named tuples of
arrays are, and compiled code reads the table: no code has to be compiled to make it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import typeof
from numba.core import cgutils, types
from numba.extending import NativeValue, intrinsic, models, register_model, unbox
from numpy.typing import NDArray

from mbn_marl.engine.constants import Constants, constants_of

SETTLED = ("rules", "team_sharing", "one_hot", "random_starts"), ("observation",)
"""Groups of constants. Where all of one are 0, they are part of a store's type.

Code that they exclude is not compiled then. Each other value in the type would compile it again.
"""
NO_OWNER = (0, 0)


class StoreType(types.Type):
    """Numba's type of :class:`Store`: the types of what ``parts_of`` returns."""

    def __init__(self, parts: tuple[Any, ...]) -> None:
        self.parts = parts
        super().__init__(name=f"Store({', '.join(map(str, parts))})")


register_model(StoreType)(models.OpaqueModel)


class Store:
    """References to an engine's arrays, grouped as in ``state``.

    Args:
        record: of the constants, see ``constants.make_record``.
        parts: named tuples of arrays, which are not copied.
        scratch: one for each range of worlds that is stepped on another thread.

    Attributes:
        resets: whether ``call_reset`` can be called.
        address: where the tables begin: a row for each scratch.
    """

    def __init__(self, record: NDArray[Any], parts: Sequence[Any], scratch: Sequence[Any]) -> None:
        shared = [0, record.ctypes.data, *_words_of(parts)]
        self._held = record, parts, scratch
        self._tables = np.array([[*shared, *_words_of(one)] for one in scratch], np.int64)
        self.resets, self.address = False, self._tables.ctypes.data
        constants = _kind_of_constants(constants_of(record))
        self._numba_type_ = StoreType((constants, *map(typeof, (*parts, scratch[0]))))

    def reset_by(self, address: int) -> None:
        """Let ``call_reset`` call the machine code at this address."""
        self._tables[:, 0] = address
        self.resets = True


def _words_of(part: Any) -> Iterator[int]:
    """Yield Numba's description of an array, or of those in a tuple."""
    if isinstance(part, tuple):
        for one in part:
            yield from _words_of(one)
    else:
        yield from (*NO_OWNER, part.size, part.itemsize, part.ctypes.data)
        yield from (*part.shape, *part.strides)


def _kind_of_constants(constants: Constants) -> types.NamedTuple:
    """The type of the constants in a store."""
    off = {
        name for group in SETTLED if not any(getattr(constants, k) for k in group) for name in group
    }
    kinds = [
        types.literal(value) if name in off else typeof(value)
        for name, value in constants._asdict().items()
    ]
    return types.NamedTuple(kinds, Constants)


@unbox(StoreType)  # type: ignore[untyped-decorator]
def _unbox(kind: StoreType, store: Any, c: Any) -> NativeValue:
    number = c.pyapi.object_getattr_string(store, "address")
    address = c.pyapi.long_as_voidptr(number)
    c.pyapi.decref(number)
    return NativeValue(address, is_error=cgutils.is_not_null(c.builder, c.pyapi.err_occurred()))


def _table_of(context: Any, store: StoreType) -> ir.LiteralStructType:
    constants, *parts = map(context.get_value_type, store.parts)
    return ir.LiteralStructType([ir.IntType(64), constants.as_pointer(), *parts])


def _parts_of(typing: Any, store: StoreType) -> Any:
    """Return the constants, and the parts of a store, without counting references.

    Scalars that live in registers cannot alias the arrays that a pass writes, so they leave its
    loop.
    """
    kinds = types.Tuple(store.parts)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        table = _table_of(context, store)
        held = builder.load(builder.bitcast(arguments[0], table.as_pointer()))
        _, address, *parts = (builder.extract_value(held, k) for k in range(len(table.elements)))
        return context.make_tuple(builder, kinds, [builder.load(address), *parts])

    return kinds(store), generate


def _with_scratch(typing: Any, store: StoreType, k: Any) -> Any:
    """Return the store that has the ``k``-th scratch."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        tables = builder.bitcast(arguments[0], _table_of(context, store).as_pointer())
        return builder.bitcast(builder.gep(tables, [arguments[1]]), arguments[0].type)

    return store(store, k), generate


def _call_reset(typing: Any, store: StoreType, mask: Any, lo: Any, hi: Any) -> Any:
    """Call the ``reset_worlds`` that the store has; what calls it need not be compiled with it."""
    kinds = (store, mask, lo, hi, types.boolean)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        calls = context.call_conv
        kind = calls.get_function_type(types.none, kinds)
        place = builder.bitcast(arguments[0], kind.as_pointer().as_pointer())
        given = [*arguments, context.get_constant(types.boolean, False)]
        called = calls.call_function(builder, builder.load(place), types.none, kinds, given)
        with cgutils.if_unlikely(builder, called[0].is_error):
            calls.return_status_propagate(builder, called[0])
        return context.get_dummy_value()

    return types.none(store, mask, lo, hi), generate


parts_of: Any = intrinsic(_parts_of)
call_reset: Any = intrinsic(_call_reset)
with_scratch: Any = intrinsic(_with_scratch)
