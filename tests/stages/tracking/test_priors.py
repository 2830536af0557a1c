"""Guesses from outside: kept by frame, the newest of those that came, and all of those that were given."""

from __future__ import annotations

from support.tracking_world import on_sphere

from fieldpose.stages.tracking.priors import Priors


def test_a_prior_belongs_to_its_frame() -> None:
    priors = Priors()
    priors.add(3, pose := on_sphere(3, 0))
    assert priors.take(4) is None
    assert priors.take(3) is pose
    assert priors.take(3) is None
    assert not priors.awaited


def test_one_that_comes_replaces_the_one_before_and_the_one_given() -> None:
    priors = Priors(awaited=True, given={3: (given := on_sphere(0, 0))})
    assert priors.awaited
    assert priors.take(3) is given
    for pose in (on_sphere(1, 0), on_sphere(2, 0)):
        priors.add(3, pose)
        assert priors.take(3) is pose


def test_the_newest_are_kept_and_those_given_stay() -> None:
    priors = Priors(given={0: (given := on_sphere(0, 0))})
    for frame_id in range(1000):
        priors.add(frame_id, on_sphere(frame_id, 0))
    known = [frame_id for frame_id in range(1, 1000) if priors.take(frame_id) is not None]
    assert known == list(range(1000 - len(known), 1000))
    assert 64 <= len(known) < 1000
    assert priors.take(0) is given


def test_looking_at_a_prior_leaves_it_for_its_frame() -> None:
    priors = Priors(given={3: (given := on_sphere(0, 0))})
    assert priors.peek(4) is None
    assert priors.peek(3) is given
    priors.add(3, pose := on_sphere(1, 0))
    assert priors.peek(3) is pose
    assert priors.peek(3) is pose
    assert priors.take(3) is pose
    assert priors.peek(3) is given
