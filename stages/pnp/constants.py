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
ALIGN_SPREAD = 0.63
"""Largest root mean square of the errors of what was found, as a share of FOUND_PX: points that are found by
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
CONTRADICTIONS = 4
"""So many that the background contradicts, besides: a tenth more of the wires' poses are found than by one."""
CONTRADICTED, OFF_IT = 0.04, 0.3
"""Where a greater share of the object would lie on a frame's plain background and of what the frame shows would be
elsewhere, in the harmonic mean, a pose is wrong, and where more than the second lies on it, whatever else. Of wires
around a chequered ball, 250 pairs at each size, that refuses 42 of 43 wrong poses, turned by a square, at 400 pixels
and 35 of 38 at 256, and no right one; of lego learnt from ten images, whose field has shreds in the air, both wrong
ones and 6 of 138 right ones."""
NEAR_PX = 2
"""So far from anything else a pixel surely shows the background: poses and surfaces are a little wrong."""
PLAIN, PLAIN_BORDER = 10, 0.6
"""How far pixels of a plain background are from its colour, of 255; the share of the border that must be so near."""
DISTINCT = 60
"""Parts of the object that are nearer to that colour may look like it in another light."""
CELL_PX, LEAST_DISTINCT = 4, 20
"""One point of the object is asked for in each cell of that side; how many it takes."""
SPARSE_PX, EXPLAINS_PX = 2, 3
"""Of the points that explain what a frame shows: one in each cell of that side, and so far around it."""
UNCONFIRMED_SHARE = 0.5
"""Of min_inlier_ratio is enough for a pose that is then confirmed by points found in the frame."""
