"""Eight rays, or eight steps of one, looked up in the occupancy grid at once; uncontracted space."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from fieldpose.stages.nerf.kernels.vectors import CONTRACT, F32, I32, I64, data_of, in_all_lanes, vector_at

AHEAD = 8
_FLOATS, _INTS, _BYTES = (ir.VectorType(kind, AHEAD) for kind in (F32, I32, ir.IntType(8)))


def _all(value: float) -> ir.Constant:
    return ir.Constant(_FLOATS, [float(value)] * AHEAD)


def _least(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> ir.Value:
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _most(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> ir.Value:
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


def _cell(builder: ir.IRBuilder, place: ir.Value, size: ir.Value) -> ir.Value:
    """Index of the cell at a place along an axis of `size` cells."""
    return builder.fptosi(_least(builder, _most(builder, place, _all(0)), builder.fsub(size, _all(1))), _INTS)


def _flat(builder: ir.IRBuilder, cells: list[ir.Value], size: ir.Value) -> ir.Value:
    x, y, z = cells
    n = builder.fptosi(size, _INTS)
    return builder.add(x, builder.mul(n, builder.add(y, builder.mul(n, z))))


def _bytes_at(builder: ir.IRBuilder, data: ir.Value, places: ir.Value) -> ir.Value:
    """data[places] as int32. Loads one by one: where there are instructions for it, they are no faster."""
    values = ir.Constant(_INTS, ir.Undefined)
    for i in range(AHEAD):
        lane = ir.Constant(I32, i)
        byte = builder.load(builder.gep(data, [builder.extract_element(places, lane)]))
        values = builder.insert_element(values, builder.zext(byte, I32), lane)
    return values


def _rounded(builder: ir.IRBuilder, name: str, value: ir.Value) -> ir.Value:
    kind = ir.FunctionType(_FLOATS, [_FLOATS])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{AHEAD}f32"), [value])


def _indices(builder: ir.IRBuilder, u: ir.Value, change: ir.Value, size: ir.Value) -> ir.Value:
    """Of the cells along an axis."""
    steps = ir.Constant(_FLOATS, [float(i) for i in range(AHEAD)])
    way = builder.fmul(steps, in_all_lanes(builder, change, AHEAD), flags=CONTRACT)
    place = builder.fmul(builder.fadd(way, in_all_lanes(builder, u, AHEAD), flags=CONTRACT), size)
    return _cell(builder, place, size)


@intrinsic
def occupied_ahead(typing_context, bits, resolution, u0, u1, u2, d0, d1, d2):  # type: ignore[no-untyped-def]
    """Bit i is set where the cell at (u0, u1, u2) + i * (d0, d1, d2) in the unit cube is occupied, for i < AHEAD.

    bits as `Domain` has them, the rest float32.
    """

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> ir.Value:
        size = in_all_lanes(builder, arguments[1], AHEAD)
        cells = [_indices(builder, arguments[2 + a], arguments[5 + a], size) for a in range(3)]
        flat = _flat(builder, cells, size)
        data = data_of(context, builder, signature.args[0], arguments[0])
        words = _bytes_at(builder, data, builder.lshr(flat, ir.Constant(_INTS, [3] * AHEAD)))
        shift = builder.and_(flat, ir.Constant(_INTS, [7] * AHEAD))
        wanted = builder.shl(ir.Constant(_INTS, [1] * AHEAD), shift)
        found = builder.icmp_unsigned("!=", builder.and_(words, wanted), ir.Constant(_INTS, [0] * AHEAD))
        return builder.zext(builder.bitcast(found, ir.IntType(AHEAD)), ir.IntType(64))

    f = types.float32
    return types.int64(bits, f, f, f, f, f, f, f), generate


@intrinsic
def leap(typing_context, distance, blocks, step, lines, t, far, alive, at):  # type: ignore[no-untyped-def]
    """Move living rays at..at + AHEAD by whole steps to where a block with an occupied cell is, or past their ends.

    distance as `Domain` has it, of a grid with `blocks` blocks along each side; blocks and step float32.
    """

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> ir.Value:
        kinds, at = signature.args, arguments[7]
        table = data_of(context, builder, kinds[0], arguments[0])
        size, step = (in_all_lanes(builder, arguments[i], AHEAD) for i in (1, 2))
        lines = context.make_array(kinds[3])(context, builder, arguments[3])
        stride = builder.extract_value(lines.shape, 1)
        ways = []
        for i in range(9):
            place = builder.add(at, builder.mul(stride, ir.Constant(I64, i)))
            ways.append(builder.load(vector_at(builder, lines.data, place, _FLOATS), align=4))
        times = vector_at(builder, data_of(context, builder, kinds[4], arguments[4]), at, _FLOATS)
        ends = builder.load(vector_at(builder, data_of(context, builder, kinds[5], arguments[5]), at, _FLOATS), align=4)
        flags = vector_at(builder, data_of(context, builder, kinds[6], arguments[6]), at, _BYTES)
        living = builder.icmp_unsigned("!=", builder.load(flags, align=1), ir.Constant(_BYTES, [0] * AHEAD))
        look, move, done = (builder.append_basic_block(name) for name in ("look", "move", "done"))
        begun, before = builder.load(times, align=4), builder.block
        builder.branch(look)
        builder.position_at_end(look)
        now = builder.phi(_FLOATS)
        now.add_incoming(begun, before)
        places = []
        for o, d in zip(ways[:3], ways[3:6], strict=True):
            y = builder.fadd(o, builder.fmul(now, d, flags=CONTRACT), flags=CONTRACT)
            places.append(builder.fmul(builder.fmul(builder.fadd(y, _all(1)), _all(0.5)), size))
        empty = _bytes_at(builder, table, _flat(builder, [_cell(builder, p, size) for p in places], size))
        going = builder.and_(living, builder.fcmp_ordered("<", now, ends))
        going = builder.and_(going, builder.icmp_unsigned("!=", empty, ir.Constant(_INTS, [0] * AHEAD)))
        some = builder.icmp_unsigned("!=", builder.bitcast(going, ir.IntType(AHEAD)), ir.Constant(ir.IntType(AHEAD), 0))
        builder.cbranch(some, move, done)
        builder.position_at_end(move)
        reach = builder.fsub(builder.sitofp(empty, _FLOATS), _all(1))
        free = None
        for place, inverse in zip(places, ways[6:], strict=True):
            index = _rounded(builder, "floor", place)
            low, high = builder.fsub(index, reach), builder.fadd(builder.fadd(index, _all(1)), reach)
            border = builder.select(builder.fcmp_ordered(">", inverse, _all(0)), high, low)
            axis = builder.fmul(builder.fmul(builder.fsub(border, place), _all(2)), inverse)
            free = axis if free is None else _least(builder, free, axis)
        steps = _most(builder, _rounded(builder, "ceil", builder.fdiv(free, step)), _all(1))
        later = builder.fadd(now, builder.fmul(step, steps, flags=CONTRACT), flags=CONTRACT)
        now.add_incoming(builder.select(going, later, now), builder.block)
        builder.branch(look)
        builder.position_at_end(done)
        builder.store(now, times, align=4)
        return context.get_dummy_value()

    f, i64 = types.float32, types.int64
    return types.void(distance, f, f, lines, t, far, alive, i64), generate
