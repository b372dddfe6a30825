"""The inner product of a row of T with light, in vector instructions: a plain numba loop takes twice as long."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.extending import intrinsic

SUMS = 2
"""Entries are added to so many sums in turn, because an addition to one sum waits for the one before."""

_FLOAT, _INT, _SIZE = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_FOUR = ir.VectorType(_FLOAT, 4)


def _gather(typing: Any, light: Any, step: Any, code: Any, first: Any, start: Any, stop: Any) -> Any:
    """Add up the light of cells, each times its code, for three channels.

    Parameters
    ----------
    light : (nodes + 1, 3) float32
        Four values are read at a time, so there must be one more row after the last node.
    step : (n,) uint16
        The distance of each cell from the one before.
    code : (n,) uint16
    first : int
        The cell that ``step[start]`` counts from.
    start, stop : int
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lights, steps, codes = (
            context.make_array(kind)(context, builder, value).data
            for kind, value in zip(signature.args[:3], arguments[:3], strict=True)
        )
        first, start, stop = arguments[3:]
        multiply_add = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_FOUR, [_FOUR] * 3), "llvm.fma.v4f32"
        )
        sums = [cgutils.alloca_once_value(builder, _FOUR([0.0] * 4)) for _ in range(SUMS)]
        place = cgutils.alloca_once_value(builder, builder.mul(first, _SIZE(3)))

        def add(at: Any, to: Any) -> None:
            away = builder.zext(builder.load(builder.gep(steps, [at])), _SIZE)
            cell = builder.add(builder.load(place), builder.mul(away, _SIZE(3)))
            builder.store(cell, place)
            seen = builder.bitcast(builder.gep(lights, [cell]), _FOUR.as_pointer())
            weight = builder.zext(builder.load(builder.gep(codes, [at])), _INT)
            one = builder.insert_element(_FOUR(ir.Undefined), builder.sitofp(weight, _FLOAT), _INT(0))
            four = builder.shuffle_vector(one, _FOUR(ir.Undefined), ir.VectorType(_INT, 4)([0] * 4))
            value = builder.load(seen, align=4)
            builder.store(builder.call(multiply_add, [four, value, builder.load(to)]), to)

        even = builder.sub(stop, builder.srem(builder.sub(stop, start), _SIZE(SUMS)))
        with cgutils.for_range_slice(builder, start, even, _SIZE(SUMS), _SIZE) as (at, _):
            for number, to in enumerate(sums):
                add(builder.add(at, _SIZE(number)), to)
        with cgutils.for_range_slice(builder, even, stop, _SIZE(1), _SIZE) as (at, _):
            add(at, sums[0])
        total = builder.load(sums[0])
        for further in sums[1:]:
            total = builder.fadd(total, builder.load(further))
        return context.make_tuple(
            builder, signature.return_type, [builder.extract_element(total, _INT(c)) for c in range(3)]
        )

    found = types.UniTuple(types.float32, 3)
    return found(light, step, code, types.intp, types.intp, types.intp), generate


gather: Any = intrinsic(_gather)
"""See `_gather`; only for compiled code."""
