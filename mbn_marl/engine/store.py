"""All arrays of an engine behind one pointer, which makes calling a kernel cheap.

Passing some fifty arrays to a compiled function takes Numba longer than one world takes to step.
"""

from __future__ import annotations

from typing import Any

from numba.core import cgutils, types
from numba.core.runtime.context import NRTContext
from numba.experimental import structref
from numba.extending import intrinsic

from mbn_marl.compiled.jit import entry_point

PARTS = ("constants", "geometry", "memory", "now", "final", "output")


@structref.register
class StoreType(types.StructRef):
    """Numba's type of :class:`Store`."""

    def preprocess_fields(self, fields: Any) -> Any:
        """Fields keep their types, whatever literal they were made from."""
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class Store(structref.StructRefProxy):
    """References to an engine's arrays, grouped as in ``state``; see ``PARTS``."""

    def __new__(cls, *parts: Any) -> Store:
        """Hold the named tuples and arrays, without copying them."""
        return make_store(*parts)  # type: ignore[no-any-return]


structref.define_proxy(Store, StoreType, PARTS)


@entry_point
def make_store(constants, geometry, memory, now, final, output):
    """Build a store; compiled by itself so that it is cached like every other function."""
    return Store(constants, geometry, memory, now, final, output)


def _parts_of(typing: Any, store: Any) -> Any:
    """Return the parts of a store in the order of ``PARTS``, without counting references."""
    kinds = types.Tuple([store.field_dict[name] for name in PARTS])
    payload = store.get_data_type()

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        handle = cgutils.create_struct_proxy(store)(context, builder, value=arguments[0])
        address = NRTContext(context, True).meminfo_data(builder, handle.meminfo)
        address = builder.bitcast(address, context.get_value_type(payload).as_pointer())
        held = cgutils.create_struct_proxy(payload)(context, builder, ref=address)
        return context.make_tuple(builder, kinds, [getattr(held, name) for name in PARTS])

    return kinds(store), generate


parts_of: Any = intrinsic(_parts_of)
