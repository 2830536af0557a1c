"""Pictures and videos of a run: the field lies over the camera's image where the pose says."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.analytic_scene import AnalyticScene, camera, viewpoint
from support.chain import frame_message

from fieldpose.bus.messages import Header
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.topics import FRAME, Address
from fieldpose.deploy.reporting.output import PICTURES, check_picture, check_writable, write_bytes, write_json
from fieldpose.deploy.reporting.overlay import EDGE_RGB, encoded, overlaid
from fieldpose.deploy.reporting.results import FrameResult, TruthKnown
from fieldpose.deploy.reporting.showing import Picture, pictures, pictures_of, write_video
from fieldpose.deploy.reporting.timeline import plot_timeline, state_spans
from fieldpose.errors import OutputError
from fieldpose.stages.geometry import perturb

CAMERA = camera(64)
FRAME_NS = 100_000_000


@pytest.fixture(scope="module")
def scene() -> AnalyticScene:
    return AnalyticScene()


def test_the_outline_lies_on_the_image_only_where_the_pose_is_right(scene: AnalyticScene) -> None:
    seen_by = camera(160)
    truth = viewpoint()
    image = scene.render_view(seen_by, truth).rgb
    beside = perturb(truth, np.random.default_rng(0), (10.0, 10.0))

    def fit(pose: np.ndarray) -> float:
        drawn = overlaid(image, scene.render_view(seen_by, pose))
        edges = cv2.Canny(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 80, 180) > 0
        return float(edges[(drawn == EDGE_RGB).all(axis=2)].mean())

    assert fit(truth) > 2 * fit(beside)


def recorded(path: Path, scene: AnalyticScene, count: int) -> list[FrameResult]:
    """A recording of frames, and results of all but the last; the second has no pose."""
    writer = RecordingWriter(path)
    results = []
    for i in range(count):
        pose = viewpoint(azimuth_deg=20.0 + i)
        frame = frame_message(scene.render_view(CAMERA, pose).rgb, CAMERA, i)
        frame.header = Header("camera", i, i, 0, i * FRAME_NS, i * FRAME_NS)
        writer.write(Address().key(FRAME), FRAME, frame, i * FRAME_NS)
        found, score = (None, 0.0) if i == 1 else (pose, 0.5 + 0.1 * i)
        result = FrameResult(
            i, i * FRAME_NS, "finished" if i < count - 1 else "dropped", state="tracking", score=score,
            cam_from_object=found, truth=TruthKnown(pose),
        )  # fmt: skip
        results.append(result)
    writer.close()
    return results


def test_a_picture_is_of_the_very_frame_and_there_is_none_of_what_cannot_be_decoded(
    tmp_path: Path, scene: AnalyticScene
) -> None:
    """A camera that begins again numbers its frames as it did before."""
    writer = RecordingWriter(tmp_path / "a.mcap")
    shades = ((0, 1, 40), (1, 2, None), (0, 3, 200))
    for number, at_ns, shade in shades:
        frame = frame_message(np.full((CAMERA.height, CAMERA.width, 3), shade or 0, np.uint8), CAMERA, number)
        if shade is None:
            frame.image, frame.encoding = np.frombuffer(b"no picture", np.uint8), "jpeg"
        frame.header = Header("camera", number, number, 0, at_ns, at_ns)
        writer.write(Address().key(FRAME), FRAME, frame, at_ns)
    writer.close()
    results = [FrameResult(number, at_ns, "finished", state="lost") for number, at_ns, _ in shades]
    shown = list(pictures_of(tmp_path / "a.mcap", results[1:], scene))
    assert [picture.result.capture_ns for picture in shown] == [3]
    assert np.median(shown[0].pixels) == pytest.approx(200, abs=3)


def test_a_title_is_no_formula(tmp_path: Path, scene: AnalyticScene) -> None:
    unjudged = [replace(result, truth=None) for result in recorded(tmp_path / "a.mcap", scene, 3)]
    plot_timeline(unjudged, tmp_path / "a.png", "video:/a/$_{$.mp4")
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_a_video_shows_each_finished_frame_until_the_next(tmp_path: Path, scene: AnalyticScene) -> None:
    results = recorded(tmp_path / "a.mcap", scene, 4)
    told: list[tuple[int, int]] = []
    shown = pictures(tmp_path / "a.mcap", results, scene, lambda done, total: told.append((done, total)))
    best = write_video(tmp_path / "a.mp4", shown)
    assert told[-1] == (3, 3)
    assert best is not None
    assert best.result.frame_id == 2
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert (video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (128, 64)
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 3 + 3 + 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "a.mp4"]


def test_a_video_that_cannot_be_finished_leaves_nothing(tmp_path: Path, scene: AnalyticScene) -> None:
    results = recorded(tmp_path / "a.mcap", scene, 4)

    def broken() -> Iterator[Picture]:
        yield from pictures(tmp_path / "a.mcap", results, scene)
        raise OutputError("a frame cannot be decoded")

    with pytest.raises(OutputError):
        write_video(tmp_path / "a.mp4", broken())
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_pictures_are_of_the_frames_of_the_pipelines_camera(tmp_path: Path, scene: AnalyticScene) -> None:
    results = recorded(tmp_path / "a.mcap", scene, 3)
    counts = [
        len(list(pictures(tmp_path / "a.mcap", results, scene, address=address)))
        for address in (None, Address(object="mug"), Address(camera="other"))
    ]
    assert counts == [2, 2, 0]


def test_no_finished_frame_makes_no_video(tmp_path: Path) -> None:
    assert write_video(tmp_path / "a.mp4", iter(())) is None
    assert not (tmp_path / "a.mp4").exists()


@pytest.mark.parametrize("kind", PICTURES)
def test_a_timeline_shows_what_is_known_of_each_frame(tmp_path: Path, kind: str) -> None:
    pose, ms = viewpoint(), 10**6
    known = FrameResult(
        0, 0, "finished", state="tracking", score=0.9, cam_from_object=pose, truth=TruthKnown(viewpoint(21)),
        sent_ns=ms, answered_ns=50 * ms, level=1,
    )  # fmt: skip
    frames = [
        known,
        replace(known, capture_ns=33 * ms, answered_ns=90 * ms, truth=None, level=None),
        replace(known, capture_ns=66 * ms, answered_ns=99 * ms, state="lost", cam_from_object=None, carried=pose),
        FrameResult(3, 100 * ms, "dropped"),
        FrameResult(4, 133 * ms, "lost", state="lost"),
    ]
    for name, shown in (("all", frames), ("dropped", frames[3:4]), ("none", [])):
        path = tmp_path / f"{name}{kind}"
        plot_timeline(shown, path, "test", live=name == "all")
        assert path.stat().st_size > 1000


def test_states_last_until_the_next_one() -> None:
    states = ["initializing", None, "tracking", "tracking", "lost", "tracking"]
    timed = [(float(i), FrameResult(i, i, "finished", state=state)) for i, state in enumerate(states)]
    spans = state_spans(timed)
    assert spans["initializing"] == [(0.0, 2.0)]
    assert spans["lost"] == [(4.0, 1.0)]
    assert [start for start, _ in spans["tracking"]] == [2.0, 5.0]
    assert state_spans([]) == {}


def test_files_are_whole_or_not_there(tmp_path: Path) -> None:
    write_json(tmp_path / "new" / "a.json", {"x": [1, 2]})
    assert (tmp_path / "new" / "a.json").read_text().startswith('{\n  "x"')
    with pytest.raises(OutputError, match="cannot be written"):
        write_bytes(tmp_path / "new", b"over a folder")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a.json", "new"]
    with pytest.raises(OutputError, match=r"end it in \.jpg or \.png"):
        encoded(np.zeros((4, 4, 3), np.uint8), Path("a.what"))
    with pytest.raises(OutputError, match="is a folder"):
        check_writable(tmp_path)
    with pytest.raises(OutputError, match=r"end it in \.png, \.svg or \.pdf"):
        check_picture(tmp_path / "a.gif")
    with pytest.raises(OutputError, match="its folder cannot be made"):
        check_writable(tmp_path / "new" / "a.json" / "b.json")
