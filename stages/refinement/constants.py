"""Numbers of the refinement stage that nobody has to turn."""

BLUR_PX = 1.0
"""Standard deviation of the blur under which the frame's slopes are taken; more reaches farther."""
LEARNING_RATE = 3e-3
"""Adam's, in radians and in shares of the distance to the surface."""
CONVERGED = 2e-5
"""A step that is smaller, in the same unit, is the last."""
SHARED_ERROR = 0.8
"""How far neighbouring pixels err together, as a multiple of their differences in colour."""
