"""Every message survives the wire; no bytes whatever do anything but raise CodecError."""

from __future__ import annotations

import datetime
import tracemalloc
from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from support.bus_samples import CAMERA, every_message, failure, frame, guess, matches, same, view

from fieldpose.bus import messages, topics
from fieldpose.bus.codec import DTYPES, decode, encode
from fieldpose.bus.messages import CameraOrigin, Message, Reason
from fieldpose.bus.topics import Topic
from fieldpose.errors import CodecError, GeometryError
from fieldpose.stages.geometry import Camera

SAMPLES = every_message()
PAYLOADS = {topic: encode(message) for topic, message in SAMPLES.items()}
# What came after the first recordings: it may be missing.
LATER = {
    topics.FRAME: {"camera_origin"},
    topics.CAMERA_INFO: {"camera_origin"},
    topics.STATE: {"reason", "camera_origin", "level"},
    topics.STATS: {"busy_s"},
}
FREE_TEXT = ("view_id", "stage")
every_topic = pytest.mark.parametrize("topic", topics.ALL, ids=lambda topic: topic.name)

steady = settings(derandomize=True, deadline=None)
small = st.integers(1, 6)
finite = st.floats(-1e6, 1e6, width=32)


def wire(topic: Topic[Any]) -> Any:
    return msgpack.unpackb(PAYLOADS[topic])


def refused(payload: bytes, topic: Topic[Any]) -> str:
    with pytest.raises(CodecError) as caught:
        decode(payload, topic.message_type, topic.max_bytes)
    assert "\n" not in str(caught.value)
    assert str(caught.value).isascii()
    return str(caught.value)


def refused_fields(fields: Any, topic: Topic[Any]) -> str:
    return refused(msgpack.packb(fields), topic)


class TestRoundTrip:
    @every_topic
    def test_every_message_comes_back(self, topic: Topic[Any]) -> None:
        assert same(decode(PAYLOADS[topic], topic.message_type, topic.max_bytes), SAMPLES[topic])

    @steady
    @given(st.data(), small, small)
    def test_views_of_any_size(self, data: st.DataObject, width: int, height: int) -> None:
        def image(dtype: str, shape: tuple[int, ...], elements: Any = None) -> np.ndarray:
            return data.draw(arrays.arrays(dtype, shape, elements=elements))

        sent = view()
        sent.camera = msgspec.structs.replace(sent.camera, width=width, height=height)
        sent.rgb, sent.opacity = image("uint8", (height, width, 3)), image("uint8", (height, width))
        sent.depth = image("float32", (height, width), finite)
        assert same(decode(encode(sent), messages.View), sent)

    @steady
    @given(arrays.arrays("float32", st.tuples(st.integers(0, 40), st.just(2)), elements=finite), st.data())
    def test_correspondences_of_any_length(self, pixels: np.ndarray, data: st.DataObject) -> None:
        count = len(pixels)
        sent = every_message()[topics.CORRESPONDENCES]
        assert isinstance(sent, messages.Correspondences)
        sent.pixels_in_frame = pixels
        sent.points_in_object = data.draw(arrays.arrays("float32", (count, 3), elements=finite))
        sent.confidence = sent.consistency = data.draw(arrays.arrays("float32", count, elements=finite))
        sent.kept = data.draw(arrays.arrays("bool", count))
        assert same(decode(encode(sent), messages.Correspondences), sent)

    @steady
    @given(arrays.arrays("float64", (4, 4), elements=st.floats(-1e300, 1e300)), st.floats(allow_nan=False))
    def test_poses_and_numbers(self, pose: np.ndarray, number: float) -> None:
        sent = every_message()[topics.POSE]
        assert isinstance(sent, messages.Pose)
        sent.cam_from_object, sent.residual_px = pose, number
        if np.isfinite(number):
            assert same(decode(encode(sent), messages.Pose), sent)
        else:
            with pytest.raises(CodecError, match="residual_px: not finite"):
                encode(sent)

    @steady
    @given(st.binary(max_size=200))
    def test_compressed_images_of_any_length(self, file: bytes) -> None:
        sent = frame()
        sent.encoding, sent.image = "jpeg", np.frombuffer(file, np.uint8)
        assert same(decode(encode(sent), messages.Frame), sent)

    @steady
    @given(
        st.integers(1, 16384),
        st.integers(1, 16384),
        st.tuples(*[st.floats(1e-3, 1e6)] * 2, *[finite] * 2),
        st.tuples(*[finite] * 5),
        st.sampled_from(CameraOrigin),
    )
    def test_cameras_of_any_kind(
        self,
        width: int,
        height: int,
        intrinsics: tuple[float, float, float, float],
        distortion: tuple[float, float, float, float, float],
        origin: CameraOrigin,
    ) -> None:
        sent = every_message()[topics.CAMERA_INFO]
        assert isinstance(sent, messages.CameraInfo)
        sent.camera, sent.camera_origin = Camera(width, height, *intrinsics, distortion), origin
        back = decode(encode(sent), messages.CameraInfo)
        assert same(back, sent)
        assert type(back.camera) is Camera
        assert type(back.camera.distortion) is tuple

    @pytest.mark.parametrize("reason", Reason)
    def test_every_reason_to_fail(self, reason: Reason) -> None:
        assert decode(encode(failure(3, "pnp", reason)), messages.Failure).reason is reason

    @pytest.mark.parametrize("topic", [topics.TRUTH, topics.STATE], ids=lambda topic: topic.name)
    def test_a_pose_may_be_unknown_where_it_is_the_truth_or_what_tracking_believes(self, topic: Topic[Any]) -> None:
        sent: Any = every_message()[topic]
        for pose in (None, np.eye(4)):
            sent.cam_from_object = pose
            assert same(decode(encode(sent), topic.message_type), sent)

    @pytest.mark.parametrize("arrange", [np.asfortranarray, lambda image: image[::-1, ::2]])
    def test_arrays_of_any_memory_order(self, arrange: Any) -> None:
        sent = frame(width=8)
        sent.image = arrange(sent.image)
        height, width = sent.image.shape[:2]
        sent.camera = msgspec.structs.replace(sent.camera, width=width, height=height)
        assert same(decode(encode(sent), messages.Frame).image, np.ascontiguousarray(sent.image))

    def test_arrays_at_odd_addresses(self) -> None:
        memory = np.zeros(4 * 4 * 8 + 1, np.uint8)
        unaligned = memory[1:].view(np.float64).reshape(4, 4)
        unaligned[:] = np.eye(4)
        assert not unaligned.flags.aligned
        sent = guess()
        sent.cam_from_object = unaligned
        payload = encode(sent)
        for offset in range(8):
            shifted = memoryview(b"x" * offset + payload)[offset:]
            assert same(decode(shifted, messages.Guess).cam_from_object, np.eye(4))

    @every_topic
    def test_decoded_arrays_are_read_only(self, topic: Topic[Any]) -> None:
        message = decode(PAYLOADS[topic], topic.message_type)
        found = [getattr(message, name) for name in message.__struct_fields__]
        assert all(not value.flags.writeable for value in found if isinstance(value, np.ndarray))

    def test_an_image_is_copied_once_in_and_once_out(self) -> None:
        sent = frame(width=1000, height=1000)
        size = sent.image.nbytes
        tracemalloc.start()
        try:
            payload = encode(sent)
            packing = tracemalloc.get_traced_memory()[1]
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            decode(payload, messages.Frame)
            unpacking = tracemalloc.get_traced_memory()[1] - before
        finally:
            tracemalloc.stop()
        # The packer's buffer, which is twice the size, and the packed bytes: no copy of the array before.
        assert packing < 3.2 * size
        assert unpacking < 1.2 * size


class TestSendingSide:
    def test_a_message_that_the_receiver_would_refuse_is_not_sent(self) -> None:
        sent = view()
        sent.depth = np.full((4, 6), np.nan, np.float32)
        with pytest.raises(CodecError, match="depth: not finite"):
            encode(sent)

    def test_object_arrays_are_never_sent(self) -> None:
        sent = frame()
        sent.encoding, sent.image = "jpeg", np.array([print, None], dtype=object)
        with pytest.raises(CodecError):
            encode(sent)

    def test_big_endian_numbers_are_not_sent(self) -> None:
        sent = matches(guess().header)
        sent.confidence = sent.confidence.astype(">f4")
        with pytest.raises(CodecError, match="confidence: dtype"):
            encode(sent)

    @pytest.mark.parametrize(("field", "value"), [("view_id", 3), ("camera", 4.5), ("header", None), ("rgb", object())])
    def test_a_field_of_a_wrong_type_is_refused_by_the_receiver_or_before(self, field: str, value: Any) -> None:
        sent = view()
        setattr(sent, field, value)
        with pytest.raises(CodecError):
            decode(encode(sent), messages.View)

    @pytest.mark.parametrize("reason", ["ok", "no such word", None, 3])
    def test_a_reason_that_is_none_is_refused_by_the_receiver_or_before(self, reason: Any) -> None:
        sent = failure()
        sent.reason = reason
        with pytest.raises(CodecError):
            decode(encode(sent), messages.Failure)

    @pytest.mark.parametrize("width", [6.0, np.int64(6), np.float32(6)])
    def test_a_camera_of_wrong_types_is_refused_by_the_receiver_or_before(self, width: Any) -> None:
        sent = guess()
        sent.camera = msgspec.structs.replace(CAMERA, width=width)
        with pytest.raises(CodecError):
            decode(encode(sent), messages.Guess)


class TestRefusals:
    @every_topic
    def test_unknown_missing_and_wrong_fields(self, topic: Topic[Any]) -> None:
        fields = wire(topic)
        refused_fields({**fields, "surprise": 1}, topic)
        for name in fields:
            if name not in LATER.get(topic, ()):
                refused_fields({key: value for key, value in fields.items() if key != name}, topic)
            for wrong in ({"a": 1}, [1, 2], [[]], b"bytes", "no such word", 2**64 - 1, -1.5, float("nan")):
                if name not in FREE_TEXT or not isinstance(wrong, str):
                    self._refused_or_valid({**fields, name: wrong}, name, topic)

    def _refused_or_valid(self, fields: dict[str, Any], name: str, topic: Topic[Any]) -> None:
        """Counts and scores may be any number; whatever is accepted must be as it was sent."""
        try:
            message = decode(msgpack.packb(fields), topic.message_type)
        except CodecError:
            return
        accepted = getattr(message, name)
        assert isinstance(accepted, int | float)
        assert accepted == pytest.approx(fields[name])
        assert np.isfinite(accepted)

    @pytest.mark.parametrize("topic", [topics.ESTIMATE, topics.POSE], ids=lambda topic: topic.name)
    @pytest.mark.parametrize("name", ["cam_from_object", "covariance", "residual_px"])
    def test_an_estimate_always_has_a_pose_and_how_certain_it_is(self, topic: Topic[Any], name: str) -> None:
        assert name in refused_fields({**wire(topic), name: None}, topic)

    @pytest.mark.parametrize("topic", [topics.PRIOR, topics.GUESS, topics.VIEW], ids=lambda topic: topic.name)
    def test_where_something_is_to_be_rendered_there_is_a_pose(self, topic: Topic[Any]) -> None:
        assert "cam_from_object" in refused_fields({**wire(topic), "cam_from_object": None}, topic)

    @pytest.mark.parametrize(
        "topic",
        [topic for topic in topics.ALL if topic not in (topics.GUESS, topics.FAILURE, topics.STATE)],
        ids=lambda topic: topic.name,
    )
    def test_a_result_says_neither_that_it_is_one_nor_why_it_is_none(self, topic: Topic[Any]) -> None:
        assert "`ok`" in refused_fields({**wire(topic), "ok": True}, topic)
        assert "`reason`" in refused_fields({**wire(topic), "reason": "no_consensus"}, topic)

    @every_topic
    def test_a_message_of_another_topic(self, topic: Topic[Any]) -> None:
        for other in topics.ALL:
            # A pose is all that there is in either.
            if other is not topic and (other, topic) != (topics.PRIOR, topics.TRUTH):
                refused(PAYLOADS[other], topic)

    @pytest.mark.parametrize(
        ("field", "value", "told"),
        [
            ("dtype", "float32", "do not fill"),
            ("dtype", "object", "dtype of an array"),
            ("dtype", "O", "dtype of an array"),
            ("dtype", "float16", "dtype of an array"),
            ("dtype", ["float64"], "dtype of an array"),
            ("dtype", None, "dtype of an array"),
            ("shape", [2, 8], "shape"),
            ("shape", [4, 4, 1], "shape"),
            ("shape", [4, 5], "do not fill"),
            ("shape", [-4, -4], "shape of an array"),
            ("shape", [2**62, 0], "do not fill"),
            ("shape", [1, 1, 1, 4, 4], "shape of an array"),
            ("shape", [4.0, 4.0], "shape of an array"),
            ("shape", [True, 16], "shape of an array"),
            ("shape", 16, "shape of an array"),
            ("data", b"", "do not fill"),
            ("data", b"x" * 127, "do not fill"),
            ("data", "x" * 128, "do not fill"),
            ("data", np.full(16, np.nan).tobytes(), "not finite"),
            ("data", np.full(16, np.inf).tobytes(), "not finite"),
        ],
    )
    def test_arrays_that_lie(self, field: str, value: Any, told: str) -> None:
        fields = wire(topics.GUESS)
        fields["cam_from_object"][field] = value
        assert told in refused_fields(fields, topics.GUESS)

    def test_bool_arrays_hold_bools(self) -> None:
        fields = wire(topics.CORRESPONDENCES)
        fields["kept"]["data"] = b"\x00\x01\x02\x00\x00"
        assert "0 or 1" in refused_fields(fields, topics.CORRESPONDENCES)

    def test_an_array_has_no_other_keys(self) -> None:
        fields = wire(topics.GUESS)
        fields["cam_from_object"]["order"] = "F"
        refused_fields(fields, topics.GUESS)

    @pytest.mark.parametrize("field", ["sequence", "frame_id", "pass_index", "capture_ns", "sent_ns"])
    @pytest.mark.parametrize("value", [-1, 2**63, 2**64 - 1, 1.0, True, None])
    def test_numbers_of_the_header(self, field: str, value: Any) -> None:
        fields = wire(topics.GUESS)
        fields["header"][field] = value
        refused_fields(fields, topics.GUESS)

    def test_sizes_that_disagree(self) -> None:
        fields = wire(topics.MATCHES)
        fields["confidence"] = {"dtype": "float32", "shape": [4], "data": bytes(16)}
        assert "length differs" in refused_fields(fields, topics.MATCHES)
        fields = wire(topics.VIEW)
        fields["camera"]["width"] = 7
        assert "size differs" in refused_fields(fields, topics.VIEW)
        fields = wire(topics.FRAME)
        fields["camera"]["width"] = 7
        assert "image: shape" in refused_fields(fields, topics.FRAME)

    def test_too_many_bytes(self) -> None:
        assert "at most" in refused(bytes(topics.GUESS.max_bytes + 1), topics.GUESS)

    def test_extension_types_and_timestamps(self) -> None:
        for value in (msgpack.ExtType(4, b"x"), datetime.datetime.now(datetime.UTC)):
            fields = {**wire(topics.GUESS), "reason": value}
            refused(msgpack.packb(fields, datetime=True), topics.GUESS)

    def test_a_key_that_stands_twice(self) -> None:
        payload = PAYLOADS[topics.TRUTH]
        assert payload[0] == 0x82
        again = b"\x83" + payload[1:] + msgpack.packb("cam_from_object") + b"\xc0"
        assert "twice" in refused(again, topics.TRUTH)

    def test_keys_that_are_no_text(self) -> None:
        refused(msgpack.packb({1: 2}), topics.TRUTH)
        refused(msgpack.packb({b"header": 2}), topics.TRUTH)

    @pytest.mark.parametrize("deep", [b"\x91" * 100_000, b"\x81\xa1a" * 100_000, b"\x91" * 900 + b"\xc0"])
    def test_nesting(self, deep: bytes) -> None:
        refused(deep, topics.FRAME)

    def test_many_small_lists_take_no_memory(self) -> None:
        bomb = b"\x9f" + (b"\x9f" + b"\x90" * 15) * 15
        payload = b"\xdc\x00\x10" + bomb * 16
        assert "lists and maps" in refused(payload, topics.FRAME)
        refused(b"\xdd\xff\xff\xff\xff" + b"\x90" * 1000, topics.FRAME)
        refused(b"\xc6\xff\xff\xff\xff" + b"\x90" * 1000, topics.FRAME)

    def test_what_follows_a_message(self) -> None:
        refused(PAYLOADS[topics.TRUTH] + b"\xc0", topics.TRUTH)

    def test_hostile_text_stays_in_one_line_of_ascii(self) -> None:
        refused(msgpack.packb({"\n\x1b[31m\u202e" * 10: 1}), topics.TRUTH)


class TestCameras:
    @pytest.mark.parametrize(
        ("field", "value", "told"),
        [
            ("width", 0, "a size of 1 to 16384"),
            ("width", 16385, "a size of 1 to 16384"),
            ("height", -4, "a size of 1 to 16384"),
            ("height", 2**63, "a size of 1 to 16384"),
            ("width", 6.5, "`int`"),
            ("height", True, "`int`"),
            ("fx", 0.0, "positive focal lengths"),
            ("fy", -5.0, "positive focal lengths"),
            ("fx", np.nan, "finite intrinsics"),
            ("fy", np.inf, "finite intrinsics"),
            ("cx", np.nan, "finite intrinsics"),
            ("cy", -np.inf, "finite intrinsics"),
            ("fx", "5.0", "`float`"),
            ("cx", None, "`float`"),
            ("distortion", [0.0, 0.0, np.nan, 0.0, 0.0], "finite intrinsics"),
            ("distortion", [0.0] * 4, "length 5"),
            ("distortion", [0.0] * 6, "length 5"),
            ("distortion", [0.0, "k", 0.0, 0.0, 0.0], "`float`"),
            ("distortion", {}, "`array`"),
            ("distortion", None, "`array`"),
        ],
    )
    @pytest.mark.parametrize("topic", [topics.CAMERA_INFO, topics.GUESS], ids=lambda topic: topic.name)
    def test_numbers_that_make_no_camera(self, topic: Topic[Any], field: str, value: Any, told: str) -> None:
        fields = wire(topic)
        fields["camera"][field] = value
        assert told in refused_fields(fields, topic)

    @pytest.mark.parametrize(
        "numbers",
        [
            {"width": 0},
            {"height": 16385},
            {"fx": -1.0},
            {"cy": np.nan},
            {"distortion": (0.0,) * 4},
            {"distortion": (np.inf, 0.0, 0.0, 0.0, 0.0)},
        ],
    )
    def test_the_sender_cannot_make_them_either(self, numbers: dict[str, Any]) -> None:
        with pytest.raises(GeometryError) as caught:
            msgspec.structs.replace(CAMERA, **numbers)
        assert isinstance(caught.value, ValueError)

    @pytest.mark.parametrize(
        "topic", [topics.FRAME, topics.CAMERA_INFO, topics.GUESS, topics.VIEW], ids=lambda topic: topic.name
    )
    def test_a_key_too_many_or_too_few(self, topic: Topic[Any]) -> None:
        fields = wire(topic)
        camera = fields["camera"]
        assert list(camera) == ["width", "height", "fx", "fy", "cx", "cy", "distortion"]
        assert "surprise" in refused_fields({**fields, "camera": {**camera, "surprise": 1}}, topic)
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            less = {key: value for key, value in camera.items() if key != name}
            assert f"`{name}`" in refused_fields({**fields, "camera": less}, topic)

    def test_one_that_does_not_speak_of_distortion_has_none(self) -> None:
        fields = wire(topics.CAMERA_INFO)
        del fields["camera"]["distortion"]
        info = decode(msgpack.packb(fields), messages.CameraInfo)
        assert info.camera == CAMERA.undistorted()

    @pytest.mark.parametrize("origin", ["guessed", "", None, 3])
    def test_an_origin_that_is_none(self, origin: Any) -> None:
        for topic in (topics.FRAME, topics.CAMERA_INFO, topics.STATE):
            assert "camera_origin" in refused_fields({**wire(topic), "camera_origin": origin}, topic)


class TestOlderMessages:
    """What was recorded before a field came to its message can still be read."""

    def test_stats_without_the_time_at_work(self) -> None:
        older = {key: value for key, value in wire(topics.STATS).items() if key != "busy_s"}
        assert decode(msgpack.packb(older), messages.Stats).busy_s == 0.0

    def test_a_state_without_a_reason_and_an_origin_of_the_camera(self) -> None:
        older = {key: value for key, value in wire(topics.STATE).items() if key not in ("reason", "camera_origin")}
        state = decode(msgpack.packb(older), messages.State)
        assert (state.reason, state.camera_origin) == (None, CameraOrigin.CALIBRATED)
        assert (state.admitted, state.finished, state.dropped_at_the_door) == (9, 8, 4)

    @pytest.mark.parametrize("topic", [topics.FRAME, topics.CAMERA_INFO], ids=lambda topic: topic.name)
    def test_a_camera_without_an_origin_is_calibrated(self, topic: Topic[Any]) -> None:
        older = {**wire(topic)}
        del older["camera_origin"]
        message: Any = decode(msgpack.packb(older), topic.message_type)
        assert message.camera_origin is CameraOrigin.CALIBRATED
        assert message.camera == SAMPLES[topic].camera

    @every_topic
    def test_nothing_else_has_a_default(self, topic: Topic[Any]) -> None:
        fields = msgspec.structs.fields(topic.message_type)
        assert {field.name for field in fields if not field.required} == LATER.get(topic, set())


class TestAnyBytes:
    @steady
    @given(st.binary(max_size=300), st.sampled_from(topics.ALL))
    def test_random_bytes(self, payload: bytes, topic: Topic[Any]) -> None:
        refused(payload, topic)

    @settings(steady, max_examples=400)
    @given(st.data(), st.sampled_from(topics.ALL))
    def test_mutated_messages(self, data: st.DataObject, topic: Topic[Any]) -> None:
        payload = bytearray(PAYLOADS[topic])
        for _ in range(data.draw(st.integers(1, 4))):
            payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
        self._refused_or_checked(bytes(payload), topic)

    @steady
    @given(st.data(), st.sampled_from(topics.ALL))
    def test_cut_and_spliced_messages(self, data: st.DataObject, topic: Topic[Any]) -> None:
        payload = PAYLOADS[topic]
        start, end = sorted((data.draw(st.integers(0, len(payload))), data.draw(st.integers(0, len(payload)))))
        self._refused_or_checked(payload[:start] + data.draw(st.binary(max_size=8)) + payload[end:], topic)

    @steady
    @given(
        st.recursive(
            st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
            lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
            max_leaves=12,
        ),
        st.sampled_from(topics.ALL),
        st.data(),
    )
    def test_any_value_in_any_field(self, value: Any, topic: Topic[Any], data: st.DataObject) -> None:
        fields = wire(topic)
        inner = [value for value in fields.values() if isinstance(value, dict)]
        target = data.draw(st.sampled_from([fields, *inner]))
        target[data.draw(st.sampled_from(sorted(target)))] = value
        try:
            self._refused_or_checked(msgpack.packb(fields), topic)
        except UnicodeEncodeError:
            return

    def _refused_or_checked(self, payload: bytes, topic: Topic[Any]) -> None:
        """What is accepted is a whole, valid message: it can be sent again and comes back the same."""
        try:
            message = decode(payload, topic.message_type, topic.max_bytes)
        except CodecError:
            return
        assert isinstance(message, Message)
        assert same(decode(encode(message), topic.message_type), message)

    def test_only_plain_numbers_are_on_the_list(self) -> None:
        assert all(dtype.kind in "biuf" and dtype.itemsize <= 8 for dtype in DTYPES.values())
