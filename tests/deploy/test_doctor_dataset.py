"""What `doctor` says of a dataset: cameras that do not fit, axes that were not meant, blurred and turned images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from support import posed_images
from support.papered_room import cameras_before_a_wall, photograph

from fieldpose.deploy import checks
from fieldpose.stages.geometry import Camera, inverse

CAMERA = Camera(400, 300, 280.0, 280.0, 199.5, 149.5)
TRUTH = cameras_before_a_wall(CAMERA, 18)


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [photograph(CAMERA, pose) for pose in TRUTH.cam_from_object]


def written(root: Path, images: list[np.ndarray], opencv_axes: bool = False) -> Path:
    frames = []
    for i, (pose, image) in enumerate(zip(TRUTH.cam_from_object, images, strict=True)):
        posed_images.save(root / f"images/{i:02d}.png", image)
        matrix = inverse(pose).tolist() if opencv_axes else posed_images.opengl(pose)
        frames.append({"file_path": f"images/{i:02d}.png", "transform_matrix": matrix})
    posed_images.write_json(root / "transforms.json", posed_images.intrinsics(CAMERA) | {"frames": frames})
    return root


def told(root: Path) -> dict[str, list[checks.Finding]]:
    findings: dict[str, list[checks.Finding]] = {}
    for finding in checks.dataset(root):
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
