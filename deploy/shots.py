"""Images to find cameras for: sharp frames of a video or of a live camera, or photographs, upright and of one lens."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from fieldpose.errors import SourceError
from fieldpose.stages.camera.calibration import ONE_LENS, focal_length_from_exif
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import Source
from fieldpose.stages.camera.sources import is_video, open_source
from fieldpose.stages.camera.sources.folder import natural
from fieldpose.stages.images import decoded, shrunk
from fieldpose.stages.nerf.datasets.images import (
    EXTENSIONS,
    is_image_name,
    is_opaque,
    load_mask,
    probe,
    resized_rgba,
    upright,
    upright_rgba,
    upright_size,
)
from fieldpose.stages.nerf.datasets.intrinsics import same_shape
from fieldpose.stages.nerf.datasets.masks import FOLDER as MASKS
from fieldpose.stages.nerf.datasets.masks import find_masks

Report = Callable[[str, float], None]
_LOOKED_EVERY_S = 3.0
FILMED_S = 60.0
"""A live camera films for so long, if it is not told otherwise."""
IMAGES = "images"
_QUALITY = 95
_OPAQUE, _TRANSPARENT = ".jpg", ".png"
_WHOLE = 0.9
"""Of the frames that a video says it has: of fewer, a user is told."""
_RAW = {".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw"}


@dataclass(frozen=True)
class Shot:
    """One image to find a camera for: its name in the dataset, the bytes of its upright file, and its size.

    The file is a JPEG, or where the image has an alpha channel a PNG. mask: the bytes of a PNG file, white where the
    object is, where a mask tells.
    """

    name: str
    file: bytes
    width: int
    height: int
    mask: bytes | None = None

    def image(self) -> np.ndarray:
        """Its pixels (h, w, 3) uint8."""
        pixels = decoded("jpeg", np.frombuffer(self.file, np.uint8), self.width, self.height)
        assert pixels is not None, "what was encoded here can be decoded"
        return pixels

    def cut_out(self) -> np.ndarray:
        """The same, with an alpha channel (h, w, 4) where it has one, or a mask."""
        if self.mask is not None:
            return np.dstack([self.image(), _decoded(self.mask)])
        if self.name.endswith(_TRANSPARENT):
            return np.dstack([self.image(), _decoded(self.file)[..., 3]])
        return self.image()


Look = Callable[[Sequence[Shot], int], None]


@dataclass(frozen=True)
class Shots:
    """What was chosen of a source, how many images it has, those left out as blurred, and what is known of the lens.

    focal_px: of the images' own size, None where nothing tells it. follow: whether they follow one another in time.
    notes: what a user should know, a line each.
    """

    chosen: tuple[Shot, ...]
    seen: int
    blurred: tuple[str, ...]
    focal_px: float | None
    follow: bool
    notes: tuple[str, ...] = ()


def read_shots(
    source: str, most: int, size: int, seconds: float, report: Report, look: Look = lambda kept, blurred: None
) -> Shots:  # fmt: skip
    """Of a video file, a folder of photographs, or a source as `run` takes it; see capturing.capture. SourceError.

    look: while a live camera films, is given now and then what would be kept, and how many frames are blurred.
    """
    found = opened(source)
    if isinstance(found, Path):
        return _photographs(found, size, report)
    return _frames(found, most, size, seconds, report, look)


def opened(source: str) -> Path | Source:
    """The folder of photographs, or the frames of a video, a camera or a recording, that a source is. SourceError."""
    path = Path(source)
    if path.is_dir():
        return path
    name = source if ":" in source and not path.exists() else f"video:{source}"
    if name.startswith("folder:"):
        return Path(name.partition(":")[2])
    if not is_video(name):
        raise SourceError(f"{source}: expected a video, a camera, a recording or a folder of photographs")
    return open_source(CameraConfig(source=name))


def photographs(folder: Path) -> tuple[list[Path], tuple[str, ...]]:
    """The images of a folder in their order, and what a user should know of its other files. SourceError for none."""
    paths = sorted((p for p in folder.iterdir() if is_image_name(p)), key=natural) if folder.is_dir() else []
    others = [p.name for p in sorted(folder.iterdir()) if p.suffix.lower() in _RAW] if folder.is_dir() else []
    left = () if not others else (f"{len(others)} files were not read, as {others[0]}; convert them to JPEG",)
    if not paths:
        raise SourceError(f"{folder}: no images in this folder; expected {', '.join(EXTENSIONS)}; {' '.join(left)}")
    return paths, left


def of_one_lens(folder: Path, paths: Sequence[Path], report: Report) -> Iterator[tuple[Path, np.ndarray, float | None]]:
    """Photographs (h, w, 3) uint8, upright as their EXIF says, with the focal length in pixels that it tells.

    Those that stand where most lie, or the other way round, are turned by a quarter: one lens then has one camera.
    Raises SourceError at the end where they are of several sizes or lenses.
    """
    portrait = 2 * sum(height > width for width, height in map(upright_size, paths)) > len(paths)
    sizes: set[tuple[int, int]] = set()
    focals: list[float] = []
    for i, path in enumerate(paths):
        image = upright(path)
        if (image.shape[0] > image.shape[1]) != portrait and image.shape[0] != image.shape[1]:
            image = np.ascontiguousarray(np.rot90(image))
        sizes.add((image.shape[1], image.shape[0]))
        focal = focal_length_from_exif(path, image.shape[1], image.shape[0])
        focals += [] if focal is None else [focal]
        yield path, image, focal
        report("reading the photographs", (i + 1) / len(paths))
    _check_shapes(folder, sizes)
    if focals and max(focals) > ONE_LENS * min(focals):
        raise SourceError(
            f"{folder}: photographs of several lenses (EXIF tells of focal lengths of {min(focals):.0f} to"
            f" {max(focals):.0f} px); keep those of one lens, without zoom"
        )


def filmed(source: Source, seconds: float, report: Report) -> Iterator[np.ndarray]:
    """The frames (h, w, 3) uint8 of a source, those of a live camera for so long. SourceError where sizes differ."""
    live, began, first, seen = source.clock == "wall", time.monotonic(), None, 0
    for image in _images(source):
        size, seen = (image.shape[1], image.shape[0]), seen + 1
        first = first or size
        _check_shapes(source.description, {first, size})
        yield image
        filmed_s = time.monotonic() - began
        if live and filmed_s >= seconds:
            break
        share = filmed_s / seconds if live else seen / source.length if source.length else 0.0
        report("filming" if live else "choosing frames", min(share, 1.0))


def cut_off(source: Source, seen: int) -> tuple[str, ...]:
    """What a user should know of a video of which only so many frames could be read."""
    if source.clock == "wall" or source.length is None or seen >= _WHOLE * source.length:
        return ()
    return (f"only {seen} of {source.length} frames could be read: is the file whole?",)


def _photographs(folder: Path, size: int, report: Report) -> Shots:
    """All images of a folder, files that are there twice only once."""
    paths, left = photographs(folder)
    shots: list[Shot] = []
    focals: list[float] = []
    known: set[bytes] = set()
    stems = Counter(path.stem for path in paths)
    masks = _masks(folder, paths)
    transparent = masks is None and any(probe(path).has_alpha and not is_opaque(path) for path in paths)
    for path, image, focal in of_one_lens(folder, paths, report):
        name = path.stem if stems[path.stem] == 1 else path.name
        pixels = _turned_along(upright_rgba(path), image) if transparent else image
        shot = _shot(name, pixels, size, None if masks is None else _turned_along(masks(path), image))
        if shot.file in known:
            continue
        known.add(shot.file)
        shots.append(shot)
        focals += [] if focal is None else [focal * shot.width / image.shape[1]]
    focal_px = float(np.median(focals)) if len(focals) == len(shots) else None
    return Shots(tuple(shots), len(paths), (), focal_px, False, left)


def _check_shapes(source: Path | str, sizes: set[tuple[int, int]]) -> None:
    if len(sizes) > 1:
        named = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
        raise SourceError(
            f"{source}: images of several sizes ({named}), so of several cameras; keep those of one camera"
        )


def _frames(source: Source, most: int, size: int, seconds: float, report: Report, look: Look) -> Shots:
    from fieldpose.stages.structure.selection import Chooser, Meter

    meter, chooser = Meter(), Chooser[Shot](most)
    looked_at, so_far = time.monotonic(), ""

    def told(what: str, share: float) -> None:
        report(what + so_far, share)

    try:
        for image in filmed(source, seconds, told):
            measured = meter(image)
            if chooser.wants(measured):
                chooser.keep(measured, _shot(f"{chooser.seen - 1:05d}", image, size))
            if source.clock == "wall" and time.monotonic() - looked_at > _LOOKED_EVERY_S:
                kept, blurred = chooser.chosen()
                look([candidate.payload for candidate in kept], len(blurred))
                looked_at, so_far = time.monotonic(), f": {len(kept)} frames kept, {len(blurred)} blurred"
    except KeyboardInterrupt:
        if source.clock != "wall":
            raise
    chosen, blurred = chooser.chosen()
    return Shots(
        tuple(c.payload for c in chosen), chooser.seen, tuple(c.payload.name for c in blurred), None, True,
        cut_off(source, chooser.seen),
    )  # fmt: skip


def _images(source: Source) -> Iterator[np.ndarray]:
    for frame in source.frames(0):
        image = decoded(frame.encoding, frame.image, frame.camera.width, frame.camera.height)
        if image is not None:
            yield image


def _masks(folder: Path, paths: Sequence[Path]) -> Callable[[Path], np.ndarray] | None:
    """Gives the mask (h, w) uint8 of a photograph, by a folder `masks` in theirs or beside it; None without one."""
    found = find_masks(folder if (folder / MASKS).is_dir() else folder.parent, paths)
    if found is None:
        return None

    def mask_of(path: Path) -> np.ndarray:
        mask, (width, height) = probe(found[path]), upright_size(path)
        if not same_shape(mask, width, height):
            raise SourceError(
                f"{found[path]}: the mask has {mask.width}x{mask.height} pixels, {path.name}, upright as its EXIF says,"
                f" {width}x{height}, another shape; make it anew of the upright photograph"
            )
        return np.where(load_mask(found[path], width, height), 255, 0).astype(np.uint8)

    return mask_of


def _turned_along(part: np.ndarray, image: np.ndarray) -> np.ndarray:
    """By a quarter, as of_one_lens turns an image that does not lie as most do."""
    return part if part.shape[:2] == image.shape[:2] else np.rot90(part)


def _shot(name: str, image: np.ndarray, size: int, mask: np.ndarray | None = None) -> Shot:
    """name: without an extension. image (h, w, 3) uint8, or (h, w, 4) with an alpha channel; mask (h, w) uint8."""
    height, width = shrunk(image, size).shape[:2]
    if image.shape[2] == 4:
        ending, pixels = _TRANSPARENT, cv2.cvtColor(resized_rgba(image, width, height), cv2.COLOR_RGBA2BGRA)
        options = []
    else:
        ending, pixels = _OPAQUE, cv2.cvtColor(shrunk(np.ascontiguousarray(image), size), cv2.COLOR_RGB2BGR)
        options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    _, file = cv2.imencode(ending, pixels, options)
    png = None
    if mask is not None:
        small = cv2.resize(np.ascontiguousarray(mask), (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
        png = cv2.imencode(".png", small)[1].tobytes()
    return Shot(f"{name}{ending}", file.tobytes(), width, height, png)


def _decoded(png: bytes) -> np.ndarray:
    pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels is not None, "what was encoded here can be decoded"
    return pixels
