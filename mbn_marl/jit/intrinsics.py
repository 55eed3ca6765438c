"""Instructions that Numba does not offer: prefetch memory, transpose squares, call an address."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.cpu import CPUContext
from numba.extending import intrinsic
from numba.np import arrayobj

# Calls of an instruction lack the typing context, which Numba's own type would ask for.
instruction: Callable[[Callable[..., Any]], Any] = intrinsic
FOR_WRITING, KEEP, DATA = 1, 3, 1
SIDE = 8
HALVINGS = 3  # of SIDE, down to 1
FLOATS = ir.VectorType(ir.FloatType(), SIDE)
INDICES = ir.VectorType(ir.IntType(32), SIDE)
# Indices into two joined vectors that interleave their lower or upper halves.
LOWER = ir.Constant(INDICES, [k // 2 + SIDE * (k % 2) for k in range(SIDE)])
UPPER = ir.Constant(INDICES, [k // 2 + SIDE * (k % 2) + SIDE // 2 for k in range(SIDE)])


@instruction
def prefetch(typing: Any, array: Any, row: Any, column: Any) -> Any:
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


@instruction
def call_step(typing: Any, address: Any, store: Any, actions: Any, lo: Any, hi: Any) -> Any:
    """Call the ``step_worlds`` at ``address``, which its caller is then not compiled with."""
    kinds = (store, actions, lo, hi)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        calls = context.call_conv
        kind = calls.get_function_type(types.int64, kinds)
        function = builder.inttoptr(arguments[0], kind.as_pointer())
        given = arguments[1:]
        status, ended = calls.call_function(builder, function, types.int64, kinds, given)
        with cgutils.if_unlikely(builder, status.is_error):
            calls.return_status_propagate(builder, status)
        return ended

    return types.int64(address, *kinds), generate


@instruction
def transpose(typing: Any, tile: Any, k: Any, column: Any, rows: Any, w: Any, i: Any) -> Any:
    # Arrays are float32, with a contiguous last axis; indices are unsigned, the square within both.

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        tile, k, column, rows, w, i = arguments
        tile_type, _, _, rows_type, _, _ = signature.args

        def address(kind: Any, array: Any, *place: Any) -> Any:
            view = arrayobj.make_array(kind)(context, builder, array)
            element = cgutils.get_item_pointer(context, builder, kind, view, place)
            return builder.bitcast(element, FLOATS.as_pointer())

        def offset(index: Any, by: int) -> Any:
            return builder.add(index, ir.Constant(index.type, by))

        vectors = [
            builder.load(address(tile_type, tile, offset(k, a), column), align=4)
            for a in range(SIDE)
        ]
        for _ in range(HALVINGS):
            pairs = zip(vectors[: SIDE // 2], vectors[SIDE // 2 :], strict=True)
            vectors = [
                builder.shuffle_vector(*pair, mask) for pair in pairs for mask in (LOWER, UPPER)
            ]
        for b, vector in enumerate(vectors):
            builder.store(vector, address(rows_type, rows, offset(w, b), i, k), align=4)
        return context.get_dummy_value()

    return types.void(tile, k, column, rows, w, i), generate
