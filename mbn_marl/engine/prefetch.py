"""Asking the processor for memory before it is needed."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.cpu import CPUContext
from numba.extending import intrinsic
from numba.np import arrayobj

FOR_WRITING, KEEP, DATA = 1, 3, 1


def _prefetch(typing: Any, array: Any, row: Any, column: Any) -> Any:
    """Begin to fetch ``array[row, column]``, which is going to be changed; on CUDA, do nothing."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if not isinstance(context, CPUContext):
            return context.get_dummy_value()
        kind = signature.args[0]
        view = arrayobj.make_array(kind)(context, builder, arguments[0])
        element = cgutils.get_item_pointer(context, builder, kind, view, arguments[1:])
        address = ir.IntType(8).as_pointer()
        hint = ir.IntType(32)
        instruction = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(ir.VoidType(), [address, hint, hint, hint]),
            "llvm.prefetch.p0i8",
        )
        hints = [hint(FOR_WRITING), hint(KEEP), hint(DATA)]
        builder.call(instruction, [builder.bitcast(element, address), *hints])
        return context.get_dummy_value()

    return types.void(array, row, column), generate


prefetch: Any = intrinsic(_prefetch)
"""``prefetch(array, row, column)``, for compiled functions; it changes nothing but the time."""
