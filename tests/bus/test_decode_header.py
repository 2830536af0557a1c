"""A header can be had without its message, and only where there is one."""

from __future__ import annotations

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldpose.bus.codec import decode_header, encode
from fieldpose.bus.messages import Frame, Header, Truth
from fieldpose.errors import CodecError
from fieldpose.stages.geometry import Camera

HEADER = Header("camera", 3, 17, 0, 123, 456)


def test_header_of_a_large_message_is_had_without_the_rest() -> None:
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    frame = Frame(header=HEADER, image=np.zeros((48, 64, 3), np.uint8), encoding="rgb8", camera=camera)
    payload = encode(frame)
    assert decode_header(payload) == HEADER
    assert decode_header(payload[:300]) == HEADER


def test_message_that_does_not_begin_with_its_header_is_refused() -> None:
    fields = msgpack.unpackb(encode(Truth(header=HEADER, cam_from_object=None)))
    turned_round = msgpack.packb(dict(reversed(fields.items())))
    with pytest.raises(CodecError, match="begin with a header"):
        decode_header(turned_round)


@given(st.binary(max_size=200))
def test_any_bytes_give_a_codec_error(payload: bytes) -> None:
    with pytest.raises(CodecError):
        decode_header(payload)
