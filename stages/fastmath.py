"""What compiled kernels may assume of numbers."""

FASTMATH = {"contract", "reassoc", "nsz", "arcp"}
"""Sums may be taken in any order; NaN and infinity keep their meaning."""
