"""How the functions that kernels are made of are compiled."""

from __future__ import annotations

from numba import njit

from fieldpose.stages.fastmath import FASTMATH

inner = njit(nogil=True, fastmath=FASTMATH, _nrt=False)
"""For functions that make no arrays of their own, but views of those that they are given.

Otherwise a call counts the references to every array of the named tuples that it is given, some fifty of them, up and down
by atomic instructions: half a microsecond, as long as four samples take.
"""
