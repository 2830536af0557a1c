"""Small right inputs of every kind, to be made wrong."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from fieldpose.deploy.fuzzing.campaign import Input
from fieldpose.stages.geometry import inverse, look_at

WIDTH, HEIGHT, FOCAL = 32, 24, 30.0
_COUNT = 3
_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def picture(kind: str = "PNG", mode: str = "RGB", size: tuple[int, int] = (WIDTH, HEIGHT), **options: Any) -> bytes:
    """An image file of noise."""
    channels = {"RGB": (3,), "RGBA": (4,), "L": (), "I;16": ()}[mode]
    dtype = np.uint16 if mode == "I;16" else np.uint8
    pixels = np.random.default_rng(0).integers(0, 256, (size[1], size[0], *channels)).astype(dtype)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **options)
    return file.getvalue()


def images() -> list[Input]:
    """Of every format, with EXIF."""
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 28
    told: dict[str, Any] = {"exif": exif.tobytes()}
    return [
        {"a.png": picture("JPEG", **told)}, {"a.png": picture("PNG", "RGBA", **told)},
        {"a.png": picture("PNG", "I;16")}, {"a.png": picture("WEBP")}, {"a.png": picture("BMP")},
        {"a.png": picture("TIFF", **told)},
        {"a.png": picture("TIFF", compression="tiff_lzw")}, {"a.png": picture("JPEG", progressive=True)},
    ]  # fmt: skip


def _poses() -> list[np.ndarray]:
    angles = np.linspace(0.0, 1.5, _COUNT)
    return [look_at((4 * np.cos(a), 4 * np.sin(a), 1.0), np.zeros(3), (0, 0, 1)) for a in angles]


def _rows(matrix: np.ndarray) -> str:
    return "".join(" ".join(f"{v:.6f}" for v in row) + "\n" for row in matrix)


def _quaternion(object_from_cam: np.ndarray) -> list[float]:
    from scipy.spatial.transform import Rotation

    return [float(v) for v in Rotation.from_matrix(object_from_cam[:3, :3]).as_quat()]


def _json(content: object) -> bytes:
    return json.dumps(content).encode()


def _with_pictures(files: Mapping[str, bytes], names: list[str]) -> list[Input]:
    seen = picture()
    return [{**files, **dict.fromkeys(names, seen)}]


def _frames(folder: str) -> list[dict[str, Any]]:
    poses = [(inverse(pose) @ _GL).tolist() for pose in _poses()]
    return [{"file_path": f"{folder}/{i}.png", "transform_matrix": pose} for i, pose in enumerate(poses)]


def transforms() -> list[Input]:
    """As instant-ngp and nerfstudio write them."""
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": 16.0, "cy": 12.0, "k1": 0.01, "k2": 0.0}
    told = {"aabb": [[-1, -1, -1], [1, 1, 1]], "train_filenames": ["images/0.png"], "metres_per_unit": 1.0}
    names = [f"images/{i}.png" for i in range(_COUNT)]
    return [
        *_with_pictures({"transforms.json": _json({**lens, "frames": _frames("images")})}, names),
        *_with_pictures({"transforms.json": _json({**lens, **told, "frames": _frames("images")})}, names),
    ]


def blender() -> list[Input]:
    """As NeRF-synthetic has it."""
    splits = ("train", "test")
    files = {f"transforms_{s}.json": _json({"camera_angle_x": 0.98, "frames": _frames(f"./{s}")}) for s in splits}
    return _with_pictures(files, [f"{split}/{i}.png" for split in splits for i in range(_COUNT)])


def llff() -> list[Input]:
    """poses_bounds.npy."""
    table = []
    for pose in _poses():
        right, down, forward, position = inverse(pose)[:3].T
        columns = [down, right, -forward, position, (HEIGHT, WIDTH, FOCAL)]
        table.append([*np.stack(columns, axis=1).ravel(), 3.0, 30.0])
    file = io.BytesIO()
    np.save(file, np.array(table))
    return _with_pictures({"poses_bounds.npy": file.getvalue()}, [f"images/{i}.png" for i in range(_COUNT)])


def colmap() -> list[Input]:
    """As text and as binary, of the model PINHOLE, number 1; each image has one point."""
    lens = (FOCAL, FOCAL, 16.0, 12.0)
    binary = struct.pack("<Q", 1) + struct.pack("<IiQQ4d", 1, 1, WIDTH, HEIGHT, *lens), struct.pack("<Q", _COUNT)
    cameras, images = "# cameras\n1 PINHOLE 32 24 30 30 16 12\n", "# images\n"
    cameras_bin, images_bin = binary
    for i, pose in enumerate(_poses()):
        x, y, z, w = _quaternion(pose)
        numbers = (w, x, y, z, *pose[:3, 3].tolist())
        images += f"{i + 1} {' '.join(map(str, numbers))} 1 {i}.png\n1.0 2.0 -1\n"
        images_bin += struct.pack("<I7dI", i + 1, *numbers, 1) + f"{i}.png".encode() + b"\0"
        images_bin += struct.pack("<Qddq", 1, 1.0, 2.0, -1)
    names = [f"images/{i}.png" for i in range(_COUNT)]
    text = {"sparse/0/cameras.txt": cameras.encode(), "sparse/0/images.txt": images.encode()}
    return [
        *_with_pictures(text, names),
        *_with_pictures({"sparse/0/cameras.bin": cameras_bin, "sparse/0/images.bin": images_bin}, names),
    ]


def tum() -> list[Input]:
    """Named after a camera, as the folder is."""
    truth, rgb, depth = "# timestamp tx ty tz qx qy qz qw\n", "", ""
    for i, pose in enumerate(_poses()):
        there = inverse(pose)
        truth += " ".join(f"{v:.6f}" for v in (100 + 0.04 * i, *there[:3, 3], *_quaternion(there))) + "\n"
        rgb += f"{100 + 0.04 * i:.6f} rgb/{i}.png\n"
        depth += f"{100 + 0.04 * i:.6f} depth/{i}.png\n"
    files = {"groundtruth.txt": truth, "rgb.txt": rgb, "depth.txt": depth, "camera.json": _camera_json()}
    names = [f"rgb/{i}.png" for i in range(_COUNT)]
    deep = {f"depth/{i}.png": picture(mode="I;16") for i in range(_COUNT)}
    return _with_pictures({**{name: text.encode() for name, text in files.items()}, **deep}, names)


def seven_scenes() -> list[Input]:
    """Two sequences."""
    files: Input = {"TrainSplit.txt": b"sequence1\n", "TestSplit.txt": b"sequence2\n"}
    names = []
    for sequence in ("seq-01", "seq-02"):
        for i, pose in enumerate(_poses()):
            files[f"{sequence}/frame-{i:06d}.pose.txt"] = _rows(inverse(pose)).encode()
            names.append(f"{sequence}/frame-{i:06d}.color.png")
    return _with_pictures(files, names)


def bop() -> list[Input]:
    """A scene of one object."""
    cameras, instances = {}, {}
    for i, pose in enumerate(_poses()):
        cameras[str(i)] = {"cam_K": [FOCAL, 0, 15.5, 0, FOCAL, 11.5, 0, 0, 1], "depth_scale": 0.5}
        cameras[str(i)] |= {"cam_R_w2c": pose[:3, :3].ravel().tolist(), "cam_t_w2c": (1e3 * pose[:3, 3]).tolist()}
        own = {"cam_R_m2c": pose[:3, :3].ravel().tolist(), "cam_t_m2c": (1e3 * pose[:3, 3]).tolist()}
        instances[str(i)] = [{"obj_id": 5, **own}]
    files = {"scene_camera.json": _json(cameras), "scene_gt.json": _json(instances)}
    masks = {f"mask_visib/{i:06d}_000000.png": picture(mode="L") for i in range(_COUNT)}
    return _with_pictures({**files, **masks}, [f"rgb/{i:06d}.png" for i in range(_COUNT)])


def record3d() -> list[Input]:
    """An export with one camera, and one with a camera an image."""
    poses = [inverse(pose) @ _GL for pose in _poses()]
    told = [[*_quaternion(pose), *pose[:3, 3].tolist()] for pose in poses]
    content = {"poses": told, "w": WIDTH, "h": HEIGHT, "fps": 60, "K": [FOCAL, 0, 0, 0, FOCAL, 0, 16, 12, 1]}
    each = {**content, "perFrameIntrinsicCoeffs": [[FOCAL, FOCAL, 16, 12]] * _COUNT}
    names = [f"rgb/{i}.png" for i in range(_COUNT)]
    return [*_with_pictures({"metadata.json": _json(content)}, names),
            *_with_pictures({"metadata.json": _json(each)}, names)]  # fmt: skip


def polycam() -> list[Input]:
    """Raw data."""
    files: Input = {}
    for i, pose in enumerate(_poses()):
        stored = inverse(pose) @ _GL
        content = {f"t_{row}{column}": float(stored[row, column]) for row in range(3) for column in range(4)}
        content |= {"fx": FOCAL, "fy": FOCAL, "cx": 16, "cy": 12, "width": WIDTH, "height": HEIGHT, "timestamp": i}
        files[f"keyframes/cameras/{i}.json"] = _json(content)
    return _with_pictures(files, [f"keyframes/images/{i}.png" for i in range(_COUNT)])


def _camera_json() -> str:
    lens = {"fx": FOCAL, "fy": FOCAL, "cx": 15.5, "cy": 11.5, "distortion": [0.01, 0, 0, 0, 0]}
    return json.dumps({"width": WIDTH, "height": HEIGHT, **lens})


_ROS = """image_width: 32
image_height: 24
camera_name: a
camera_matrix:
  rows: 3
  cols: 3
  data: [30., 0., 15.5, 0., 30., 11.5, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, 0., 0., 0., 0.]
"""
_OPENCV = """%YAML:1.0
---
image_width: 32
image_height: 24
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 30., 0., 15.5, 0., 30., 11.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0.1, 0., 0., 0., 0. ]
"""
_XML = """<?xml version="1.0"?>
<opencv_storage>
<image_width>32</image_width>
<image_height>24</image_height>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
<data>30. 0. 15.5 0. 30. 11.5 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix"><rows>1</rows><cols>5</cols><dt>d</dt>
<data>0.1 0. 0. 0. 0.</data></distortion_coefficients>
</opencv_storage>
"""
_KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [30.0, 30.0, 15.5, 11.5]
  resolution: [32, 24]
"""


def cameras() -> list[Input]:
    """Calibrations of every program; the name of COLMAP's ends in .txt."""
    content = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "cx": 16, "cy": 12, "k1": 0.1, "frames": []}
    texts = (_camera_json(), _ROS, _OPENCV, _XML, _KALIBR, json.dumps(content))
    colmap_text = b"# Camera list\n1 OPENCV 32 24 30 30 16 12 0.1 0 0 0\n"
    return [*({"camera.yaml": text.encode()} for text in texts), {"cameras.txt": colmap_text}]


def settings() -> list[Input]:
    """TOML and JSON."""
    toml = (
        '[matching]\nmatcher = "sift"\n[tracking]\nguess = "train:a"\n[camera]\nsize = 320\n[address]\nobject = "a"\n'
    )
    content = {"matching": {"matcher": "sift"}, "camera": {"rate_hz": 3.5}, "objects": {"a": {"field": "a"}}}
    return [{"a.toml": toml.encode()}, {"a.json": _json(content)}]


def guesses() -> list[Input]:
    """Of one start, and of every frame."""
    pose = _poses()[0].tolist()
    return [{"a.json": _json({"cam_from_object": pose})}, {"a.json": _json({"frames": {"0": pose, "7": pose}})}]


def field_files(folder: Path) -> list[Input]:
    """A tiny field with descriptors."""
    from fieldpose.stages.geometry import Camera
    from fieldpose.stages.nerf.config import FieldConfig
    from fieldpose.stages.nerf.field import Field, new_net
    from fieldpose.stages.nerf.metadata import CameraFit, FieldMetadata, PoseAccuracy, Space, TrainingCamera

    config = FieldConfig(levels=2, log2_table=4, hidden=4, features=3, colour_hidden=4, occupancy_resolution=8)
    rng = np.random.default_rng(0)
    lens = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, 15.5, 11.5)
    views = [
        TrainingCamera(f"{i}.png", lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, lens.distortion,
                       tuple(pose.ravel().tolist()))
        for i, pose in enumerate(_poses())
    ]  # fmt: skip
    fit = CameraFit("adjusted", 400, (30.0, 31.0), 2.0, 1.0, (0.1, 0.2), (0.1, 0.2))
    metadata = FieldMetadata(
        Space(True, (0.0, 0.0, 0.0), 0.5, box=(-1, -1, -1, 1, 1, 1)), config, (1.0, 1.0, 1.0), views, "a", "ab",
        psnr_db=30.0, accuracy=PoseAccuracy(4, 4, 0.1, 0.1, 2.0), camera_fit=fit, error_scale=2.0,
    )  # fmt: skip
    looks = rng.integers(-99, 99, (_COUNT, 2, 64)).astype(np.int8)
    folder.mkdir(parents=True)
    Field(metadata, new_net(config, rng), rng.random((8, 8, 8)) < 0.3, looks).save(folder / "f.safetensors")
    return [{"f.safetensors": (folder / "f.safetensors").read_bytes()}]
