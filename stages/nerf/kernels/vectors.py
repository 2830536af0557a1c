"""Vectors that the compiler does not find by itself: a table's row is one of four features.

Tables are float32, or the bits of float16 as uint16, which are read as such and computed with as float32.
"""

from __future__ import annotations

from typing import Any

import numba
from llvmlite import binding, ir
from numba import types
from numba.extending import intrinsic

WIDTH = 4
COLUMNS = 16
"""Of a layer of a network, that are computed at once."""
TOGETHER = 4
"""Samples that are encoded at once."""
BLOCK = 64
"""Samples that a plan is made for at once; see `encoding.plan`."""

F32, I32, I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
CONTRACT = ("contract",)
_V4 = ir.VectorType(F32, WIDTH)


def supports(feature: str) -> bool:
    """Whether kernels are compiled for a processor with this feature, by LLVM's name."""
    if numba.config.CPU_FEATURES is not None:
        return f"+{feature}" in numba.config.CPU_FEATURES.split(",")
    return bool(binding.get_host_cpu_features().get(feature, False))


def reads_half_floats() -> bool:
    """Whether this processor turns float16 into float32 by itself."""
    return binding.get_host_cpu_features().get("f16c", True)


def data_of(context: Any, builder: ir.IRBuilder, kind: types.Array, array: ir.Value) -> ir.Value:
    """Pointer to an array's first element."""
    return context.make_array(kind)(context, builder, array).data


def in_all_lanes(builder: ir.IRBuilder, value: ir.Value, lanes: int) -> ir.Value:
    """A vector that has a scalar in every lane."""
    kind = ir.VectorType(value.type, lanes)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(I32, 0))
    return builder.shuffle_vector(
        first, ir.Constant(kind, ir.Undefined), ir.Constant(ir.VectorType(I32, lanes), [0] * lanes)
    )


def vector_at(builder: ir.IRBuilder, data: ir.Value, at: ir.Value, kind: ir.VectorType) -> ir.Value:
    """Pointer to the elements from data[at] on, as a vector of this kind."""
    return builder.bitcast(builder.gep(data, [at]), kind.as_pointer())


def _raw_row(builder: ir.IRBuilder, kind: types.Array, data: ir.Value, row: ir.Value) -> ir.Value:
    """Row `row` of a table (n, 4) as it is there."""
    half = kind.dtype == types.uint16
    element = ir.VectorType(ir.HalfType() if half else F32, WIDTH)
    return builder.load(builder.gep(builder.bitcast(data, element.as_pointer()), [row]), align=2 if half else 4)


def _as_floats(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """A vector of float16 or float32 as float32."""
    wide = ir.VectorType(F32, value.type.count)
    return value if value.type == wide else builder.fpext(value, wide)


def _joined(builder: ir.IRBuilder, parts: list[ir.Value]) -> ir.Value:
    """Vectors of one kind, a power of two of them, one behind the other."""
    while len(parts) > 1:
        lanes = ir.Constant(ir.VectorType(I32, 2 * parts[0].type.count), list(range(2 * parts[0].type.count)))
        parts = [builder.shuffle_vector(a, b, lanes) for a, b in zip(parts[::2], parts[1::2], strict=True)]
    return parts[0]


def _row(builder: ir.IRBuilder, kind: types.Array, data: ir.Value, row: ir.Value) -> ir.Value:
    """Row `row` of a table (n, 4) as four float32."""
    return _as_floats(builder, _raw_row(builder, kind, data, row))


def _planned(builder: ir.IRBuilder, rows: ir.Value, weights: ir.Value, s: ir.Value, corner: int) -> tuple[Any, Any]:
    """Table row and weight (in all four lanes) of a corner of sample s of the block."""
    at = builder.add(s, ir.Constant(I64, BLOCK * corner))
    row = builder.zext(builder.load(builder.gep(rows, [at])), I64)
    return row, in_all_lanes(builder, builder.load(builder.gep(weights, [at])), WIDTH)


def _blend(together: int) -> Any:
    """The intrinsic that encodes so many samples in a level."""
    kind = ir.VectorType(F32, WIDTH * together)
    of_lane = ir.Constant(ir.VectorType(I32, WIDTH * together), [i // WIDTH for i in range(WIDTH * together)])

    @intrinsic
    def blend(typing_context, table, rows, weights, s, x, at, stride):  # type: ignore[no-untyped-def]
        """x[at:at + 4] (x flat) = sum over the eight corners c of weights[c, s] * table[rows[c, s]].

        So for each of `together` samples; their places in x are `stride` apart.
        """

        def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            data = [data_of(context, builder, signature.args[i], arguments[i]) for i in (0, 1, 2, 4)]
            several = ir.VectorType(F32, together)
            total = None
            for corner in range(8):
                first = builder.add(arguments[3], ir.Constant(I64, BLOCK * corner))
                loaded = []
                for i in range(together):
                    place = builder.add(first, ir.Constant(I64, i))
                    row = builder.zext(builder.load(builder.gep(data[1], [place])), I64)
                    loaded.append(_raw_row(builder, signature.args[0], data[0], row))
                values = _as_floats(builder, _joined(builder, loaded))
                weight = builder.load(vector_at(builder, data[2], first, several), align=4)
                weight = builder.shuffle_vector(weight, ir.Constant(several, ir.Undefined), of_lane)
                part = builder.fmul(weight, values, flags=CONTRACT)
                total = part if total is None else builder.fadd(part, total, flags=CONTRACT)
            for i in range(together):
                lanes = ir.Constant(ir.VectorType(I32, WIDTH), [WIDTH * i + f for f in range(WIDTH)])
                part = builder.shuffle_vector(total, ir.Constant(kind, ir.Undefined), lanes)
                place = builder.add(arguments[5], builder.mul(arguments[6], ir.Constant(I64, i)))
                builder.store(part, vector_at(builder, data[3], place, _V4), align=4)
            return context.get_dummy_value()

        return types.void(table, rows, weights, s, x, at, types.int64), generate

    return blend


blend_one, blend_several = _blend(1), _blend(TOGETHER)


@intrinsic
def spread4(typing_context, dtable, rows, weights, s, dx, at):  # type: ignore[no-untyped-def]
    """dtable[rows[c, s]] += weights[c, s] * dx[at:at + 4] (dx flat), for the eight corners c."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        data = [data_of(context, builder, signature.args[i], arguments[i]) for i in (0, 1, 2, 4)]
        gradient = builder.load(vector_at(builder, data[3], arguments[5], _V4), align=4)
        table = builder.bitcast(data[0], _V4.as_pointer())
        for corner in range(8):
            row, weight = _planned(builder, data[1], data[2], arguments[3], corner)
            pointer = builder.gep(table, [row])
            part = builder.fmul(weight, gradient, flags=CONTRACT)
            builder.store(builder.fadd(part, builder.load(pointer, align=4), flags=CONTRACT), pointer, align=4)
        return context.get_dummy_value()

    return types.void(dtable, rows, weights, s, dx, at), generate


@intrinsic
def dot4(typing_context, table, row, dx, at):  # type: ignore[no-untyped-def]
    """Scalar product of table[row] and dx[at:at + 4] (dx flat)."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        left = _row(builder, table, data_of(context, builder, signature.args[0], arguments[0]), arguments[1])
        data = data_of(context, builder, signature.args[2], arguments[2])
        right = builder.load(vector_at(builder, data, arguments[3], _V4), align=4)
        product = builder.fmul(left, right, flags=CONTRACT)
        lanes = [builder.extract_element(product, ir.Constant(I32, i)) for i in range(WIDTH)]
        return builder.fadd(builder.fadd(lanes[0], lanes[1]), builder.fadd(lanes[2], lanes[3]))

    return types.float32(table, row, dx, at), generate


@intrinsic
def float_of_bits(typing_context, bits):  # type: ignore[no-untyped-def]
    """The float32 with these bits (int32)."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.bitcast(arguments[0], F32)

    return types.float32(types.int32), generate


@intrinsic
def add_row(typing_context, factor, source, at, target, to):  # type: ignore[no-untyped-def]
    """target[to:to + COLUMNS] += factor * source[at:at + COLUMNS] (both flat)."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        kinds = signature.args
        kind = ir.VectorType(F32, COLUMNS)
        read = vector_at(builder, data_of(context, builder, kinds[1], arguments[1]), arguments[2], kind)
        written = vector_at(builder, data_of(context, builder, kinds[3], arguments[3]), arguments[4], kind)
        part = builder.fmul(in_all_lanes(builder, arguments[0], COLUMNS), builder.load(read, align=4), flags=CONTRACT)
        builder.store(builder.fadd(part, builder.load(written, align=4), flags=CONTRACT), written, align=4)
        return context.get_dummy_value()

    return types.void(types.float32, source, types.int64, target, types.int64), generate


@intrinsic
def lowest_bit(typing_context, bits):  # type: ignore[no-untyped-def]
    """Index of the lowest bit that is set in an int64 other than 0."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), generate
