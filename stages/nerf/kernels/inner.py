"""How the functions that kernels are made of are compiled."""

from __future__ import annotations

from numba import njit

from fieldpose.stages.fastmath import FASTMATH

inner = njit(nogil=True, fastmath=FASTMATH, _nrt=False)
"""For functions that make no arrays of their own, but views of those that they are given.

Otherwise a call counts the references to every array of the named tuples that it is given up and down, some fifty of
them, by atomic instructions: that takes as long as eight samples do.
"""
