"""Calibrations as their programs write them give the camera that they mean."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fieldpose.errors import SourceError
from fieldpose.stages.camera.camera_files import read_camera_file
from fieldpose.stages.geometry import Camera

TRUE = Camera(640, 480, 520.5, 519.25, 321.0, 238.5, (-0.1, 0.02, 0.001, -0.002, 0.0))
K = [520.5, 0.0, 321.0, 0.0, 519.25, 238.5, 0.0, 0.0, 1.0]
LENS = [-0.1, 0.02, 0.001, -0.002, 0.0]


def ros(model: str = "plumb_bob", lens: list[float] = LENS, matrix: list[float] = K) -> str:
    return (
        f"image_width: 640\nimage_height: 480\ncamera_name: a\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: {matrix}\n"
        f"distortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n  cols: {len(lens)}\n  data: {lens}\n"
        f"rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"
    )


def kalibr(model: str = "radtan", cameras: int = 1) -> str:
    camera = (
        f"  camera_model: pinhole\n  distortion_coeffs: {LENS[:4]}\n  distortion_model: {model}\n"
        "  intrinsics: [520.5, 519.25, 321.0, 238.5]\n  resolution: [640, 480]\n  rostopic: /cam0/image_raw\n"
    )
    return "".join(f"cam{i}:\n{camera}" for i in range(cameras))


def transforms(**changes: object) -> str:
    k1, k2, p1, p2, _ = LENS
    content = {"w": 640, "h": 480, "fl_x": 520.5, "fl_y": 519.25, "cx": 321.5, "cy": 239.0, "k1": k1, "k2": k2}
    return json.dumps(content | {"p1": p1, "p2": p2} | changes)


def ours(**changes: object) -> str:
    content = {"width": 640, "height": 480, "fx": 520.5, "fy": 519.25, "cx": 321.0, "cy": 238.5, "distortion": LENS}
    return json.dumps({name: value for name, value in (content | changes).items() if value is not None})


def opencv(path: Path, lens: list[float] = LENS, fisheye: bool = False) -> Path:
    """As OpenCV's own calibration sample writes it."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    if fisheye:
        storage.write("fisheye_model", 1)
    storage.write("camera_matrix", np.array(K).reshape(3, 3))
    storage.write("distortion_coefficients", np.array(lens).reshape(-1, 1))
    storage.release()
    return path


TEXTS = {
    "ours.json": ours(),
    "byte-order-mark.json": "\ufeff" + ours(),
    "four.json": ours(distortion=LENS[:4]),
    "eight.json": ours(distortion=[*LENS, 0, 0, 0]),
    "transforms.json": transforms(),
    "ros.yaml": ros(),
    "rational.yaml": ros("rational_polynomial", [*LENS, 0.0, 0.0, 0.0]),
    "kalibr.yaml": kalibr(),
    "cameras.txt": "# Camera list\n1 OPENCV 640 480 520.5 519.25 321.5 239 -0.1 0.02 0.001 -0.002\n",
    "full.txt": "7 FULL_OPENCV 640 480 520.5 519.25 321.5 239 -0.1 0.02 0.001 -0.002 0 0 0 0\n",
}


@pytest.mark.parametrize("name", list(TEXTS))
def test_every_kind_gives_the_same_camera(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text(TEXTS[name], encoding="utf-8")
    assert read_camera_file(path) == TRUE


@pytest.mark.parametrize("name", ["calib.yml", "calib.xml", "calib.yaml"])
def test_what_opencv_writes_is_read(tmp_path: Path, name: str) -> None:
    assert read_camera_file(opencv(tmp_path / name)) == TRUE
    assert read_camera_file(opencv(tmp_path / name, [*LENS, 0.0, 0.0, 0.0])) == TRUE


def test_simple_models_of_colmap(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"
    path.write_text("1 SIMPLE_RADIAL 640 480 500 320 240 0.03\n")
    assert read_camera_file(path) == Camera(640, 480, 500.0, 500.0, 319.5, 239.5, (0.03, 0.0, 0.0, 0.0, 0.0))
    path.write_text("1 SIMPLE_PINHOLE 640 480 500 320 240\n")
    assert read_camera_file(path) == Camera(640, 480, 500.0, 500.0, 319.5, 239.5)


BAD = {
    "json": ("a.json", "{", "no usable camera file"),
    "list": ("a.json", "[]", "neither JSON, XML nor YAML with keys"),
    "missing": ("a.json", ours(fx=None), "fx is missing"),
    "unknown": ("a.json", ours(focal=3), "key 'focal' is not known"),
    "rational": ("a.json", ours(distortion=[*LENS, 0.1, 0, 0.2]), "k4, k6 of OpenCV's rational model"),
    "three": ("a.json", ours(distortion=[1, 2, 3]), "3 distortion coefficients; expected one of 0, 4, 5"),
    "half a pixel": ("a.json", ours(width=640.5), "no whole number"),
    "nerf fisheye": ("a.json", transforms(camera_model="OPENCV_FISHEYE"), "fisheye lens, which is not supported"),
    "nerf k4": ("a.json", transforms(k4=0.1), "k4 of OpenCV's rational model"),
    "ros fisheye": ("a.yaml", ros("equidistant", LENS[:4]), "equidistant is a fisheye lens"),
    "ros model": ("a.yaml", ros("ftheta"), "distortion model 'ftheta' is not known"),
    "skewed": ("a.yaml", ros(matrix=[520.5, 2.0, *K[2:]]), "a skew of 2 px"),
    "no matrix": ("a.yaml", "image_width: 3\nimage_height: 4\n", "camera_matrix is missing"),
    "kalibr fisheye": ("a.yaml", kalibr("equidistant"), "fisheye"),
    "two cameras": ("a.yaml", kalibr(cameras=2), "it has 2 cameras; leave the one that is meant"),
    "colmap model": ("a.txt", "1 THIN_PRISM_FISHEYE 640 480 1 2 3 4\n", "THIN_PRISM_FISHEYE is not supported"),
    "colmap short": ("a.txt", "1 OPENCV 640 480 1 2 3 4\n", "OPENCV has 8 parameters, got 4"),
    "colmap words": ("a.txt", "1 PINHOLE 10 10\n", "a camera is its number, model, width, height and parameters"),
    "colmap two": ("a.txt", "1 PINHOLE 6 4 1 1 2 2\n2 PINHOLE 6 4 1 1 2 2\n", "it has 2 cameras"),
    "bomb": ("a.yaml", "a: &a [x,x]\nb: &b [*a,*a]\n" + "c" * (1 << 20), "more than"),
    "code": ("a.yaml", "a: !!python/object/apply:os.system ['true']\n", "no usable camera file"),
    "empty xml": ("a.xml", '<?xml version="1.0"?>\n<opencv_storage>\n</opencv_storage>\n', "camera_matrix is missing"),
}


@pytest.mark.parametrize("case", list(BAD))
def test_what_makes_no_camera_is_told_in_one_line(tmp_path: Path, case: str) -> None:
    name, text, complaint = BAD[case]
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(SourceError) as caught:
        read_camera_file(path)
    assert complaint in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_opencvs_fisheye_is_refused(tmp_path: Path) -> None:
    for name in ("a.yml", "a.xml"):
        with pytest.raises(SourceError, match="fisheye"):
            read_camera_file(opencv(tmp_path / name, LENS[:4], fisheye=True))


@given(st.sampled_from(sorted(TEXTS)), st.data())
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_files_never_do_worse_than_being_refused(tmp_path: Path, name: str, data: st.DataObject) -> None:
    content = bytearray(TEXTS[name].encode())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / name
    path.write_bytes(bytes(content[: data.draw(st.integers(0, len(content)))]))
    try:
        read = read_camera_file(path)
    except SourceError as error:
        read = None
        told = str(error)
    assert isinstance(read, Camera) or str(path) in told
