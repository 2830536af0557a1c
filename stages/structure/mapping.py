"""Cameras of photographs of which nothing is known: structure from motion by COLMAP, from matches that were found here.

Sources: Schönberger and Frahm, Structure-from-motion revisited (2016), incremental; Pan and others, Global
structure-from-motion revisited (2024), for the second try. pycolmap is imported where it is used.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fieldpose.stages.geometry import Camera
from fieldpose.stages.geometry.arrays import Flags, Indices, Points64, Transforms
from fieldpose.stages.structure.colmap import PIXEL_CENTRE, from_colmap
from fieldpose.stages.structure.features import Keypoints

if TYPE_CHECKING:
    import pycolmap

ENOUGH = 0.8
"""Of the images: with fewer placed one after the other, they are tried all at once as well."""


@dataclass(frozen=True, eq=False)
class Mapped:
    """Where cameras were found to be, in a frame and a unit of their own.

    index: which images, sorted.  camera: theirs, of the size that keypoints were given at.  cam_from_object (k, 4, 4).
    points (m, 3): what they show.  seen (k,): how many of these each shows.  error_px: typical distance of points from
    their keypoints.
    """

    index: Indices
    camera: Camera
    cam_from_object: Transforms
    points: Points64
    seen: Indices
    error_px: float


def map_images(
    keypoints: Sequence[Keypoints],
    pairs: Sequence[tuple[int, int]],
    matches: Sequence[np.ndarray],
    camera: Camera,
    focal_known: bool,
    threads: int,
    report: Callable[[float], None] = lambda share: None,
) -> Mapped | None:
    """Cameras of images by their keypoints and the matches (n, 2) of pairs of them; None where no two fit.

    camera: a guess, one for all images; its focal length and a radial distortion are found. focal_known: whether that
    is better than a guess, as from EXIF. Of parts without a link the largest is given. report: is told the share of the
    images that has a place.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    with tempfile.TemporaryDirectory(prefix="fieldpose-") as folder:
        database = Path(folder) / "images.db"
        _write(database, keypoints, pairs, matches, camera, focal_known)
        placed = 0

        def one_more() -> None:
            nonlocal placed
            placed += 1
            report(min(placed / len(keypoints), 1.0))

        found = pycolmap.incremental_mapping(
            database, folder, folder, _incremental(threads), initial_image_pair_callback=one_more,
            next_image_callback=one_more,
        )  # fmt: skip
        best = _largest(found)
        if best is None or best.num_reg_images() < ENOUGH * len(keypoints):
            other = _largest(_global(database, folder, threads))
            if other is not None and (best is None or other.num_reg_images() > best.num_reg_images()):
                best = other
    report(1.0)
    return None if best is None else _mapped(best, camera)


def overlap(count: int, pairs: Sequence[tuple[int, int]], matches: Sequence[np.ndarray]) -> Flags:
    """Which of so many images share something with another one."""
    shares = np.zeros(count, bool)
    for pair, found in zip(pairs, matches, strict=True):
        if len(found):
            shares[list(pair)] = True
    return shares


def _incremental(threads: int) -> pycolmap.IncrementalPipelineOptions:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.extract_colors = threads, 0, False
    return options


def _global(database: Path, folder: str, threads: int) -> dict[int, pycolmap.Reconstruction]:
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = threads, 0
    try:
        return pycolmap.global_mapping(database, folder, folder, options)
    except (RuntimeError, ValueError):
        return {}


def _largest(found: dict[int, pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    return max(found.values(), key=lambda scene: scene.num_reg_images(), default=None)


def _write(
    path: Path,
    keypoints: Sequence[Keypoints],
    pairs: Sequence[tuple[int, int]],
    matches: Sequence[np.ndarray],
    camera: Camera,
    focal_known: bool,
) -> None:
    """A database of the images, numbered from 1, for COLMAP to map."""
    import pycolmap

    params = [(camera.fx + camera.fy) / 2, camera.cx + PIXEL_CENTRE, camera.cy + PIXEL_CENTRE, camera.distortion[0]]
    lens = pycolmap.Camera(model="SIMPLE_RADIAL", width=camera.width, height=camera.height, params=params)
    lens.has_prior_focal_length = focal_known
    with pycolmap.Database.open(path) as database:
        lens.camera_id = database.write_camera(lens)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(lens.sensor_id)
        rig_id = database.write_rig(rig)
        for i, found in enumerate(keypoints):
            image_id = database.write_image(pycolmap.Image(name=str(i), camera_id=lens.camera_id))
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(database.read_image(image_id).data_id)
            database.write_frame(frame)
            database.write_keypoints(image_id, (found.pixels + PIXEL_CENTRE).astype(np.float32))
        for (i, j), shared in zip(pairs, matches, strict=True):
            if not len(shared):
                continue
            first, second = (keypoints[k].pixels + PIXEL_CENTRE for k in (i, j))
            geometry = pycolmap.estimate_two_view_geometry(lens, first, lens, second, shared.astype(np.uint32))
            database.write_matches(i + 1, j + 1, shared.astype(np.uint32))
            database.write_two_view_geometry(i + 1, j + 1, geometry)


def _mapped(scene: pycolmap.Reconstruction, camera: Camera) -> Mapped:
    images = sorted((image for image in scene.images.values() if image.has_pose), key=lambda image: int(image.name))
    last = np.array([[0.0, 0.0, 0.0, 1.0]])
    (lens,) = {image.camera_id for image in images}
    return Mapped(
        np.array([int(image.name) for image in images]),
        from_colmap(scene.camera(lens), camera),
        np.stack([np.concatenate([image.cam_from_world().matrix(), last]) for image in images]),
        np.array([point.xyz for point in scene.points3D.values()]).reshape(-1, 3),
        np.array([image.num_points3D for image in images]),
        float(scene.compute_mean_reprojection_error()),
    )
