"""Numbers of the search for patches; found on recorded inputs of lego, the lamp and lego learnt from ten images."""

HALF = 4
"""A patch has this many samples to either side of its middle."""
STEPS = 8
"""At most so many steps to find a patch."""
SIMILARITY = 0.75
"""Patches that correlate less are not found."""
FLOOR_PX = 0.02
"""No patch is found more exactly, in pixels of the view; with little texture it is as much less exact, and in the
direction, as its grey values say."""
FOUND_PX = 1.5
"""Largest reprojection error of a point that was found, in pixels of the view."""
