"""Layers of narrow networks: products with matrices that stay in the nearest cache.

BLAS packs its operands anew in every product, which costs as much as the product itself where layers are this narrow.
A block of rows is kept in vector registers instead, as large as the processor's registers hold.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from fieldpose.stages.fastmath import FASTMATH
from fieldpose.stages.nerf.kernels.vectors import (
    COLUMNS,
    CONTRACT,
    F32,
    I64,
    in_all_lanes,
    supports,
    vector_at,
)

ROWS = 16 if supports("avx512f") else 6
"""Rows of a block: together with what they are multiplied with, they fill the registers."""

_VECTOR = ir.VectorType(F32, COLUMNS)


def _block(rows: int) -> Any:
    """The intrinsic that computes a block of `rows` rows and COLUMNS columns."""

    @intrinsic
    def block(typing_context, x, w, out, row, column, floor):  # type: ignore[no-untyped-def]
        """out[row:row + rows, column:column + COLUMNS] = max(x[row:row + rows] @ w[:, column:column + COLUMNS], floor)."""

        def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            arrays = [context.make_array(kind)(context, builder, a) for kind, a in zip(signature.args[:3], arguments[:3])]
            inner, width = (builder.extract_value(arrays[i].shape, 1) for i in (0, 1))
            row, column, floor = arguments[3:]
            lines = [builder.gep(arrays[0].data, [builder.mul(builder.add(row, ir.Constant(I64, r)), inner)]) for r in range(rows)]
            sums = [cgutils.alloca_once_value(builder, ir.Constant(_VECTOR, [0.0] * COLUMNS)) for _ in range(rows)]
            for total in sums:
                builder.store(ir.Constant(_VECTOR, [0.0] * COLUMNS), total)
            with cgutils.for_range(builder, inner) as loop:
                at = builder.add(builder.mul(loop.index, width), column)
                weights = builder.load(vector_at(builder, arrays[1].data, at, _VECTOR), align=4)
                for line, total in zip(lines, sums, strict=True):
                    value = in_all_lanes(builder, builder.load(builder.gep(line, [loop.index])), COLUMNS)
                    product = builder.fmul(value, weights, flags=CONTRACT)
                    builder.store(builder.fadd(builder.load(total), product, flags=CONTRACT), total)
            least = in_all_lanes(builder, floor, COLUMNS)
            for r, total in enumerate(sums):
                value = builder.load(total)
                value = builder.select(builder.fcmp_unordered(">", value, least), value, least)
                at = builder.add(builder.mul(builder.add(row, ir.Constant(I64, r)), width), column)
                builder.store(value, vector_at(builder, arrays[2].data, at, _VECTOR), align=4)
            return context.get_dummy_value()

        return types.void(x, w, out, types.int64, types.int64, types.float32), generate

    return block


_rows, _row = _block(ROWS), _block(1)


@njit(nogil=True, fastmath=FASTMATH)
def layer(x: np.ndarray, w: np.ndarray, floor: float, first: int, last: int, out: np.ndarray) -> None:
    """out[first:last] = max(x[first:last] @ w, floor); a row does not depend on which others there are."""
    if w.shape[1] % COLUMNS != 0:
        np.dot(x[first:last], w, out[first:last])
        for r in range(first, last):
            for c in range(w.shape[1]):
                out[r, c] = max(out[r, c], floor)
        return
    for column in range(0, w.shape[1], COLUMNS):
        row = first
        while row + ROWS <= last:
            _rows(x, w, out, row, column, floor)
            row += ROWS
        if row < last and last - ROWS >= first:
            _rows(x, w, out, last - ROWS, column, floor)
        else:
            for r in range(row, last):
                _row(x, w, out, r, column, floor)
