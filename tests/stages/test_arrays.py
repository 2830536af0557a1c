"""Arrays of another shape or dtype than a signature tells of are found wherever tests pass them."""

from collections.abc import Callable

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from fieldpose.bus.messages import GuessReason
from fieldpose.stages.alignment.landmarks import landmarks
from fieldpose.stages.geometry import Camera, points_at_depth, rays
from fieldpose.stages.lifting.core import depth_at
from fieldpose.stages.matching.core import visible_mask
from fieldpose.stages.nerf.rendering_api import RenderedView
from fieldpose.stages.pnp.aligner import Pictures
from fieldpose.stages.pnp.consensus import agreed_pose
from fieldpose.stages.pnp.core import PnpConfig, solve
from fieldpose.stages.refinement.core import RefinementResult
from fieldpose.stages.refinement.photometric import keypoint_region
from fieldpose.stages.rendering.core import ViewSource
from fieldpose.stages.retrieval.core import Ranking
from fieldpose.stages.tracking.policy import PoseGuess

CAMERA, POSE = Camera(6, 4, 5.0, 5.0, 2.5, 1.5), np.eye(4)
PIXELS, POINTS, DEPTH, RGB = np.zeros((5, 2)), np.ones((5, 3)), np.ones((4, 6), np.float32), np.zeros((4, 6, 3), "u1")
PICTURES = Pictures(RGB, DEPTH, CAMERA, POSE, np.zeros((8, 9, 3), np.uint8))


class Unasked:
    """A renderer that is never asked."""


WRONG: dict[str, Callable[[], object]] = {
    "a pose without its last row": lambda: rays(CAMERA, POSE[:3]),
    "a pose in float32": lambda: rays(CAMERA, POSE.astype(np.float32)),
    "more depths than pixels": lambda: points_at_depth(CAMERA, POSE, PIXELS, np.ones(6)),
    "pixels as columns": lambda: depth_at(DEPTH, PIXELS.T, 0.1),
    "the mask of a picture in colour": lambda: visible_mask(RGB, 0),
    "a depth turned on its side": lambda: RenderedView(RGB, DEPTH.T, DEPTH, CAMERA, POSE),
    "a frame in floating point": lambda: Pictures(RGB, DEPTH, CAMERA, POSE, RGB.astype(np.float32)),
    "a weight for each coordinate": lambda: agreed_pose(PIXELS, POINTS, CAMERA, PIXELS, PnpConfig()),
    "fewer points than pixels": lambda: solve(PIXELS, POINTS[1:], CAMERA),
    "a pose as a twist": lambda: RefinementResult(np.zeros(6), False, None, None, 0),
    "pixels with a depth": lambda: keypoint_region(POINTS, CAMERA, 1),
    "a guess as a list": lambda: ViewSource(Unasked()).view(CAMERA, POSE.tolist()),  # type: ignore[arg-type]
    "places for similarities": lambda: Ranking(np.arange(5), np.arange(5)),
    "several guesses": lambda: PoseGuess(GuessReason.PRIOR, POSE[None]),
}


@pytest.mark.parametrize("call", WRONG.values(), ids=WRONG)
def test_a_wrong_array_is_refused(call: Callable[[], object]) -> None:
    with pytest.raises(TypeCheckError):
        call()


def test_right_arrays_are_taken() -> None:
    assert landmarks(PICTURES.grey, DEPTH, CAMERA, POSE, 0).shape == (0, 3)
    assert points_at_depth(CAMERA, POSE, PIXELS, np.ones(5)).shape == (5, 3)


def test_a_wrong_answer_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldpose.stages.alignment.landmarks.points_at_depth", lambda *_: np.zeros((3, 2)))
    with pytest.raises(TypeCheckError, match="return value"):
        landmarks(PICTURES.grey, DEPTH, CAMERA, POSE, 0)
