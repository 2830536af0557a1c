"""Table rows and weights of the corners around samples, sixteen samples at a time.

The compiler finds no vectors here by itself where it cannot know that what is written is not what is read.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from fieldpose.stages.nerf.kernels.vectors import BLOCK, F32, I32, I64, data_of, in_all_lanes, vector_at

LANES = 16
PRIME_Y, PRIME_Z = 2654435761, 805459861
_FLOATS, _INTS = ir.VectorType(F32, LANES), ir.VectorType(I32, LANES)


def _constant(number: int) -> ir.Constant:
    return ir.Constant(_INTS, [number] * LANES)


def _cells(context: Any, builder: ir.IRBuilder, u: ir.Value, kind: types.Array, at: ir.Value, resolution: ir.Value):  # type: ignore[no-untyped-def]
    """As `encoding.cell`, along each axis: indices, positions in the cells, and what is left to their ends."""
    array = context.make_array(kind)(context, builder, u)
    stride = builder.extract_value(array.shape, 1)
    one, none = ir.Constant(_FLOATS, [1.0] * LANES), ir.Constant(_FLOATS, [0.0] * LANES)
    size = in_all_lanes(builder, resolution, LANES)
    most = builder.fsub(size, one)
    for axis in range(3):
        place = builder.add(at, builder.mul(stride, ir.Constant(I64, axis)))
        scaled = builder.fmul(builder.load(vector_at(builder, array.data, place, _FLOATS), align=4), size)
        held = builder.select(builder.fcmp_ordered(">", scaled, none), scaled, none)
        held = builder.select(builder.fcmp_ordered("<", held, most), held, most)
        index = builder.fptosi(held, _INTS)
        position = builder.fsub(scaled, builder.sitofp(index, _FLOATS))
        yield index, position, builder.fsub(one, position)


def _store(builder: ir.IRBuilder, values: list[ir.Value], data: ir.Value, k: ir.Value) -> None:
    """values[corner] at data[corner * BLOCK + k] and on."""
    for corner, value in enumerate(values):
        place = builder.add(k, ir.Constant(I64, BLOCK * corner))
        builder.store(value, vector_at(builder, data, place, value.type), align=4)


def _weights(builder: ir.IRBuilder, cells: list[Any]) -> list[ir.Value]:
    """Trilinear weights of the eight corners, x fastest."""
    (_, *xs), (_, *ys), (_, *zs) = cells
    flat = [builder.fmul(ys[1 - (c & 1)], zs[1 - (c >> 1)]) for c in range(4)]
    return [builder.fmul(xs[1 - (c & 1)], flat[c >> 1]) for c in range(8)]


@intrinsic
def plan_hashed(typing_context, u, at, resolution, mask, offset, rows, weights, k):  # type: ignore[no-untyped-def]
    """Fill rows and weights [corner * BLOCK + k + lane] of the corners (x fastest) around u[:, at + lane].

    u (3, n) lies in the unit cube. rows (uint32) are those of a hashed level that begins at row `offset` and has
    `mask` + 1; resolution is float32, mask and offset uint32.
    """

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        kinds = signature.args
        cells = list(_cells(context, builder, arguments[0], kinds[0], arguments[1], arguments[2]))
        hashes = []
        for (index, _, _), prime in zip(cells, (1, PRIME_Y, PRIME_Z), strict=True):
            low = builder.mul(index, _constant(prime))
            hashes.append((low, builder.add(low, _constant(prime))))
        mask, offset = in_all_lanes(builder, arguments[3], LANES), in_all_lanes(builder, arguments[4], LANES)
        values = []
        for c in range(8):
            mixed = builder.xor(hashes[0][c & 1], builder.xor(hashes[1][c >> 1 & 1], hashes[2][c >> 2]))
            values.append(builder.add(offset, builder.and_(mixed, mask)))
        _store(builder, values, data_of(context, builder, kinds[5], arguments[5]), arguments[7])
        _store(builder, _weights(builder, cells), data_of(context, builder, kinds[6], arguments[6]), arguments[7])
        return context.get_dummy_value()

    u32, i64 = types.uint32, types.int64
    return types.void(u, i64, types.float32, u32, u32, rows, weights, i64), generate


@intrinsic
def plan_dense(typing_context, u, at, resolution, side, offset, rows, weights, k):  # type: ignore[no-untyped-def]
    """As plan_hashed, of a dense level with `side` (uint32) entries along an axis."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        kinds = signature.args
        cells = list(_cells(context, builder, arguments[0], kinds[0], arguments[1], arguments[2]))
        side = arguments[3]
        strides = (ir.Constant(I32, 1), side, builder.mul(side, side))
        row = in_all_lanes(builder, arguments[4], LANES)
        for (index, _, _), stride in zip(cells, strides, strict=True):
            row = builder.add(row, builder.mul(index, in_all_lanes(builder, stride, LANES)))
        values = []
        for c in range(8):
            step = ir.Constant(I32, 0)
            for axis, stride in enumerate(strides):
                step = builder.add(step, stride) if c >> axis & 1 else step
            values.append(builder.add(row, in_all_lanes(builder, step, LANES)))
        _store(builder, values, data_of(context, builder, kinds[5], arguments[5]), arguments[7])
        _store(builder, _weights(builder, cells), data_of(context, builder, kinds[6], arguments[6]), arguments[7])
        return context.get_dummy_value()

    u32, i64 = types.uint32, types.int64
    return types.void(u, i64, types.float32, u32, u32, rows, weights, i64), generate
