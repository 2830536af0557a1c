"""Bytes <-> message. Whatever the bytes are, decoding gives a checked message or one CodecError.

On the wire a message is a msgpack map of its fields; an array is a map of `dtype`, `shape` and `data`
(little-endian, row-major).
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import msgpack
import msgspec
import numpy as np

from fieldpose.bus.messages import Checked, Header
from fieldpose.errors import CodecError

M = TypeVar("M", bound=Checked)

DTYPES = {
    name: np.dtype(name).newbyteorder("<")
    for name in ("bool", "uint8", "uint16", "int32", "int64", "float32", "float64")
}
MAX_BYTES = 80 << 20
_MAX_CONTAINERS = 64
_MAX_LIST = 16
_MAX_MAP = 32
_MAX_TEXT = 4096
_MAX_DIMENSIONS = 4
_HEADER_BYTES = 1024
_ARRAY_KEYS = {"dtype", "shape", "data"}


def encode(message: Checked) -> bytes:
    """Pack a message, checking it as the receiver will. Raises CodecError where it cannot be sent."""
    try:
        message.__post_init__()
        fields = msgspec.to_builtins(message, builtin_types=(memoryview, bytes), enc_hook=_array_to_wire)
        return msgpack.packb(fields, use_bin_type=True)
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise CodecError(f"{type(message).__name__} cannot be sent: {_one_line(error)}") from error


def decode(payload: bytes | memoryview, message_type: type[M], max_bytes: int = MAX_BYTES) -> M:
    """Unpack and check a message; its arrays are read-only views of the unpacked bytes.

    Raises CodecError for anything that is not exactly one valid `message_type` of at most `max_bytes`.
    """
    return converted(unpacked(payload, message_type.__name__, max_bytes), message_type)


def unpacked(payload: bytes | memoryview, name: str, max_bytes: int) -> Any:
    """The bare value, not checked yet. Raises CodecError, which begins with `name`, for anything that is not one."""
    if len(payload) > max_bytes:
        raise CodecError(f"{name}: {len(payload)} bytes where at most {max_bytes} are allowed")
    try:
        return _unpack(payload, max_bytes)
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise CodecError(f"{name}: {_one_line(error)}") from error


def converted(fields: Any, message_type: type[M]) -> M:
    """A checked message from its bare fields. Raises CodecError for what is not exactly one valid `message_type`."""
    try:
        return msgspec.convert(fields, message_type, strict=True, dec_hook=_array_from_wire)
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise CodecError(f"{message_type.__name__}: {_one_line(error)}") from error


def decode_header(payload: bytes) -> Header:
    """The header alone, for who counts and times large messages; the rest is not read, and not checked.

    Raises CodecError where the bytes do not begin with a header, as every encoded message does.
    """
    unpacker = msgpack.Unpacker(raw=False, strict_map_key=True, max_array_len=0, max_map_len=_MAX_MAP, max_str_len=256)
    unpacker.feed(payload[:_HEADER_BYTES])
    try:
        unpacker.read_map_header()
        if unpacker.unpack() != "header":
            raise ValueError("does not begin with a header")
        return msgspec.convert(unpacker.unpack(), Header, strict=True)
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise CodecError(f"header: {_one_line(error)}") from error


def _array_to_wire(value: Any) -> dict[str, Any]:
    if not isinstance(value, np.ndarray):
        raise TypeError(f"a {type(value).__name__} where an array is expected")
    if value.dtype.name not in DTYPES:
        raise ValueError(f"dtype {value.dtype} is not one of {', '.join(DTYPES)}")
    data = np.ascontiguousarray(value, dtype=DTYPES[value.dtype.name])
    # No copy: the packer reads the array's own memory.
    return {"dtype": value.dtype.name, "shape": list(value.shape), "data": data.reshape(-1).view(np.uint8).data}


def _array_from_wire(wanted: type, wire: Any) -> np.ndarray:
    if wanted is not np.ndarray or not isinstance(wire, dict) or wire.keys() != _ARRAY_KEYS:
        raise ValueError("an array is a map of dtype, shape and data")
    shape, data = wire["shape"], wire["data"]
    dtype = DTYPES.get(wire["dtype"]) if isinstance(wire["dtype"], str) else None
    if dtype is None:
        raise ValueError(f"the dtype of an array is one of {', '.join(DTYPES)}")
    if not (isinstance(shape, list) and len(shape) <= _MAX_DIMENSIONS and all(map(_is_size, shape))):
        raise ValueError(f"the shape of an array is a list of at most {_MAX_DIMENSIONS} sizes")
    if not isinstance(data, bytes) or math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"the bytes of an array do not fill dtype {dtype.name} and shape {shape}")
    if dtype.kind == "b" and data.strip(b"\0\1"):
        raise ValueError("the bytes of a bool array are 0 or 1")
    return np.frombuffer(data, dtype).reshape(shape)


def _is_size(value: Any) -> bool:
    return type(value) is int and value >= 0


def _unpack(payload: bytes | memoryview, max_bytes: int) -> Any:
    containers = 0

    def count() -> None:
        # A few bytes of nested empty lists cost hundreds once unpacked, so the number of lists and maps is bounded.
        nonlocal containers
        containers += 1
        if containers > _MAX_CONTAINERS:
            raise ValueError(f"more than {_MAX_CONTAINERS} lists and maps")

    def on_list(items: list[Any]) -> list[Any]:
        count()
        return items

    def on_map(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
        count()
        fields = dict(pairs)
        if len(fields) != len(pairs):
            raise ValueError("a key stands twice in a map")
        return fields

    return msgpack.unpackb(
        payload,
        raw=False,
        strict_map_key=True,
        list_hook=on_list,
        object_pairs_hook=on_map,
        ext_hook=_no_extension,
        max_array_len=_MAX_LIST,
        max_map_len=_MAX_MAP,
        max_str_len=_MAX_TEXT,
        max_bin_len=max_bytes,
        max_ext_len=0,
    )


def _no_extension(code: int, data: bytes) -> Any:
    raise ValueError(f"extension type {code}")


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text.encode("ascii", "backslashreplace").decode()[:300]
