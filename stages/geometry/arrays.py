"""Shapes and dtypes of the arrays that the stages work on, by name.

Tests check them at every call of the modules that tests/conftest.py lists; nothing does outside of tests.
A number at the end of a name is that of the bits, where these are promised. Sizes that have the same letter are the
same within a signature and within a dataclass: n pixels belong to n points.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Integer, Real, UInt8

Vector = Float[np.ndarray, "3"]
Matrix3 = Float64[np.ndarray, "3 3"]
Matrix6 = Float64[np.ndarray, "6 6"]
Transform = Float64[np.ndarray, "4 4"]
Transforms = Float64[np.ndarray, "n 4 4"]
Twist = Float64[np.ndarray, "6"]
"""Translation, then rotation."""
Covariance = Matrix6
"""Of the left twist of a pose."""

Pixels = Real[np.ndarray, "n 2"]
"""x and y; whole numbers or not."""
Pixels32 = Float32[np.ndarray, "n 2"]
Pixels64 = Float64[np.ndarray, "n 2"]
Normalised = Float64[np.ndarray, "n 2"]
"""Points of an image of focal length 1."""
Points = Float[np.ndarray, "n 3"]
Points32 = Float32[np.ndarray, "n 3"]
Points64 = Float64[np.ndarray, "n 3"]
Directions32 = Float32[np.ndarray, "n 3"]
Colours32 = Float32[np.ndarray, "n 3"]
"""0 to 1."""
Values = Float[np.ndarray, "n"]
Values32 = Float32[np.ndarray, "n"]
Flags = Bool[np.ndarray, "n"]
Indices = Integer[np.ndarray, "n"]
Matrices2 = Float64[np.ndarray, "n 2 2"]
Jacobians = Float[np.ndarray, "n k 6"]
"""Derivatives of k numbers of each of n, by a twist or by the origin and direction of a ray."""
Jacobians2 = Float[np.ndarray, "n 2 6"]

Image = UInt8[np.ndarray, "h w 3"]
"""RGB."""
FrameImage = UInt8[np.ndarray, "frame_h frame_w 3"]
"""RGB, beside an image of another size."""
Grey = UInt8[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]
Depth = Float32[np.ndarray, "h w"]
"""Along the optical axis; 0 where no surface is."""
Opacity = Float32[np.ndarray, "h w"]
"""0 to 1."""
AnyOpacity = Float[np.ndarray, "h w"] | Grey
"""0 to 1, or to 255 in bytes."""
