"""What fuzzing has found, one input of each kind: the reader's own error in one line, and little memory."""

from __future__ import annotations

import json
import resource
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fieldpose.deploy.fuzzing import seeds
from fieldpose.deploy.fuzzing.campaign import Input, judged, write
from fieldpose.deploy.fuzzing.targets import targets
from fieldpose.errors import ConfigError, one_line

_NESTED = b"[" * 100_000


def with_header(change: Callable[[dict[str, Any]], None]) -> Callable[[Input], Input]:
    """A field file with what it says of itself changed."""

    def changed(files: Input) -> Input:
        data = files["f.safetensors"]
        size = int.from_bytes(data[:8], "little")
        header = json.loads(data[8 : 8 + size])
        stated = json.loads(header["__metadata__"]["fieldpose"])
        change(stated)
        header["__metadata__"]["fieldpose"] = json.dumps(stated)
        text = json.dumps(header).encode()
        return {"f.safetensors": struct.pack("<Q", len(text)) + text + data[8 + size :]}

    return changed


def put(name: str, data: bytes) -> Callable[[Input], Input]:
    return lambda files: {**files, name: data}


def bomb(width: int, height: int) -> bytes:
    """A PNG of few bytes that says it is large."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    )


def npy(header: str, data: bytes = b"") -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


_ALIASES = "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
)
_SHAPE = "{'descr': '<f8', 'fortran_order': False, 'shape': (%s, 17), }"
CASES: dict[str, tuple[str, Callable[[Input], Input], str]] = {
    "field of 10^9 levels": ("field", with_header(lambda m: m["config"].update(levels=10**9)), "config.levels"),
    "field of 2^99 entries": ("field", with_header(lambda m: m["config"].update(log2_table=99)), "config.log2_table"),
    "field without a finest": (
        "field",
        with_header(lambda m: m["config"].update(base_resolution=0)),
        "base_resolution",
    ),
    "field of no scale": ("field", with_header(lambda m: m["space"].update(scale=0)), "space.scale"),
    "field that is never marched": ("field", with_header(lambda m: m["space"].update(step=1e-30)), "space.step"),
    "field turned inside out": ("field", with_header(lambda m: m["space"].update(rotation=[1] * 9)), "no rotation"),
    "field with a short pose": (
        "field",
        with_header(lambda m: m["cameras"][0].update(cam_from_object=[1])),
        "no rigid transform",
    ),
    "field with a flat camera": ("field", with_header(lambda m: m["cameras"][0].update(width=0)), "a camera needs"),
    "field of an unknown type": (
        "field",
        lambda files: {k: v.replace(b'"I8"', b'"\\n"') for k, v in files.items()},
        "safetensors",
    ),
    "field of another type": (
        "field",
        lambda files: {k: v.replace(b'"U8"', b'"I8"') for k, v in files.items()},
        "expected U8",
    ),
    "calibration in another code": ("camera", put("camera.yaml", b"\xff\xfe{}"), "no usable camera file"),
    "calibration of aliases": ("camera", put("camera.yaml", _ALIASES.encode()), "write the values out"),
    "calibration beyond floats": (
        "camera",
        put("camera.yaml", b'{"width": 1' + b"0" * 400 + b', "height": 1, "fx": 1, "fy": 1, "cx": 0, "cy": 0}'),
        "no usable camera file",
    ),
    "calibration of broken XML": ("camera", put("camera.yaml", b"<?xml version='1.0'?><a"), "no usable camera file"),
    "calibration nested": ("camera", put("camera.yaml", b"{" + _NESTED[:5000]), "no usable camera file"),
    "LLFF cut off": (
        "dataset/llff",
        put("poses_bounds.npy", npy("{'descr': '<f8', 'shape': (")),
        "not a readable .npy",
    ),
    "LLFF of 10^12 rows": ("dataset/llff", put("poses_bounds.npy", npy(_SHAPE % 10**12)), "0 bytes where"),
    "LLFF of nothing": (
        "dataset/llff",
        put("poses_bounds.npy", npy(_SHAPE.replace("<f8", "|V0") % 10**9)),
        "not a readable .npy",
    ),
    "LLFF with an object": (
        "dataset/llff",
        put("poses_bounds.npy", npy(_SHAPE.replace("<f8", "|O") % 1)),
        "not a readable",
    ),
    "COLMAP of 2^60 images": (
        "dataset/colmap",
        put("sparse/0/images.bin", struct.pack("<Q", 1 << 60)),
        "no COLMAP model that can be read",
    ),
    "COLMAP of 2^60 points": (
        "dataset/colmap",
        put(
            "sparse/0/images.bin",
            struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a\0" + struct.pack("<Q", 1 << 60),
        ),
        "ends within an image",
    ),
    "image of 132 million pixels": ("photo", put("a.png", bomb(12000, 11000)), "are the most"),
    "image of a long side": ("photo", put("a.png", bomb(17000, 2)), "are the most"),
    "image that is a program": (
        "photo",
        put("a.png", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"),
        "not an image",
    ),
    "guess nested": ("guess", put("a.json", _NESTED), "no readable JSON"),
    "guess beyond floats": (
        "guess",
        put("a.json", b'{"cam_from_object": [[1' + b"0" * 400 + b"]]}"),
        "a guess must be",
    ),
    "settings nested": ("settings", lambda _: {"a.json": _NESTED}, "not a JSON file"),
    "settings of no name": ("settings", lambda _: {"a.toml": b'[address]\nobject = "a/b"\n'}, "a part of a key"),
}


@pytest.mark.parametrize("case", CASES)
def test_it_is_refused_in_one_line_and_takes_little_memory(case: str, tmp_path: Path) -> None:
    name, change, said = CASES[case]
    target = targets()[name]
    right = target.seeds(tmp_path / "made")
    # Of COLMAP's the binary one.
    files = right[-1] if name == "dataset/colmap" else right[0]
    write(tmp_path / "folder", change(files), {})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    kind, told = judged(target, tmp_path / "folder")
    assert kind is None
    assert said in told
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 << 10


def test_a_frame_whose_file_says_another_size_takes_no_memory() -> None:
    import numpy as np

    from fieldpose.stages.images import decoded

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert decoded("png", np.frombuffer(bomb(16000, 16000), np.uint8), 32, 24) is None
    assert decoded("png", np.frombuffer(seeds.picture(), np.uint8), seeds.WIDTH, seeds.HEIGHT) is not None
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 << 10


def test_an_error_is_one_line_that_a_terminal_shows_whatever_it_quotes() -> None:
    assert str(ConfigError("a\nb\x1b[2Jc\u2028d\udcff")) == "a b [2Jc d\\udcff"
    assert len(one_line("x" * 10_000)) <= 2001
