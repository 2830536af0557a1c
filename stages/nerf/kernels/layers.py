"""Layers of narrow networks: products with matrices that stay in the nearest cache.

BLAS packs its operands anew in every product, which costs as much as the product itself where layers are this narrow.
A block of rows is kept in vector registers instead, as large as the processor's registers hold.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from fieldpose.stages.nerf.kernels.inner import inner
from fieldpose.stages.nerf.kernels.vectors import COLUMNS, CONTRACT, F32, I64, in_all_lanes, supports, vector_at

ROWS = 16 if supports("avx512f") else 6
"""Rows of a block: together with what they are multiplied with, they fill the registers."""


def _block(rows: int, columns: int) -> Any:
    """The intrinsic that computes a block of so many rows and columns."""
    vector = ir.VectorType(F32, columns)
    none = ir.Constant(vector, [0.0] * columns)

    @intrinsic
    def block(typing_context, x, w, out, row, column, floor):  # type: ignore[no-untyped-def]
        """Of max(x @ w, floor), what is in row..row + rows and column..column + columns of out."""

        def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            given = [context.make_array(signature.args[i])(context, builder, arguments[i]) for i in range(3)]
            depth, width = (builder.extract_value(given[i].shape, 1) for i in (0, 1))
            lines = [builder.add(arguments[3], ir.Constant(I64, r)) for r in range(rows)]
            reads = [builder.gep(given[0].data, [builder.mul(line, depth)]) for line in lines]
            sums = [cgutils.alloca_once(builder, vector) for _ in range(rows)]
            for total in sums:
                builder.store(none, total)
            with cgutils.for_range(builder, depth) as loop:
                at = builder.add(builder.mul(loop.index, width), arguments[4])
                weights = builder.load(vector_at(builder, given[1].data, at, vector), align=4)
                for read, total in zip(reads, sums, strict=True):
                    value = in_all_lanes(builder, builder.load(builder.gep(read, [loop.index])), columns)
                    product = builder.fmul(value, weights, flags=CONTRACT)
                    builder.store(builder.fadd(builder.load(total), product, flags=CONTRACT), total)
            least = in_all_lanes(builder, arguments[5], columns)
            for line, total in zip(lines, sums, strict=True):
                value = builder.load(total)
                value = builder.select(builder.fcmp_unordered(">", value, least), value, least)
                at = builder.add(builder.mul(line, width), arguments[4])
                builder.store(value, vector_at(builder, given[2].data, at, vector), align=4)
            return context.get_dummy_value()

        return types.void(x, w, out, types.int64, types.int64, types.float32), generate

    return block


def _strip(columns: int) -> Any:
    """What computes so many columns of rows first..last."""
    block, line = _block(ROWS, columns), _block(1, columns)

    @inner
    def strip(
        x: np.ndarray, w: np.ndarray, floor: float, first: int, last: int, column: int, out: np.ndarray
    ) -> None:  # fmt: skip
        row = first
        while row + ROWS <= last:
            block(x, w, out, row, column, floor)
            row += ROWS
        if row < last and last - ROWS >= first:
            block(x, w, out, last - ROWS, column, floor)
        else:
            for r in range(row, last):
                line(x, w, out, r, column, floor)

    return strip


_wide, _thin = _strip(COLUMNS), _strip(1)


@inner
def layer(x: np.ndarray, w: np.ndarray, floor: float, first: int, last: int, out: np.ndarray) -> None:
    """out[first:last] = max(x[first:last] @ w, floor); a row does not depend on which others there are.

    Widths that are multiples of COLUMNS are fast.
    """
    whole = w.shape[1] // COLUMNS * COLUMNS
    for column in range(0, whole, COLUMNS):
        _wide(x, w, floor, first, last, column, out)
    for column in range(whole, w.shape[1]):
        _thin(x, w, floor, first, last, column, out)
