"""What `doctor` says of a dataset: cameras that do not fit, axes that were not meant, blurred and turned images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from support import posed_images
from support.papered_room import cameras_before_a_wall, photograph

from fieldpose.deploy.checks import Finding
from fieldpose.deploy.dataset_checks import dataset, share_looking_away, size_of_intrinsics
from fieldpose.stages.geometry import Camera, inverse

CAMERA = Camera(400, 300, 280.0, 280.0, 199.5, 149.5)
TRUTH = cameras_before_a_wall(CAMERA, 18)


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [photograph(CAMERA, pose) for pose in TRUTH.cam_from_object]


def written(
    root: Path, images: list[np.ndarray], opencv_axes: bool = False, camera: Camera = CAMERA, scale: float = 1.0,
    **about: float,
) -> Path:  # fmt: skip
    frames = []
    for i, (pose, image) in enumerate(zip(TRUTH.cam_from_object, images, strict=True)):
        posed_images.save(root / f"images/{i:02d}.png", image)
        placed = pose.copy()
        placed[:3, 3] *= scale
        matrix = inverse(placed).tolist() if opencv_axes else posed_images.opengl(placed)
        frames.append({"file_path": f"images/{i:02d}.png", "transform_matrix": matrix})
    posed_images.write_json(root / "transforms.json", posed_images.intrinsics(camera) | about | {"frames": frames})
    return root


def told(root: Path) -> dict[str, list[Finding]]:
    findings: dict[str, list[Finding]] = {}
    for finding in dataset(root):
        findings.setdefault(finding.what, []).append(finding)
    return findings


def test_a_sound_dataset(tmp_path: Path, images: list[np.ndarray]) -> None:
    findings = told(written(tmp_path, images))
    assert [f.status for f in findings["dataset"]] == ["ok"]
    assert [f.status for f in findings["cameras"]] == ["ok"]
    assert "cameras fit their images" in findings["cameras"][0].detail
    assert "images" not in findings


def test_axes_that_were_not_meant_are_named(tmp_path: Path, images: list[np.ndarray]) -> None:
    (finding,) = told(written(tmp_path, images, opencv_axes=True))["cameras"]
    assert finding.status == "warning"
    assert "object_from_cam in OpenCV's camera axes" in finding.detail


def test_blurred_turned_and_few_images_are_named(tmp_path: Path, images: list[np.ndarray]) -> None:
    root = written(tmp_path, [cv2.GaussianBlur(im, (0, 0), 8) if i == 3 else im for i, im in enumerate(images)])
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(images[5]).save(root / "images/05.png", exif=exif)
    details = [finding.detail for finding in told(root)["images"]]
    assert details == [
        "much less sharp than the others: images/03.png",
        "turned by their EXIF orientation: images/05.png",
    ]
    posed_images.write_transforms(tmp_path / "few", posed_images.CAMERA, 4)
    few = told(tmp_path / "few")["images"]
    assert few[0].status == "warning"
    assert few[0].detail == "few to learn from"


def test_intrinsics_of_larger_images_are_named(tmp_path: Path, images: list[np.ndarray]) -> None:
    larger = Camera(400, 300, 560.0, 560.0, 399.5, 299.5)
    (finding,) = told(written(tmp_path, images, camera=larger))["lens"]
    assert finding.status == "warning"
    assert "of images 2 times as large, 800x600" in finding.detail


@pytest.mark.parametrize(
    ("cx", "cy", "times"), [(199.5, 149.5, None), (210.0, 140.0, None), (99.5, 74.5, 0.5), (99.5, 149.5, None)]
)
def test_crops_and_lenses_off_the_middle_are_not_taken_for_scaled(cx: float, cy: float, times: float | None) -> None:
    assert size_of_intrinsics([Camera(400, 300, 280.0, 280.0, cx, cy)] * 3) == pytest.approx(times)


def test_units_and_copies_are_named(tmp_path: Path, images: list[np.ndarray]) -> None:
    findings = told(written(tmp_path / "mm", [images[0], *images[:-1]], scale=1000.0))
    assert "metres_per_unit 0.001" in findings["places"][0].mend
    assert "images/01.png (as images/00.png)" in findings["images"][0].detail
    (finding,) = told(written(tmp_path / "km", images, scale=1000.0, metres_per_unit=1.0))["places"]
    assert finding.status == "warning"
    assert "places" not in told(written(tmp_path / "right", images, scale=1000.0, metres_per_unit=0.001))


def test_cameras_that_look_away_are_counted() -> None:
    around = np.stack(posed_images.poses_around(12))
    assert share_looking_away(around) == 0
    turned = around.copy()
    turned[:4] = np.diag([-1.0, 1.0, -1.0, 1.0]) @ turned[:4]
    assert share_looking_away(turned) == pytest.approx(4 / 12)
    assert share_looking_away(TRUTH.cam_from_object) == 0
