"""From a video or photographs of an object to a dataset: frames chosen, cameras found, a frame of reference, files."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from fieldpose.deploy.reporting.boxes import boxed, sheet
from fieldpose.deploy.reporting.output import write_bytes, write_json
from fieldpose.deploy.reporting.overlay import captioned, encoded
from fieldpose.deploy.shots import FILMED_S, IMAGES, MASKS, Report, Shot, Shots, read_shots
from fieldpose.errors import DatasetError, GeometryError, OutputError
from fieldpose.stages.cores import usable_cores
from fieldpose.stages.geometry import Camera, scale_pixels
from fieldpose.stages.images import shrunk
from fieldpose.stages.nerf.datasets.intrinsics import check_invertible
from fieldpose.stages.nerf.datasets.transforms import FILE
from fieldpose.stages.nerf.datasets.writing import transforms_document

if TYPE_CHECKING:
    from fieldpose.stages.structure.features import Keypoints
    from fieldpose.stages.structure.mapping import Mapped
    from fieldpose.stages.structure.markers import Marker

CAMERA_FILE = "camera.json"
OBJECT_PICTURE = "object.jpg"
_PICTURES = 6
_THUMBNAILS, _ACROSS, _THUMBNAIL_PX = 24, 6, 200
HELD_OUT_EVERY = 10
"""One in so many images is not learnt from, and tells how good the field is."""
FEWEST = 8
"""Images that a field can be learnt from at all, and still few."""
ENOUGH = 0.8
"""Of the images are to find a place; else the reasons are told."""
_NEIGHBOURS = 8
"""Frames of a video that each is matched with: those that came before it."""
_ALL_PAIRS = 80
"""So many photographs are each matched with each other one; of more, each with those that look most like it."""
_LOOKALIKES = 25
_UNSURE_FOCAL = 1.2
"""Focal length over the longer side that is taken where nothing tells it: 45 degrees, about that of phones."""
_FEW_KEYPOINTS = 150


@dataclass(frozen=True)
class Captured:
    """A dataset that was made, in figures; `reasons` of the images without a place: name -> why.

    on_plane: whether up is that of a plane. marker: the one that gave frame and unit, and how many images show it.
    object_aabb: lowest and highest corner of a box around what the cameras look at, None where nothing stands apart.
    """

    images: int
    chosen: int
    blurred: int
    seen: int
    reasons: dict[str, str]
    camera: Camera
    error_px: float
    on_plane: bool
    metres_per_unit: float | None
    marker: tuple[int, int] | None = None
    object_aabb: tuple[tuple[float, ...], ...] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Square:
    """Markers that may be in view: their family (stages/structure/markers.py), the length of a side in metres."""

    family: str
    size_m: float


def capture(
    source: str, out: Path, most: int, size: int, threads: int = 0, report: Report = lambda what, share: None,
    square: Square | None = None, seconds: float = FILMED_S,
) -> Captured:  # fmt: skip
    """Write a dataset of a source (a video, a folder of photographs, or any camera source) into a folder.

    At most `most` frames of a video are taken, and images are shrunk to `size`. A live camera films for so many
    seconds, or until Ctrl-C. square: a marker in view that gives the frame, z out of it, and metres. Raises SourceError
    where the source cannot be read, and DatasetError where too few cameras are found, or no such marker, which tells
    why; then nothing is written.
    """
    filming = out.with_name(f"{out.name}.filming.jpg")
    try:
        shots = read_shots(source, most, size, seconds, report, partial(_show_kept, filming))
    finally:
        filming.unlink(missing_ok=True)
    if len(shots.chosen) < FEWEST:
        blurred = f"; {len(shots.blurred)} were left out as blurred, so move slowly" if shots.blurred else ""
        film = "film longer, moving around the object, in a good light; frames without motion or texture are left out"
        more = f"{film}{blurred}" if shots.follow else "take more photographs, from all around the object"
        raise DatasetError(
            f"{source}: of {shots.seen} images {len(shots.chosen)} can be used, but at least {FEWEST} are needed;"
            f" {more}"
        )
    threads = threads or usable_cores()
    structure = Structure(shots, threads, report)
    mapped = structure.map()
    if mapped is None or len(mapped.index) < FEWEST:
        count = 0 if mapped is None else len(mapped.index)
        why = structure.why_not(mapped)
        raise DatasetError(
            f"{source}: cameras of only {count} of {len(shots.chosen)} images were found ({summary(why)});"
            f" {advice(why)}"
        )
    marker = None if square is None else structure.marker(mapped, square)
    try:
        check_invertible(mapped.camera)
    except GeometryError as error:
        raise DatasetError(
            f"{source}: the lens that was found folds the images' corners over ({error}); film with a lens that is less"
            " wide, or in the camera's linear mode"
        ) from error
    return _write(out, shots, mapped, structure, marker, report)


def _show_kept(path: Path, kept: Sequence[Shot], blurred: int) -> None:
    """A picture of what a camera has filmed so far, evenly along its way."""
    some = [kept[i] for i in np.unique(np.linspace(0, len(kept) - 1, min(_THUMBNAILS, len(kept))).astype(int))]
    pictures = [shrunk(shot.image(), _THUMBNAIL_PX) for shot in some]
    told = f"{len(kept)} frames kept, {blurred} blurred"
    # No reason to stop filming.
    with suppress(OutputError):
        write_bytes(path, encoded(captioned(sheet(pictures, _ACROSS, _THUMBNAIL_PX), [told]), path))


def summary(why: dict[str, str]) -> str:
    """How many images are without a place for which reason."""
    counts = {reason: list(why.values()).count(reason) for reason in dict.fromkeys(why.values())}
    return ", ".join(f"{count} {reason}" for reason, count in counts.items())


def advice(why: dict[str, str]) -> str:
    """What to film anew, by the commonest reason."""
    reasons = list(why.values())
    commonest = max(set(reasons), key=reasons.count) if reasons else NO_OVERLAP
    return _ADVICE[commonest]


BLURRED, TOO_LITTLE, NO_OVERLAP, NO_PLACE = "blurred", "with too little texture", "without overlap", "without a place"
_ADVICE = {
    BLURRED: "film them again with more light, or moving more slowly",
    TOO_LITTLE: "put the object on something with print on it, like a newspaper, so that there is something to match",
    NO_OVERLAP: "film the way to them as well, in steps of a few degrees",
    NO_PLACE: "film those parts again from more places, each part from at least three",
}


class Structure:
    """Finds the cameras of shots: keypoints, matches, a map of what follows in time, then of what is near in space."""

    def __init__(self, shots: Shots, threads: int, report: Report) -> None:
        self._shots, self._threads, self._report = shots, threads, report
        first = shots.chosen[0]
        self._camera = _guessed(first.width, first.height, shots.focal_px)
        self._keypoints: list[Keypoints] = []
        self._pairs: list[tuple[int, int]] = []
        self._matches: list[np.ndarray] = []
        self._sharpness: list[float] = []
        self.notes = shots.notes

    def map(self) -> Mapped | None:
        """Cameras in a frame of their own, None where no two images fit."""
        from fieldpose.stages.structure.mapping import map_images

        self._find_keypoints()
        self._match(self._first_pairs())
        mapped = map_images(
            self._keypoints, self._pairs, self._matches, self._small, self._shots.focal_px is not None, self._threads,
            lambda share: self._report("finding the cameras", share),
        )  # fmt: skip
        if mapped is None or len(mapped.index) < FEWEST:
            return mapped
        try:
            return self._closed(mapped)
        except GeometryError as error:
            self.notes += (f"the cameras are as they were mapped, since adjusting them all found none ({error})",)
            return mapped

    def marker(self, mapped: Mapped, square: Square) -> Marker:
        """The marker that most images with a camera show. DatasetError where there is none."""
        from fieldpose.stages.structure.markers import FEWEST as FEWEST_SHOWN
        from fieldpose.stages.structure.markers import Seen, find_markers, place_marker
        from fieldpose.stages.structure.posed import PosedCameras

        def found(index: int) -> list[Seen]:
            shot = self._shots.chosen[index]
            scale = np.array([mapped.camera.width / shot.width, mapped.camera.height / shot.height])
            return [Seen(m.number, scale_pixels(m.corners, scale)) for m in find_markers(shot.image(), square.family)]

        seen = []
        with ThreadPoolExecutor(self._threads) as pool:
            for markers in pool.map(found, mapped.index.tolist()):
                seen.append(markers)
                self._report("looking for markers", len(seen) / len(mapped.index))
        posed = PosedCameras((mapped.camera,) * len(mapped.index), mapped.cam_from_object)
        marker = place_marker(posed, seen, square.size_m)
        if marker is None:
            shown = sum(map(bool, seen))
            raise DatasetError(
                f"no marker of family {square.family} was placed: {shown} of {len(seen)} images show one, and one is to"
                f" be seen in {FEWEST_SHOWN}, flat and whole; is it of that family, with its white border?"
            )
        return marker

    def why_not(self, mapped: Mapped | None) -> dict[str, str]:
        """Of each image without a place, by its name, why."""
        from fieldpose.stages.structure.mapping import overlap
        from fieldpose.stages.structure.selection import BLURRED as BLURRED_BELOW

        placed = set() if mapped is None else set(mapped.index.tolist())
        shares = overlap(len(self._keypoints), self._pairs, self._matches)
        typical = float(np.median(self._sharpness))
        why = {}
        for i, shot in enumerate(self._shots.chosen):
            if i in placed:
                continue
            blurred = self._sharpness[i] < BLURRED_BELOW * typical
            few = len(self._keypoints[i]) < _FEW_KEYPOINTS
            why[shot.name] = (
                TOO_LITTLE if few and not shares[i] else BLURRED if blurred else NO_PLACE if shares[i] else NO_OVERLAP
            )
        return why

    @property
    def _small(self) -> Camera:
        from fieldpose.stages.structure.mending import LONGER_SIDE

        return self._camera.shrunk(LONGER_SIDE)

    def _find_keypoints(self) -> None:
        from fieldpose.stages.structure.features import find_keypoints
        from fieldpose.stages.structure.mending import MOST_KEYPOINTS
        from fieldpose.stages.structure.selection import sharpness

        small = self._small

        def found(shot: Shot) -> tuple[Keypoints, float]:
            image = shrunk(shot.cut_out(), max(small.width, small.height))
            colours = np.ascontiguousarray(image[..., :3])
            return find_keypoints(image, MOST_KEYPOINTS), sharpness(cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY))

        with ThreadPoolExecutor(self._threads) as pool:
            for keypoints, sharp in pool.map(found, self._shots.chosen):
                self._keypoints.append(keypoints)
                self._sharpness.append(sharp)
                self._report("looking for points", len(self._keypoints) / len(self._shots.chosen))

    def _first_pairs(self) -> list[tuple[int, int]]:
        from fieldpose.stages.structure.pairs import alike_pairs

        count = len(self._keypoints)
        if self._shots.follow:
            return [(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + _NEIGHBOURS, count))]
        if count <= _ALL_PAIRS:
            return [(i, j) for i in range(count) for j in range(i + 1, count)]
        return alike_pairs(self._keypoints, _LOOKALIKES)

    def _match(self, pairs: Sequence[tuple[int, int]]) -> None:
        from fieldpose.stages.structure.matches import match_pairs

        new = sorted(set(pairs) - set(self._pairs))
        if new:
            found = match_pairs(self._keypoints, new, self._threads, lambda share: self._report("matching", share))
            self._pairs += new
            self._matches += found

    def _closed(self, mapped: Mapped) -> Mapped:
        """With what images share that are near by the cameras found, as where a video comes back to its beginning.

        Nearness in space comes after nearness in time: parts that look alike, like a label that is there twice, would
        fold the way over itself.
        """
        from fieldpose.stages.structure.adjustment import LEAST_ANGLE, adjust
        from fieldpose.stages.structure.pairs import choose_pairs
        from fieldpose.stages.structure.posed import PosedCameras
        from fieldpose.stages.structure.tracks import join_tracks
        from fieldpose.stages.structure.triangulation import triangulate

        near = choose_pairs(mapped.cam_from_object)
        self._match([(int(mapped.index[i]), int(mapped.index[j])) for i, j in near])
        self._report("adjusting the cameras", 0.0)
        tracks = join_tracks(self._keypoints, self._pairs, self._matches)
        posed = PosedCameras((mapped.camera,) * len(mapped.index), mapped.cam_from_object)
        tracks = tracks.seen_in(np.isin(np.arange(len(self._keypoints)), mapped.index))
        adjusted = adjust(posed, tracks, "distortion")
        found = triangulate(adjusted, tracks)
        good = np.isfinite(np.bincount(tracks.track, found.error_px, tracks.count)) & (found.angle_rad > LEAST_ANGLE)
        self._report("adjusting the cameras", 1.0)
        return replace(
            mapped, camera=adjusted.cameras[0], cam_from_object=adjusted.cam_from_object, points=found.points[good],
            seen=tracks.seen_by(len(mapped.index)), error_px=float(np.median(found.error_px)),
        )  # fmt: skip


def _write(
    out: Path, shots: Shots, mapped: Mapped, structure: Structure, marker: Marker | None, report: Report
) -> Captured:
    from fieldpose.stages.structure.box import object_box
    from fieldpose.stages.structure.upright import stand

    standing = stand(mapped.cam_from_object, mapped.points)
    object_from_map = standing.object_from_map if marker is None else marker.object_from_map
    poses = object_from_map.of_poses(mapped.cam_from_object)
    metres = None if marker is None else 1.0
    chosen = [shots.chosen[i] for i in mapped.index]
    names = [f"{IMAGES}/{shot.name}" for shot in chosen]
    cameras = [mapped.camera.resized(shot.width, shot.height) for shot in chosen]
    held_out = set(names[HELD_OUT_EVERY // 2 :: HELD_OUT_EVERY])
    for i, shot in enumerate(chosen):
        write_bytes(out / IMAGES / shot.name, shot.file)
        if shot.mask is not None:
            write_bytes(out / MASKS / f"{Path(shot.name).stem}.png", shot.mask)
        report("writing the images", (i + 1) / len(chosen))
    box = object_box(object_from_map.of_points(mapped.points), poses)
    if box is not None:
        shown = np.linspace(0, len(chosen) - 1, min(_PICTURES, len(chosen))).astype(int)
        pictures = [boxed(chosen[i].image(), cameras[i], poses[i], box) for i in shown]
        write_bytes(out / OBJECT_PICTURE, encoded(sheet(pictures), out / OBJECT_PICTURE))
    write_json(out / CAMERA_FILE, cameras[0])
    about: dict[str, object] = {} if metres is None else {"metres_per_unit": metres}
    if box is not None:
        about["object_aabb"] = box.tolist()
    masked = [None if shot.mask is None else f"{MASKS}/{Path(shot.name).stem}.png" for shot in chosen]
    companions = [{} if mask is None else {"mask_path": mask} for mask in masked]
    write_json(out / FILE, transforms_document(names, cameras, poses, held_out or None, about, companions))
    return Captured(
        len(chosen), len(shots.chosen), len(shots.blurred), shots.seen, structure.why_not(mapped), cameras[0],
        mapped.error_px * cameras[0].width / mapped.camera.width, standing.on_plane, metres,
        None if marker is None else (marker.number, marker.images),
        None if box is None else tuple(map(tuple, box.tolist())), structure.notes,
    )  # fmt: skip


def _guessed(width: int, height: int, focal_px: float | None) -> Camera:
    focal = _UNSURE_FOCAL * max(width, height) if focal_px is None else focal_px
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
