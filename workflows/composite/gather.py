"""The inner product of a row of T with light, in vector instructions: a plain numba loop takes twice as long."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.extending import intrinsic

AHEAD = 128
"""How many entries of T ahead light is prefetched, because a monitor's light is larger than a core's cache."""
SUMS = 2
"""Entries are added to so many sums in turn, because an addition to one sum waits for the one before."""

_FLOAT, _INT, _SIZE = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_FOUR, _BYTES = ir.VectorType(_FLOAT, 4), ir.IntType(8).as_pointer()


def _gather(typing: Any, light: Any, cell: Any, weight: Any, start: Any, stop: Any) -> Any:
    """Compute ``sum(weight[i] * light[cell[i]] for i in range(start, stop))`` for each of three channels.

    Parameters
    ----------
    light : (nodes + 1, 3) float32
        Four values are read at a time, so there must be one more row after the last node.
    cell : (n,) uint32
    weight : (n,) float32
    start, stop : int
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lights, cells, weights = (
            context.make_array(kind)(context, builder, value).data
            for kind, value in zip(signature.args[:3], arguments[:3], strict=True)
        )
        size = context.make_array(signature.args[1])(context, builder, arguments[1]).nitems
        start, stop = arguments[3:]
        fetch = builder.module.declare_intrinsic(
            "llvm.prefetch", [_BYTES], ir.FunctionType(ir.VoidType(), [_BYTES, _INT, _INT, _INT])
        )
        multiply_add = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_FOUR, [_FOUR] * 3), "llvm.fma.v4f32"
        )
        sums = [cgutils.alloca_once_value(builder, _FOUR([0.0] * 4)) for _ in range(SUMS)]

        def seen(at: Any) -> Any:
            """A pointer to the light of an entry's cell."""
            number = builder.zext(builder.load(builder.gep(cells, [at])), _SIZE)
            return builder.gep(lights, [builder.mul(number, _SIZE(3))])

        def add(at: Any, to: Any) -> None:
            value = builder.load(builder.bitcast(seen(at), _FOUR.as_pointer()), align=4)
            one = builder.insert_element(
                _FOUR(ir.Undefined), builder.load(builder.gep(weights, [at])), _INT(0)
            )
            four = builder.shuffle_vector(one, _FOUR(ir.Undefined), ir.VectorType(_INT, 4)([0] * 4))
            builder.store(builder.call(multiply_add, [four, value, builder.load(to)]), to)

        last = builder.sub(size, _SIZE(1))
        even = builder.sub(stop, builder.srem(builder.sub(stop, start), _SIZE(SUMS)))
        with cgutils.for_range_slice(builder, start, even, _SIZE(SUMS), _SIZE) as (first, _):
            for number, to in enumerate(sums):
                at = builder.add(first, _SIZE(number))
                later = builder.add(at, _SIZE(AHEAD))
                later = builder.select(builder.icmp_signed("<", later, last), later, last)
                builder.call(fetch, [builder.bitcast(seen(later), _BYTES), _INT(0), _INT(3), _INT(1)])
                add(at, to)
        with cgutils.for_range_slice(builder, even, stop, _SIZE(1), _SIZE) as (at, _):
            add(at, sums[0])
        total = builder.load(sums[0])
        for further in sums[1:]:
            total = builder.fadd(total, builder.load(further))
        return context.make_tuple(
            builder, signature.return_type, [builder.extract_element(total, _INT(c)) for c in range(3)]
        )

    return types.UniTuple(types.float32, 3)(light, cell, weight, types.intp, types.intp), generate


gather: Any = intrinsic(_gather)
"""See `_gather`; only for compiled code."""
