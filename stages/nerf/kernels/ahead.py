"""Several rays, or several steps of one, looked up in the occupancy grid at once; uncontracted space."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from fieldpose.stages.nerf.kernels.vectors import CONTRACT, F32, I32, I64, data_of, in_all_lanes, vector_at

AHEAD = 8
"""Steps that are looked up at once."""
ABREAST = 16
"""Rays that leap at once."""


def _every(value: float, lanes: int) -> ir.Constant:
    return ir.Constant(ir.VectorType(F32, lanes), [float(value)] * lanes)


def _ints(value: int, lanes: int) -> ir.Constant:
    return ir.Constant(ir.VectorType(I32, lanes), [value] * lanes)


def _least(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> ir.Value:
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _most(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> ir.Value:
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


def _cell(builder: ir.IRBuilder, place: ir.Value, size: ir.Value) -> ir.Value:
    """Index of the cell at a place along an axis of `size` cells."""
    lanes = place.type.count
    held = _least(builder, _most(builder, place, _every(0, lanes)), builder.fsub(size, _every(1, lanes)))
    return builder.fptosi(held, ir.VectorType(I32, lanes))


def _flat(builder: ir.IRBuilder, places: list[ir.Value], size: ir.Value) -> ir.Value:
    """Flat index of the cells at places along the three axes."""
    x, y, z = (_cell(builder, place, size) for place in places)
    n = builder.fptosi(size, x.type)
    return builder.add(x, builder.mul(n, builder.add(y, builder.mul(n, z))))


def _bytes_at(builder: ir.IRBuilder, data: ir.Value, places: ir.Value) -> ir.Value:
    """data[places] as int32. Loads one by one: where there are instructions for it, they are no faster."""
    values = ir.Constant(places.type, ir.Undefined)
    for i in range(places.type.count):
        lane = ir.Constant(I32, i)
        byte = builder.load(builder.gep(data, [builder.extract_element(places, lane)]))
        values = builder.insert_element(values, builder.zext(byte, I32), lane)
    return values


def _bits_at(builder: ir.IRBuilder, data: ir.Value, places: ir.Value) -> ir.Value:
    """Whether the bits at these places are set."""
    lanes = places.type.count
    found = _bytes_at(builder, data, builder.lshr(places, _ints(3, lanes)))
    wanted = builder.shl(_ints(1, lanes), builder.and_(places, _ints(7, lanes)))
    return builder.icmp_unsigned("!=", builder.and_(found, wanted), _ints(0, lanes))


def _rounded(builder: ir.IRBuilder, way: str, value: ir.Value) -> ir.Value:
    name, kind = f"llvm.{way}.v{value.type.count}f32", ir.FunctionType(value.type, [value.type])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [value])


@intrinsic
def occupied_ahead(typing_context, bits, resolution, u0, u1, u2, d0, d1, d2):  # type: ignore[no-untyped-def]
    """Bit i is set where the cell at (u0, u1, u2) + i * (d0, d1, d2) in the unit cube is occupied, for i < AHEAD.

    bits as `Domain` has them, the rest float32.
    """

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> ir.Value:
        size = in_all_lanes(builder, arguments[1], AHEAD)
        steps = ir.Constant(ir.VectorType(F32, AHEAD), [float(i) for i in range(AHEAD)])
        places = []
        for u, d in zip(arguments[2:5], arguments[5:8], strict=True):
            way = builder.fmul(steps, in_all_lanes(builder, d, AHEAD), flags=CONTRACT)
            places.append(builder.fmul(builder.fadd(way, in_all_lanes(builder, u, AHEAD), flags=CONTRACT), size))
        flat = _flat(builder, places, size)
        data = data_of(context, builder, signature.args[0], arguments[0])
        return builder.zext(builder.bitcast(_bits_at(builder, data, flat), ir.IntType(AHEAD)), I64)

    f = types.float32
    return types.int64(bits, f, f, f, f, f, f, f), generate


@intrinsic
def leap(typing_context, bits, distance, cells, blocks, step, lines, t, far, alive, at):  # type: ignore[no-untyped-def]
    """Move living rays at..at + ABREAST by whole steps into the next occupied cell, or past their ends.

    bits and distance as `Domain` has them, of a grid with so many cells and blocks along each side; these and the step
    are float32.
    """

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> ir.Value:
        kinds, at, lanes = signature.args, arguments[9], ABREAST
        floats, bytes_ = ir.VectorType(F32, lanes), ir.VectorType(ir.IntType(8), lanes)
        bits, table, times, ends, flags = (data_of(context, builder, kinds[i], arguments[i]) for i in (0, 1, 6, 7, 8))
        fine, coarse, step = (in_all_lanes(builder, arguments[i], lanes) for i in (2, 3, 4))
        of_blocks = builder.fdiv(_every(2, lanes), step)
        of_cells = builder.fdiv(builder.fmul(of_blocks, coarse), fine)
        lines = context.make_array(kinds[5])(context, builder, arguments[5])
        stride = builder.extract_value(lines.shape, 1)
        starts = [builder.add(at, builder.mul(stride, ir.Constant(I64, i))) for i in range(9)]
        ways = [builder.load(vector_at(builder, lines.data, start, floats), align=4) for start in starts]
        end = builder.load(vector_at(builder, ends, at, floats), align=4)
        living = builder.load(vector_at(builder, flags, at, bytes_), align=1)
        living = builder.icmp_unsigned("!=", living, ir.Constant(bytes_, [0] * lanes))
        begun, before = builder.load(vector_at(builder, times, at, floats), align=4), builder.block
        look, move, done = (builder.append_basic_block(name) for name in ("look", "move", "done"))
        builder.branch(look)

        builder.position_at_end(look)
        now = builder.phi(floats)
        now.add_incoming(begun, before)
        places = []
        for o, d in zip(ways[:3], ways[3:6], strict=True):
            y = builder.fadd(o, builder.fmul(now, d, flags=CONTRACT), flags=CONTRACT)
            places.append(builder.fmul(builder.fadd(y, _every(1, lanes)), _every(0.5, lanes)))
        of_block = [builder.fmul(place, coarse) for place in places]
        of_cell = [builder.fmul(place, fine) for place in places]
        away = _bytes_at(builder, table, _flat(builder, of_block, coarse))
        empty = builder.icmp_unsigned("!=", away, _ints(0, lanes))
        occupied = _bits_at(builder, bits, _flat(builder, of_cell, fine))
        going = builder.and_(living, builder.fcmp_ordered("<", now, end))
        going = builder.and_(going, builder.not_(occupied))
        which = builder.bitcast(going, ir.IntType(lanes))
        builder.cbranch(builder.icmp_unsigned("!=", which, ir.Constant(which.type, 0)), move, done)

        builder.position_at_end(move)
        reach = builder.select(empty, builder.fsub(builder.sitofp(away, floats), _every(1, lanes)), _every(0, lanes))
        free = None
        for block, cell, inverse in zip(of_block, of_cell, ways[6:], strict=True):
            place = builder.select(empty, block, cell)
            index = _rounded(builder, "floor", place)
            low, high = builder.fsub(index, reach), builder.fadd(builder.fadd(index, _every(1, lanes)), reach)
            border = builder.select(builder.fcmp_ordered(">", inverse, _every(0, lanes)), high, low)
            along = builder.fmul(builder.fsub(border, place), inverse)
            free = along if free is None else _least(builder, free, along)
        free = builder.fmul(free, builder.select(empty, of_blocks, of_cells))
        steps = _most(builder, _rounded(builder, "ceil", free), _every(1, lanes))
        later = builder.fadd(now, builder.fmul(step, steps, flags=CONTRACT), flags=CONTRACT)
        now.add_incoming(builder.select(going, later, now), builder.block)
        builder.branch(look)

        builder.position_at_end(done)
        builder.store(now, vector_at(builder, times, at, floats), align=4)
        return context.get_dummy_value()

    f, i64 = types.float32, types.int64
    return types.void(bits, distance, f, f, f, lines, t, far, alive, i64), generate
