"""Requests survive the wire; no bytes whatever do anything but raise CodecError, in one line."""

from __future__ import annotations

from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.bus_samples import same

from fieldpose.bus.codec import encode
from fieldpose.bus.messages import TrackingState
from fieldpose.bus.requests import (
    KINDS,
    MAX_BYTES,
    VERSION,
    ControlValues,
    Request,
    Reset,
    Response,
    SaveSnapshot,
    SetGuess,
    SetSolving,
    Show,
    SnapshotSaved,
    TakeKeyframe,
    decode_answer,
    decode_request,
)
from fieldpose.errors import CodecError
from fieldpose.stages.geometry import exp_se3

POSE = exp_se3([0.1, 0.2, 3.0, 0.4, 0.5, 0.6])
SAMPLES: list[Request[Any]] = [
    Reset(), SetGuess(cam_from_object=POSE), SetSolving(solves_per_s=2.5), TakeKeyframe(), Show(),
    SaveSnapshot(seconds=10.0),
]  # fmt: skip
SAVED = SnapshotSaved(path="out/lost-1.mcap", seconds=9.5, messages=700)
VALUES = ControlValues(state=TrackingState.LOST, frames=7, requests=2, solves_per_s=None, begins_at=POSE)
steady = settings(derandomize=True, deadline=None)


def wire(request: Request[Any]) -> Any:
    return msgpack.unpackb(encode(request))


def refused(payload: bytes) -> str:
    with pytest.raises(CodecError) as caught:
        decode_request(payload)
    assert "\n" not in str(caught.value)
    assert str(caught.value).isascii()
    return str(caught.value)


def equal(a: Any, b: Any) -> bool:
    return type(a) is type(b) and all(same(getattr(a, f), getattr(b, f)) for f in a.__struct_fields__)


@pytest.mark.parametrize("request_", SAMPLES, ids=lambda sample: type(sample).__name__)
def test_every_request_comes_back(request_: Request[Any]) -> None:
    assert equal(decode_request(encode(request_)), request_)


def test_there_is_a_sample_of_every_kind() -> None:
    assert [wire(sample)["request"] for sample in SAMPLES] == [sample.kind for sample in SAMPLES] == list(KINDS)
    assert [type(sample) for sample in SAMPLES] == list(KINDS.values())


@pytest.mark.parametrize(
    ("request_", "answer"), [(Show(), VALUES), (SaveSnapshot(seconds=1.0), SAVED)], ids=["show", "save"]
)
def test_each_kind_has_its_answer_and_others_are_refused(request_: Request[Any], answer: Response) -> None:
    assert equal(decode_answer(encode(answer), request_), answer)
    other = SAVED if answer is VALUES else VALUES
    for payload in (b"", b"\xc1", encode(other), msgpack.packb({**msgpack.unpackb(encode(answer)), "state": "asleep"})):
        with pytest.raises(CodecError):
            decode_answer(payload, request_)


def test_as_any_zenoh_client_may_write_it() -> None:
    assert isinstance(decode_request(msgpack.packb({"request": "reset", "version": 1})), Reset)
    solving = decode_request(msgpack.packb({"request": "set_solving", "version": 1, "solves_per_s": 3}))
    assert isinstance(solving, SetSolving)
    assert solving.solves_per_s == 3.0


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"request": "reset"}, "version None where 1 is expected"),
        ({"request": "reset", "version": 2}, "version 2 where 1 is expected"),
        ({"request": "pause", "version": 2}, "version 2 where 1 is expected"),
        ({"request": "reset", "version": True}, "version True where 1 is expected"),
        (
            {"version": 1},
            "None where one of reset, set_guess, set_solving, take_keyframe, show, save_snapshot is expected",
        ),
        ({"request": "pause", "version": 1}, "'pause' where one of reset,"),
        ({"request": ["reset"], "version": 1}, "a list where one of reset,"),
        ({"request": "a\n\u202e" * 99, "version": 1}, "where one of reset,"),
        ({"request": "reset", "version": 1, "hard": True}, "`hard`"),
        ({"request": "set_solving", "version": 1}, "`solves_per_s`"),
        ({"request": "set_solving", "version": 1, "solves_per_s": "often"}, "`float`"),
        ({"request": "set_solving", "version": 1, "solves_per_s": float("nan")}, "solves_per_s: not finite"),
        ({"request": "set_solving", "version": 1, "solves_per_s": float("inf")}, "solves_per_s: not finite"),
        ({"request": "set_solving", "version": 1, "solves_per_s": -1}, "-1 where 0 to 100 is expected"),
        ({"request": "set_solving", "version": 1, "solves_per_s": 100.5}, "100.5 where 0 to 100 is expected"),
        ({"request": "set_guess", "version": 1, "cam_from_object": None}, "cam_from_object"),
        ({"request": "save_snapshot", "version": 1, "seconds": 0}, "seconds: 0 where a number above 0"),
        ({"request": "save_snapshot", "version": 1, "seconds": 601}, "at most 600, is expected"),
        ({"request": "save_snapshot", "version": 1, "seconds": float("nan")}, "seconds: not finite"),
        ([1, 2], "no map"),
        (None, "no map"),
    ],
)
def test_what_is_wrong_is_told(fields: Any, said: str) -> None:
    assert said in refused(msgpack.packb(fields))


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        (np.full((4, 4), np.nan), "cam_from_object: not finite"),
        (2 * np.eye(4), "no rigid transform"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "no rigid transform"),
        (np.eye(3), "shape (3, 3) where (4, 4) is expected"),
        (np.eye(4, dtype=np.float32), "dtype float32 where float64 is expected"),
    ],
)
def test_a_guess_that_is_no_pose_is_refused_here_and_there(pose: np.ndarray, said: str) -> None:
    with pytest.raises(ValueError, match="cam_from_object"):
        SetGuess(cam_from_object=pose)
    fields = wire(SAMPLES[1])
    array = {"dtype": pose.dtype.name, "shape": list(pose.shape), "data": pose.tobytes()}
    assert said in refused(msgpack.packb({**fields, "cam_from_object": array}))


def test_too_many_bytes_are_refused() -> None:
    payload = msgpack.packb({**wire(SAMPLES[0]), "padding": b"x" * MAX_BYTES})
    assert f"{len(payload)} bytes where at most {MAX_BYTES} are allowed" in refused(payload)


@steady
@given(st.binary(max_size=300))
def test_random_bytes(payload: bytes) -> None:
    refused(payload)


@settings(steady, max_examples=400)
@given(st.data(), st.sampled_from(SAMPLES))
def test_mutated_requests(data: st.DataObject, sample: Request[Any]) -> None:
    payload = bytearray(encode(sample))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    refused_or_checked(bytes(payload))


@steady
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
        max_leaves=12,
    ),
    st.sampled_from(SAMPLES),
    st.data(),
)
def test_any_value_in_any_field(value: Any, sample: Request[Any], data: st.DataObject) -> None:
    fields = wire(sample)
    fields[data.draw(st.sampled_from(sorted(fields)))] = value
    try:
        payload = msgpack.packb(fields)
    except UnicodeEncodeError:
        return
    refused_or_checked(payload)


def refused_or_checked(payload: bytes) -> None:
    """What is accepted is a whole, valid request: it can be sent again and comes back the same."""
    try:
        request = decode_request(payload)
    except CodecError:
        return
    assert msgspec.structs.asdict(request)["version"] == VERSION
    assert equal(decode_request(encode(request)), request)
