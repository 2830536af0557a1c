"""Which of the next steps along a ray lie in occupied cells, all looked up at once."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from fieldpose.stages.nerf.kernels.vectors import CONTRACT, F32, I32, data_of, in_all_lanes

AHEAD = 8
_FLOATS, _INTS = ir.VectorType(F32, AHEAD), ir.VectorType(I32, AHEAD)


def _indices(builder: ir.IRBuilder, u: ir.Value, change: ir.Value, size: ir.Value) -> ir.Value:
    """Of the cells along an axis."""
    steps = ir.Constant(_FLOATS, [float(i) for i in range(AHEAD)])
    none, most = ir.Constant(_FLOATS, [0.0] * AHEAD), builder.fsub(size, ir.Constant(_FLOATS, [1.0] * AHEAD))
    way = builder.fmul(steps, in_all_lanes(builder, change, AHEAD), flags=CONTRACT)
    place = builder.fmul(builder.fadd(way, in_all_lanes(builder, u, AHEAD), flags=CONTRACT), size)
    place = builder.select(builder.fcmp_ordered(">", place, none), place, none)
    return builder.fptosi(builder.select(builder.fcmp_ordered("<", place, most), place, most), _INTS)


@intrinsic
def occupied_ahead(typing_context, bits, resolution, u0, u1, u2, d0, d1, d2):  # type: ignore[no-untyped-def]
    """Bit i is set where the cell at (u0, u1, u2) + i * (d0, d1, d2) in the unit cube is occupied, for i < AHEAD.

    bits as `Domain` has them, the rest float32.
    """

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> ir.Value:
        size = in_all_lanes(builder, arguments[1], AHEAD)
        x, y, z = (_indices(builder, arguments[2 + a], arguments[5 + a], size) for a in range(3))
        n = in_all_lanes(builder, builder.fptosi(arguments[1], I32), AHEAD)
        flat = builder.add(x, builder.mul(n, builder.add(y, builder.mul(n, z))))
        data = data_of(context, builder, signature.args[0], arguments[0])
        of_byte = builder.lshr(flat, ir.Constant(_INTS, [3] * AHEAD))
        words = ir.Constant(_INTS, ir.Undefined)
        for i in range(AHEAD):
            lane = ir.Constant(I32, i)
            byte = builder.load(builder.gep(data, [builder.extract_element(of_byte, lane)]))
            words = builder.insert_element(words, builder.zext(byte, I32), lane)
        shift = builder.and_(flat, ir.Constant(_INTS, [7] * AHEAD))
        wanted = builder.shl(ir.Constant(_INTS, [1] * AHEAD), shift)
        found = builder.icmp_unsigned("!=", builder.and_(words, wanted), ir.Constant(_INTS, [0] * AHEAD))
        return builder.zext(builder.bitcast(found, ir.IntType(AHEAD)), ir.IntType(64))

    f = types.float32
    return types.int64(bits, f, f, f, f, f, f, f), generate
