"""From a perturbed guess to a pose, through the nodes of rendering, matching, lifting, pnp and refinement."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from support.analytic_scene import AnalyticScene, camera, viewpoint
from support.chain import frame_message, guess_message, run_chain

from fieldpose.bus.messages import Reason
from fieldpose.bus.topics import CORRESPONDENCES, ESTIMATE, FAILURE, FRAME, MATCHES, POSE, VIEW
from fieldpose.stages.geometry import perturb, rays, rotation_error_deg, translation_error
from fieldpose.stages.lifting.config import LiftingConfig
from fieldpose.stages.lifting.core import ConsistencyMemory
from fieldpose.stages.lifting.node import LiftingNode
from fieldpose.stages.matching.core import MatchingConfig, PairMatcher, build_matcher
from fieldpose.stages.matching.node import MatchingNode
from fieldpose.stages.pnp.config import PnpConfig
from fieldpose.stages.pnp.node import PnpNode
from fieldpose.stages.refinement.core import RefinementConfig
from fieldpose.stages.refinement.node import RefinementNode
from fieldpose.stages.rendering.config import RenderingConfig
from fieldpose.stages.rendering.core import ViewSource
from fieldpose.stages.rendering.node import RenderingNode
from fieldpose.stages.wire import FrameImages

LENS = camera(220, (-0.1, 0.02, 0.001, -0.001, 0.0))
POSE_TRUE = viewpoint(30.0, 40.0)


@pytest.fixture(scope="module")
def scene() -> AnalyticScene:
    return AnalyticScene()


@pytest.fixture(scope="module")
def image(scene: AnalyticScene) -> np.ndarray:
    rgb = scene.render_rays(*rays(LENS, POSE_TRUE)).rgb.reshape(LENS.height, LENS.width, 3)
    return np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)


@pytest.fixture
def make_nodes(scene: AnalyticScene) -> Callable[..., list[Any]]:
    def make(refinement: RefinementConfig | None = None, lifting: LiftingConfig | None = None) -> list[Any]:
        matching = MatchingConfig(matcher="sift")
        refining = refinement or RefinementConfig(samples=300, held_out=150)
        nodes = [
            RenderingNode(lambda: ViewSource(scene, RenderingConfig(size=220, reuse_angle_deg=5.0))),
            MatchingNode(lambda: PairMatcher(build_matcher(matching), matching), FrameImages(), 64),
            LiftingNode(lambda: scene, lifting or LiftingConfig(), ConsistencyMemory()),
            PnpNode(PnpConfig(), FrameImages()),
            RefinementNode(lambda: scene, refining, FrameImages()),
        ]
        for node in nodes:
            node.start()
        return nodes

    return make


@pytest.mark.parametrize("seed", [0, 1])
def test_a_perturbed_guess_leads_to_the_pose(make_nodes: Any, image: np.ndarray, seed: int) -> None:
    guess = perturb(POSE_TRUE, np.random.default_rng(seed), (10.0, 20.0), 0.2)
    said = run_chain(make_nodes(), frame_message(image, LENS), guess_message(guess, LENS))
    assert {VIEW, MATCHES, CORRESPONDENCES, ESTIMATE, POSE} <= said.keys()
    assert FAILURE not in said
    estimate, pose = said[ESTIMATE], said[POSE]
    assert rotation_error_deg(estimate.cam_from_object, POSE_TRUE) < 1.0
    assert rotation_error_deg(pose.cam_from_object, POSE_TRUE) < 0.2
    assert translation_error(pose.cam_from_object, POSE_TRUE) < 0.02
    assert pose.refined
    assert pose.loss_after < pose.loss_before
    assert pose.inliers <= pose.correspondences
    assert pose.correspondences > said[CORRESPONDENCES].kept.sum()
    np.testing.assert_array_equal(said[CORRESPONDENCES].view_cam_from_object, said[VIEW].cam_from_object)
    assert pose.header.frame_id == 1


def test_the_same_image_gets_the_same_pose_whatever_its_number(make_nodes: Any, image: np.ndarray) -> None:
    guess = perturb(POSE_TRUE, np.random.default_rng(2), (5.0, 10.0), 0.1)
    first, second = (
        run_chain(make_nodes(), frame_message(image, LENS, i), guess_message(guess, LENS, i))[POSE] for i in (1, 7)
    )
    assert np.array_equal(first.cam_from_object, second.cam_from_object)


def test_refinement_switched_off_hands_the_estimate_on_without_the_frame(make_nodes: Any, image: np.ndarray) -> None:
    nodes = make_nodes(RefinementConfig(steps=0))
    assert nodes[-1].inputs == (ESTIMATE,)
    said = run_chain(nodes, frame_message(image, LENS), guess_message(POSE_TRUE, LENS))
    assert np.array_equal(said[POSE].cam_from_object, said[ESTIMATE].cam_from_object)
    assert not said[POSE].refined


def test_without_its_pictures_a_pose_is_that_of_the_matches(make_nodes: Any, image: np.ndarray) -> None:
    """A view that came too late for pnp, or not at all, costs accuracy and no pose."""
    guess = perturb(POSE_TRUE, np.random.default_rng(0), (10.0, 15.0), 0.1)
    *before, pnp, _ = make_nodes()
    said = run_chain([*before, pnp], frame_message(image, LENS), guess_message(guess, LENS))
    assert pnp.inputs == (CORRESPONDENCES, VIEW, FRAME)
    blind = [*pnp.handle(FRAME, said[FRAME]), *pnp.handle(CORRESPONDENCES, said[CORRESPONDENCES]), *pnp.tick(2**62)]
    errors = [rotation_error_deg(found.cam_from_object, POSE_TRUE) for found in (said[ESTIMATE], blind[0][1])]
    assert errors[0] < 0.5 * errors[1] < 1.0


def failed(said: dict[Any, Any]) -> tuple[str, Reason]:
    """Who failed and why; nothing follows from a failure."""
    failure = said[FAILURE]
    assert POSE not in said
    assert failure.header.frame_id == 1
    return failure.stage, failure.reason


def test_a_guess_that_sees_nothing_ends_there(make_nodes: Any, image: np.ndarray) -> None:
    away = np.diag([1.0, -1.0, -1.0, 1.0]) @ POSE_TRUE
    said = run_chain(make_nodes(), frame_message(image, LENS), guess_message(away, LENS))
    assert failed(said) == ("rendering", Reason.NOTHING_IN_VIEW)
    assert VIEW not in said


def test_a_blank_frame_has_too_few_matches(make_nodes: Any, image: np.ndarray) -> None:
    said = run_chain(make_nodes(), frame_message(np.zeros_like(image), LENS), guess_message(POSE_TRUE, LENS))
    assert failed(said) == ("matching", Reason.TOO_FEW_MATCHES)


def test_a_gamma_that_nothing_meets_leaves_too_few_points(make_nodes: Any, image: np.ndarray) -> None:
    nodes = make_nodes(lifting=LiftingConfig(gamma=1e-9))
    said = run_chain(nodes, frame_message(image, LENS), guess_message(POSE_TRUE, LENS))
    assert failed(said) == ("lifting", Reason.TOO_FEW_CONSISTENT_POINTS)


def test_a_missing_frame_is_said_to_be_missing(make_nodes: Any) -> None:
    said = run_chain(make_nodes(), None, guess_message(POSE_TRUE, LENS))
    assert failed(said) == ("matching", Reason.FRAME_MISSING)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_encoded_frames_are_read_and_damaged_ones_reported(make_nodes: Any, image: np.ndarray, suffix: str) -> None:
    encoding = {".jpg": "jpeg", ".png": "png"}[suffix]
    payload = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].ravel()
    guess = guess_message(POSE_TRUE, LENS)
    said = run_chain(make_nodes(), frame_message(payload, LENS, encoding=encoding), guess)
    assert rotation_error_deg(said[POSE].cam_from_object, POSE_TRUE) < 0.2
    said = run_chain(make_nodes(), frame_message(payload[:20], LENS, encoding=encoding), guess)
    assert failed(said) == ("matching", Reason.FRAME_UNREADABLE)
