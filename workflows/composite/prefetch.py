"""A hint to the processor, which numba has no name for."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.extending import intrinsic


def _prefetch(typing: Any, array: Any, index: Any) -> Any:
    """Begin to fetch an element of a one-dimensional array into the cache: ``llvm.prefetch`` to read, kept long."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        hint = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        at = builder.bitcast(builder.gep(data, [arguments[1]]), byte)
        builder.call(hint, [at, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


prefetch: Any = intrinsic(_prefetch)
"""``prefetch(array, index)``, in compiled code alone."""
