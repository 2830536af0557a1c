"""Marching cubes on parts of a grid, whose pieces fit together.

Sources: Lorensen and Cline, Marching cubes (SIGGRAPH 1987). The table is made here, by cutting off the inside corners
of every face, each by itself: what a face shows then depends on its own corners alone, so that neighbouring cells fit
and the surface is closed wherever the values are known.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

_CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])
_EDGES = [(c, c | 1 << axis, axis) for axis in range(3) for c in range(8) if not c >> axis & 1]
EDGE_START = np.array([_CORNERS[low] for low, _, _ in _EDGES])
"""The lower corner (x, y, z) of each of a cell's 12 edges."""
EDGE_AXIS = np.array([axis for _, _, axis in _EDGES])
_EDGE_OF = {frozenset((low, high)): i for i, (low, high, _) in enumerate(_EDGES)}
_FACES = ((4, 6, 2, 0), (3, 7, 5, 1), (1, 5, 4, 0), (6, 7, 3, 2), (2, 3, 1, 0), (5, 7, 6, 4))
"""Corners of each face, counterclockwise as seen from outside."""
_AWAY_FROM_CORNERS = 1e-3
"""Of an edge: vertices keep so far from the corners, lest triangles have no area."""
_Loop = list[int]


@dataclass(frozen=True)
class Piece:
    """Triangles (m, 3) int64 of rows of keys (k,) int64 and vertices (k, 3) float64; pieces share vertices by key.

    Vertices are in cells from the whole grid's first node; a key is 3 * the flat index of an edge's lower node + axis.
    """

    keys: np.ndarray
    vertices: np.ndarray
    triangles: np.ndarray


def isosurface(values: np.ndarray, known: np.ndarray, starts: np.ndarray, shape: tuple[int, int, int]) -> Piece:
    """Where values cross 0 in blocks of nodes of a grid, with the outside of triangles towards positive values.

    values (b, n, n, n) float32, [block, z, y, x]; known, the same shape, bool: cells with an unknown corner have no
    surface. starts (b, 3) int64: x, y, z of each block's first node in the grid; shape: the grid's nodes along x, y, z.
    """
    block, z, y, x, case = _crossed(values, known)
    count, triangles = _table()
    cell = np.repeat(np.arange(len(case)), count[case])
    which = np.arange(len(cell)) - np.repeat(np.cumsum(count[case]) - count[case], count[case])
    edges = triangles[case[cell], which].astype(np.int64)
    node = np.stack([x, y, z], axis=1)[cell, None] + EDGE_START[edges]
    axis, inside = EDGE_AXIS[edges], np.repeat(block[cell, None], 3, axis=1)
    at = node + starts[inside]
    keys = 3 * (at[..., 0] + shape[0] * (at[..., 1] + shape[1] * at[..., 2])) + axis
    unique, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    chosen = (inside.ravel()[first], node.reshape(-1, 3)[first], axis.ravel()[first])
    return Piece(unique, at.reshape(-1, 3)[first] + _along(values, *chosen), inverse.reshape(-1, 3))


def joined(pieces: list[Piece]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) float64 and triangles (m, 3) int64 of all pieces, each key once."""
    if not pieces:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    keys = np.concatenate([piece.keys for piece in pieces])
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    ends = np.cumsum([0, *(len(piece.keys) for piece in pieces)])
    triangles = [inverse[start + piece.triangles] for piece, start in zip(pieces, ends[:-1], strict=True)]
    return np.concatenate([piece.vertices for piece in pieces])[first], np.concatenate(triangles)


def _crossed(values: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, ...]:
    """Block, z, y, x and case of the cells that the surface passes through."""
    n = values.shape[1] - 1
    inside = (values < 0).view(np.uint8)
    case, whole = np.zeros((len(values), n, n, n), np.uint8), np.ones((len(values), n, n, n), bool)
    for corner, (x, y, z) in enumerate(_CORNERS):
        part = (slice(None), slice(z, z + n), slice(y, y + n), slice(x, x + n))
        case |= inside[part] << np.uint8(corner)
        whole &= known[part]
    found = np.nonzero(whole & (case != 0) & (case != 255))
    return (*found, case[found])


def _along(values: np.ndarray, block: np.ndarray, node: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """How far from each edge's lower node (k, 3) the surface crosses it."""
    step = np.eye(3, dtype=np.int64)[axis]
    x, y, z = node.T
    beyond = (block, z + step[:, 2], y + step[:, 1], x + step[:, 0])
    low, high = values[block, z, y, x].astype(np.float64), values[beyond].astype(np.float64)
    share = np.clip(low / (low - high), _AWAY_FROM_CORNERS, 1 - _AWAY_FROM_CORNERS)
    along: np.ndarray = step * share[:, None]
    return along


@cache
def _table() -> tuple[np.ndarray, np.ndarray]:
    """How many triangles each of the 256 cases has, and their edges (256, most, 3)."""
    cases = [[t for loop in _loops(case) for t in _triangles(loop)] for case in range(256)]
    table = np.zeros((256, max(map(len, cases)), 3), np.int8)
    for case, triangles in enumerate(cases):
        table[case, : len(triangles)] = np.reshape(triangles, (-1, 3))
    return np.array([len(triangles) for triangles in cases]), table


def _loops(case: int) -> list[_Loop]:
    """The closed lines of crossed edges around a cell whose inside corners are the bits of `case`."""
    following = {start: end for face in _FACES for start, end in _segments(face, case)}
    loops: list[_Loop] = []
    while following:
        loop = [next(iter(following))]
        while (edge := following.pop(loop[-1])) != loop[0]:
            loop.append(edge)
        loops.append(loop)
    return loops


def _segments(face: tuple[int, ...], case: int) -> list[tuple[int, int]]:
    """Lines across a face from edge to edge, each around one run of inside corners."""
    around = list(pairwise((*face, face[0])))
    enter = [i for i, (a, b) in enumerate(around) if not case >> a & 1 and case >> b & 1]
    leave = [i for i, (a, b) in enumerate(around) if case >> a & 1 and not case >> b & 1]
    segments = []
    for i in enter:
        end = min(leave, key=lambda j: (j - i) % 4)
        segments.append((_EDGE_OF[frozenset(around[i])], _EDGE_OF[frozenset(around[end])]))
    return segments


def _triangles(loop: _Loop) -> list[tuple[int, int, int]]:
    """A loop as a fan, from where as few of its diagonals as can be lie in a face, where a neighbour has its own."""
    turns = [loop[i:] + loop[:i] for i in range(len(loop))]
    first, *others = min(turns, key=lambda turn: sum(_share_a_face(turn[0], other) for other in turn[2:-1]))
    return [(first, a, b) for a, b in pairwise(others)]


def _share_a_face(edge: int, other: int) -> bool:
    corners = {*_EDGES[edge][:2], *_EDGES[other][:2]}
    return any(corners <= set(face) for face in _FACES)
