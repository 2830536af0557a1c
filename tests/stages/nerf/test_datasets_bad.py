"""Every way a dataset can be bad ends in one line that names the file and says what to do."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support import posed_images as made

from fieldpose.errors import DatasetError
from fieldpose.stages.nerf.datasets import load_dataset

SQUARE = made.centred(80, 80, 95.0)
SCALED, FLIPPED, SHEARED = np.diag([2.0, 2, 2, 1]), np.diag([1.0, 1, -1, 1]), np.eye(4) + 0.02 * np.eye(4, k=1)
PROJECTIVE = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0.1, 1]])
TRAIN, TRANSFORMS = "transforms_train.json", "transforms.json"
Break = Callable[[Path], object]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def resave(path: Path, width: int, height: int, channels: int) -> None:
    made.save(path, np.full((height, width, channels), 90, np.uint8))


def text(path: Path, content: str) -> None:
    path.write_text(content)


def frame(name: str, **changes: object) -> Break:
    return lambda root: made.edit_frame(root / name, 1, **changes)


def whole(name: str, **changes: object) -> Break:
    return lambda root: made.edit_json(root / name, **changes)


def matrix(values: np.ndarray) -> Break:
    return frame(TRAIN, transform_matrix=values.tolist())


def without(name: str, *keys: str) -> Break:
    def remove(root: Path) -> None:
        content = json.loads((root / name).read_text())
        made.write_json(root / name, {key: value for key, value in content.items() if key not in keys})

    return remove


def poses_bounds(edit: Callable[[np.ndarray], np.ndarray | None]) -> Break:
    def change(root: Path) -> None:
        table = np.load(root / "poses_bounds.npy")
        changed = edit(table)
        np.save(root / "poses_bounds.npy", table if changed is None else changed)

    return change


def put(row: int, column: int, value: float) -> Break:
    return poses_bounds(lambda table: np.put(table[row], column, value))


BLENDER: dict[str, tuple[Break, str]] = {
    "missing image": (lambda r: (r / "train/r_1.png").unlink(), r"train/r_1: no such image, but transforms_train"),
    "missing test image": (
        lambda r: (r / "test/r_1.png").unlink(),
        r"test/r_1: no such image, but transforms_test",
    ),
    "image is text": (lambda r: text(r / "train/r_2.png", "hello"), r"r_2\.png: cannot be read \(not an image\)"),
    "empty image": (lambda r: (r / "train/r_2.png").write_bytes(b""), r"r_2\.png: cannot be read"),
    "other size": (lambda r: resave(r / "train/r_2.png", 40, 40, 4), r"r_2\.png: the image has 40x40 .* 80x80"),
    "one without alpha": (lambda r: resave(r / "train/r_2.png", 80, 80, 3), r"r_2\.png: the image has no alpha"),
    "scaled pose": (matrix(SCALED), r"train\.json: frame \./train/r_1: .*not rigid .*2\.0, 2\.0, 2\.0"),
    "mirrored pose": (matrix(FLIPPED), r"frame \./train/r_1: .*not rigid .*determinant -1"),
    "sheared pose": (matrix(SHEARED), r"frame \./train/r_1: .*not rigid"),
    "projective pose": (matrix(PROJECTIVE), r"frame \./train/r_1: .*not rigid .*last row \[0.0, 0.0, 0.1, 1.0\]"),
    "NaN pose": (matrix(np.full((4, 4), np.nan)), r"frame \./train/r_1: .*not finite"),
    "small matrix": (matrix(np.eye(3)), r"frame \./train/r_1: transform_matrix must be 4x4"),
    "matrix of text": (
        frame(TRAIN, transform_matrix="identity"),
        r"transforms_train\.json: not as expected .*frames",
    ),
    "not JSON": (lambda r: text(r / TRAIN, "{'frames': []"), r"transforms_train\.json: not valid JSON"),
    "not text": (lambda r: (r / TRAIN).write_bytes(b"\xff\xfe\x00"), r"train\.json: not readable as text"),
    "a list": (lambda r: text(r / TRAIN, "[]"), r"transforms_train\.json: not as expected"),
    "deep nesting": (lambda r: text(r / TRAIN, "[" * 100_000), r"transforms_train\.json: not valid JSON"),
    "no frames key": (without(TRAIN, "frames"), r"transforms_train\.json: not as expected .*frames"),
    "no frames": (whole(TRAIN, frames=[]), r"transforms_train\.json: it has no frames"),
    "no focal length": (without(TRAIN, "camera_angle_x"), r"train\.json: frame .*no focal length"),
    "impossible angle": (whole(TRAIN, camera_angle_x=4.0), r"train\.json: frame .*between 0 and pi"),
    "listed twice": (frame(TRAIN, file_path="./train/r_0"), r"train\.json: train/r_0\.png is listed twice"),
    "box upside down": (whole(TRAIN, aabb=[[1, 1, 1], [0, 0, 0]]), r"train\.json: aabb must be"),
    "box of two": (whole(TRAIN, aabb=[[0, 0], [1, 1]]), r"train\.json: not as expected"),
    "no scale": (whole(TRAIN, metres_per_unit=0), r"train\.json: metres_per_unit must be positive"),
    "missing depth": (
        frame(TRAIN, depth_file_path="d.png", depth_scale=1),
        r"d\.png: no such file, but transforms_tr",
    ),
    "depth of no length": (
        frame(TRAIN, depth_file_path="train/r_1.png", depth_scale=-1),
        r"frame \./train/r_1: .*depth_scale",
    ),
    "misspelt key": (whole(TRAIN, f1_x=100.0), r"train\.json: 'f1_x' is no key of this file; is 'fl_x' meant\?"),
    "misspelt key of a frame": (frame(TRAIN, transform_matrx=[]), r"frame 1: 'transform_matrx' .*'transform_matrix'"),
    "rational lens": (whole(TRAIN, k5=0.01), r"train\.json: k5 is 0\.01, which is not supported"),
    "rolling shutter": (frame(TRAIN, rolling_shutter=[0.1, 0, 0]), r"frame 1: rolling_shutter is \[0\.1, 0, 0\]"),
    "absurd focal length": (whole(TRAIN, fl_x=1e5), r"train\.json: frame .*100000 px sees .* degrees across 80 px"),
    "absurdly short one": (whole(TRAIN, fl_x=0.9), r"train\.json: frame .*0\.9 px sees 177 degrees"),
    "pointer of Git LFS": (
        lambda r: text(r / TRAIN, "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"),
        r"train\.json: a pointer of Git LFS instead of the file itself; fetch it by `git lfs pull`",
    ),
    "missing mask": (frame(TRAIN, mask_file_path="m.png"), r"m\.png: no such file, but transforms_train\.json"),
}
TRANSFORMS_JSON: dict[str, tuple[Break, str]] = {
    "missing image": (
        lambda r: (r / "images/0001.png").unlink(),
        r"images/0001\.png: no such image, but transforms",
    ),
    "size that is not stated": (
        lambda r: resave(r / "images/0003.png", 48, 32, 3),
        r"0003\.png: the image has 48x32 pixels but transforms\.json says 96x64",
    ),
    "fisheye model": (
        whole(TRANSFORMS, camera_model="OPENCV_FISHEYE"),
        r"camera_model OPENCV_FISHEYE is not supported",
    ),
    "fisheye frame": (
        frame(TRANSFORMS, camera_model="EQUIRECTANGULAR"),
        r"frame images/0001\.png: camera_model EQUI",
    ),
    "fisheye flag": (whole(TRANSFORMS, is_fisheye=True), r"is_fisheye is not supported; undistort"),
    "fisheye coefficient": (whole(TRANSFORMS, k4=0.01), r"k4 belongs to a fisheye lens"),
    "NaN intrinsics": (whole(TRANSFORMS, cx=float("nan")), r"frame images/0000\.png: a camera needs finite"),
    "lens of instant-ngp": (whole(TRANSFORMS, ftheta_p0=0.5), r"ftheta_p0 is 0\.5, .*; undistort the images"),
    "panorama": (frame(TRANSFORMS, latlong=True), r"frame 1: latlong is True, which is not supported"),
    "axes of Mitsuba": (whole(TRANSFORMS, from_mitsuba=True), r"from_mitsuba is True, .*; write poses in OpenGL's"),
    "axes of another": (whole(TRANSFORMS, from_na=True), r"from_na is True, which is not supported; write poses in"),
    "negative focal length": (whole(TRANSFORMS, fl_y=-3.0), r"frame images/0000\.png: a camera needs .* positive"),
    "text as number": (whole(TRANSFORMS, fl_x="110"), r"transforms\.json: not as expected .*fl_x"),
    "folding distortion": (whole(TRANSFORMS, k1=-3.0), r"frame images/0000\.png: the distortion .* has no inverse"),
    "split without frame": (whole(TRANSFORMS, test_filenames=["images/77.png"]), r"images/77\.png is in a split"),
    "empty split": (whole(TRANSFORMS, test_filenames=["images/0000.png"]), r"the train split is empty"),
}
LLFF: dict[str, tuple[Break, str]] = {
    "image too many": (lambda r: resave(r / "images/z.png", 192, 128, 3), r"10 poses but images has 11 images"),
    "pose too many": (poses_bounds(lambda t: np.vstack([t, t[:1]])), r"11 poses but images has 10 images"),
    "wrong width": (poses_bounds(lambda t: t[:, :15]), r"poses_bounds\.npy: expected 17 numbers .*\(10, 15\)"),
    "flat": (poses_bounds(lambda t: t.ravel()), r"poses_bounds\.npy: expected 17 numbers"),
    "complex": (poses_bounds(lambda t: t.astype(complex)), r"poses_bounds\.npy: expected 17 numbers .*complex"),
    "empty": (poses_bounds(lambda t: t[:0]), r"poses_bounds\.npy: it has no poses"),
    "truncated": (lambda r: truncate(r / "poses_bounds.npy"), r"poses_bounds\.npy: not a readable \.npy"),
    "text": (lambda r: text(r / "poses_bounds.npy", "x"), r"poses_bounds\.npy: not a readable \.npy"),
    "pickled": (
        lambda r: np.save(r / "poses_bounds.npy", np.array([{}])),
        r"poses_bounds\.npy: not a readable \.npy",
    ),
    "NaN": (put(2, 0, np.nan), r"poses_bounds\.npy: image 2: .*not finite"),
    "not rigid": (put(3, 0, 7.0), r"poses_bounds\.npy: image 3: .*not rigid"),
    "no focal length": (put(4, 14, 0.0), r"poses_bounds\.npy: image 4: height, width and focal length"),
    "bounds reversed": (put(5, 15, 99.0), r"poses_bounds\.npy: image 5: expected depths 0 < near < far"),
    "bounds negative": (put(5, 15, -1.0), r"poses_bounds\.npy: image 5: expected depths 0 < near < far"),
    "no folder": (lambda r: (r / "images").rename(r / "photos"), r"no folder images, images_4 or images_8"),
    "other shape": (lambda r: resave(r / "images/image004.png", 128, 128, 3), r"image004\.png: .*not the shape"),
    "unreadable image": (lambda r: text(r / "images/image004.png", "x"), r"image004\.png: cannot be read"),
}


def assert_refused(root: Path, message: str, **options: object) -> None:
    with pytest.raises(DatasetError, match=message) as caught:
        load_dataset(root, **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert str(root) in str(caught.value)


@pytest.mark.parametrize("case", BLENDER)
def test_bad_blender(tmp_path: Path, case: str) -> None:
    made.write_blender(tmp_path, SQUARE)
    load_dataset(tmp_path)
    damage, message = BLENDER[case]
    damage(tmp_path)
    assert_refused(tmp_path, message)


@pytest.mark.parametrize("case", TRANSFORMS_JSON)
def test_bad_transforms(tmp_path: Path, case: str) -> None:
    made.write_transforms(tmp_path, made.CAMERA)
    load_dataset(tmp_path)
    damage, message = TRANSFORMS_JSON[case]
    damage(tmp_path)
    assert_refused(tmp_path, message)


@pytest.mark.parametrize("case", LLFF)
def test_bad_llff(tmp_path: Path, case: str) -> None:
    made.write_llff(tmp_path, made.centred(192, 128, 200.0), factors=(1,))
    load_dataset(tmp_path)
    damage, message = LLFF[case]
    damage(tmp_path)
    assert_refused(tmp_path, message)


def test_llff_without_images_of_that_size(tmp_path: Path) -> None:
    made.write_llff(tmp_path, made.centred(192, 128, 200.0), factors=(1, 4))
    assert_refused(tmp_path, "no images at downscale 2; there are 1, 4", downscale=2)
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    assert_refused(tmp_path, "images: it has no images")


def test_sizes_that_differ_where_none_is_stated(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, made.CAMERA)
    without(TRANSFORMS, "w", "h")(tmp_path)
    resave(tmp_path / "images/0003.png", 48, 32, 3)
    assert_refused(tmp_path, r"0003\.png: the image has 48x32 pixels, others have 96x64")


def test_all_images_deleted(tmp_path: Path) -> None:
    made.write_transforms(tmp_path, made.CAMERA, count=3)
    for i in range(3):
        made.edit_frame(tmp_path / TRANSFORMS, i, sharpness=3.0)
        (tmp_path / f"images/{i:04d}.png").unlink()
    assert_refused(tmp_path, r"transforms\.json: none of its 3 images is there")


def test_folders_that_are_no_dataset(tmp_path: Path) -> None:
    assert_refused(
        tmp_path, "not a dataset; expected transforms_train.json, transforms.json, poses_bounds.npy, a COLMAP model"
    )
    assert_refused(tmp_path / "nowhere", "no such folder")
    text(tmp_path / "file.json", "{}")
    assert_refused(tmp_path / "file.json", "a file; give the folder")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_truncated_images_are_found_when_they_are_decoded(tmp_path: Path, suffix: str) -> None:
    made.write_blender(tmp_path, SQUARE, channels=3)
    (tmp_path / "train/r_3.png").unlink()
    path = tmp_path / f"train/r_3{suffix}"
    made.save(path, np.random.default_rng(0).integers(0, 255, (80, 80, 3), np.uint8))
    truncate(path)
    with pytest.raises(DatasetError, match=rf"r_3\{suffix}: cannot be read .*; restore the file") as caught:
        load_dataset(tmp_path).load_images()
    assert "\n" not in str(caught.value)


def test_depth_of_the_wrong_shape(tmp_path: Path) -> None:
    made.write_blender(tmp_path, SQUARE)
    frame(TRAIN, depth_file_path="test/r_0.png", depth_scale=1)(tmp_path)
    with pytest.raises(DatasetError, match=r"r_0\.png: expected one depth a pixel, got shape \(80, 80, 4\)"):
        load_dataset(tmp_path).load_depth(1)
    text(tmp_path / "d.npy", "x")
    frame(TRAIN, depth_file_path="d.npy", depth_scale=1)(tmp_path)
    with pytest.raises(DatasetError, match=r"d\.npy: not a readable \.npy"):
        load_dataset(tmp_path).load_depth(1)
