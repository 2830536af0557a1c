"""Numbers of the PnP stage that nobody has to turn.

Those of landmarks, of confirming poses and of covariances were found on recorded inputs of lego, the lamp and lego
learnt from ten images, with XFeat and with DISK; docs/evaluation.md has what they lead to.
"""

LEAST_ITERATIONS = 50
"""At least so many."""
CONFIDENCE = 0.999
"""RANSAC stops when a better pose would have been seen with this probability."""
MIN_SPREAD = 0.01
"""Inliers must extend at least this share of the image's longer side across their narrowest direction (std)."""
CONFIDENCE_POWER = 2.0
"""Squared errors are weighted by the matches' confidence to this power; 0: all the same."""
SHARED_ERROR = 0.6
"""How far neighbouring matches err together, as a multiple of the inliers' residuals; found on several scenes."""
SHARED_ERROR_BY_ANGLE = 0.8
"""What is added to it for each radian between the directions of view: what is seen from elsewhere looks different
in ways that neighbours have in common."""
ALIGN_HALF = 4
"""A patch has this many samples to either side of its middle."""
ALIGN_STEPS = 8
"""At most so many steps to find a patch."""
ALIGN_SIMILARITY = 0.75
"""Patches that correlate less are not found."""
ALIGN_FLOOR_PX = 0.02
"""No patch is found more exactly, in pixels of the view; with little texture it is as much less exact, and in the
direction, as its grey values say."""
ALIGN_PX = 1.5
"""Largest reprojection error of a point that was found, in pixels of the view."""
ALIGN_SPREAD = 0.63
"""Largest root mean square of the errors of what was found, as a share of align_px: points that are found by
chance lie anywhere, which makes it 0.71."""
MIN_UNALIGNED = 0.3
"""Least share of matches that agree on a pose which no search in the frame bears out, as where that is blurred."""
MIN_SUPPORT = 0.15
"""Where a smaller share of the points is found in the frame, the matches that agreed may be wrong: others are
asked for another pose."""
MIN_LANDMARKS = 0.08
"""Where a smaller share of the landmarks is found in the frame, it bears nothing out: so many are by chance."""
SURE_LANDMARKS = 0.3
"""Where a smaller share of them is, another pose is looked for, and the one with more points found is it."""
ATTEMPTS = 3
"""So many poses are looked at, at most."""
UNCONFIRMED_SHARE = 0.5
"""Of min_inlier_ratio is enough for a pose that is then confirmed by points found in the frame."""
