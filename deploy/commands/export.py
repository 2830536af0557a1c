"""What a field has learnt, or a recording holds, as files that other programs read."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro

from fieldpose.deploy.reporting.output import write_bytes
from fieldpose.deploy.reporting.surfaces import check_surface, glb, ply
from fieldpose.deploy.reporting.turntable import check_video, write_turntable
from fieldpose.errors import FieldFileError, UsageError
from fieldpose.stages.cores import usable_cores
from fieldpose.stages.nerf.metadata import FieldMetadata

if TYPE_CHECKING:
    from fieldpose.stages.nerf.rendering_api import RayRenderer
    from fieldpose.stages.nerf.surface.extract import Region
    from fieldpose.stages.nerf.surface.mesh import SurfaceMesh, SurfacePoints

RECORDING_SUFFIX = ".mcap"
_RESOLUTIONS = 8, 2048


@dataclass(frozen=True)
class Options:
    """Write a field's surface as a mesh or as points, with colours and normals, or a video of what was learnt; or a
    recording for Foxglove, Lichtblick and other readers of MCAP, or as a video with the field over its images.

    Example: fieldpose export out/lego.safetensors --mesh out/lego.glb --points out/lego.ply

    Example: fieldpose export out/run.mcap --foxglove out/run-foxglove.mcap --layout out/layout.json

    The surface is made of what the training views see of the field, and is open where none has looked. Colours are the
    mean over these views, light and shade included. PLY files are in the object's own frame and unit. GLB files hold
    the same numbers below a node that turns z upwards to glTF's y upwards and, where the field knows how long its unit
    is, scales to metres; where not, the unit stays. The file says which in asset.extras: unit, metres_per_unit,
    gltf_from_object (4x4 by rows), and what was done in words.
    """

    file: tyro.conf.Positional[Path]
    """The field (.safetensors) of the object or scene, or the recording (.mcap) of a run."""
    mesh: Path | None = None
    """Write the surface as triangles into this file (.ply or .glb)."""
    points: Path | None = None
    """Write the surface as points into this file (.ply)."""
    turntable: Path | None = None
    """Write a video of three seconds into this file (.mp4): around a bounded object that was seen from all sides, else
    to and fro along training views."""
    foxglove: Path | None = None
    """Write the recording into this file (.mcap) with Foxglove's schemas; needs pip install 'fieldpose[foxglove]'."""
    layout: Path | None = None
    """Write the layout that shows such a file into this one (.json), to be imported in Foxglove."""
    video: Path | None = None
    """Write a video (.mp4) of the recording: its frames, and beside them the same with the field over them."""
    field: Path | None = None
    """Of a recording: its field (.safetensors), where that is not attached or no longer where it was."""
    pipeline: str | None = None
    """Of a recording: OBJECT/CAMERA, which of its pipelines, where it holds several."""
    resolution: int = 384
    """Cells along the longest side of the region; parts thinner than one or two of them are lost."""
    region: tuple[float, float, float, float, float, float] | None = None
    """The lowest and the highest corner, x y z x y z, of a box in the object's frame and unit. By default a bounded
    field's own box; of an unbounded one the ball that it knows at full resolution, around what the cameras see."""
    least_share: float = 0.001
    """Leave out pieces of the mesh with less than this share of the largest one's area."""
    spacing: float | None = None
    """Side of the cubes that have one point each, in the object's unit; by default the mesh's cells."""
    count: int | None = None
    """At most so many points, spread evenly."""
    backend: Literal["auto", "numba", "torch", "cuda"] = "auto"
    """What renders the training views: compiled kernels on the CPU, or torch; auto: on a CUDA device, if any."""
    threads: int = 0
    """Threads of the kernels; 0 takes all cores."""

    def run(self) -> int:
        """Write what was asked for, say what it is."""
        if self.file.suffix == RECORDING_SUFFIX:
            return self._recording()
        self._check()
        from fieldpose.stages.nerf.field import load_field
        from fieldpose.stages.nerf.loading import make_renderer

        field = load_field(self.file)
        metadata, renderer = field.metadata, make_renderer(field, self._threads(), self.backend)
        if self.mesh is not None or self.points is not None:
            self._surface(renderer, metadata)
        if self.turntable is not None:
            write_turntable(renderer, metadata, self.turntable)
            print(f"{self.turntable}: {_megabytes(self.turntable)}")
        return 0

    def _recording(self) -> int:
        self._refuse(RECORDING_SUFFIX, mesh=self.mesh, points=self.points, turntable=self.turntable)
        from fieldpose.deploy.reporting.recording_files import RecordingFiles

        files = RecordingFiles(
            self.file, self.foxglove, self.layout, self.video, self.field, self.pipeline, self.backend, self._threads()
        )
        files.check()
        for line in files.write():
            print(line)
        return 0

    def _refuse(self, suffix: str, **others: Path | str | None) -> None:
        given = [f"--{name}" for name, value in others.items() if value is not None]
        if given:
            kind, other = ("recording", "field") if suffix == RECORDING_SUFFIX else ("field", "recording (.mcap)")
            raise UsageError(f"{self.file} is taken for a {kind}, but {given[0]} is of a {other}")

    def _check(self) -> None:
        """Raise OutputError or UsageError before long work is begun."""
        self._refuse(
            self.file.suffix, foxglove=self.foxglove, layout=self.layout, video=self.video, field=self.field,
            pipeline=self.pipeline,
        )  # fmt: skip
        if self.mesh is None and self.points is None and self.turntable is None:
            raise UsageError("nothing to write; give --mesh, --points or --turntable")
        check_surface(self.mesh, (".ply", ".glb"), "a mesh")
        check_surface(self.points, (".ply",), "a file of points")
        check_video(self.turntable)
        if len(set(self._files())) < len(list(self._files())):
            raise UsageError("--mesh and --points are the same file; give each its own")
        for complaint in self._complaints():
            raise UsageError(complaint)

    def _files(self) -> Iterator[Path]:
        yield from (path.resolve() for path in (self.mesh, self.points) if path is not None)

    def _complaints(self) -> Iterator[str]:
        low, high = _RESOLUTIONS
        if not low <= self.resolution <= high:
            yield f"--resolution {self.resolution}: must be from {low} to {high}"
        if not 0 <= self.least_share <= 1:
            yield f"--least-share {self.least_share:g}: must be from 0 to 1"
        if self.spacing is not None and not 0 < self.spacing < np.inf:
            yield f"--spacing {self.spacing:g}: must be a length above 0"
        if self.count is not None and self.count < 1:
            yield f"--count {self.count}: must be at least 1"
        if self.region is not None:
            corners = np.reshape(self.region, (2, 3))
            if not (np.isfinite(corners).all() and (corners[0] < corners[1]).all()):
                yield "--region: expected the lowest corner, then the highest, each as x y z"

    def _threads(self) -> int:
        return self.threads or usable_cores()

    def _surface(self, renderer: RayRenderer, metadata: FieldMetadata) -> None:
        from fieldpose.stages.nerf.surface.extract import Region, region_of, seen_surface, surface_mesh, surface_points

        given = self.region
        region = region_of(metadata.space) if given is None else Region(np.reshape(np.array(given), (2, 3)))
        began = time.monotonic()
        views = seen_surface(renderer, metadata)
        if self.mesh is not None:
            mesh = surface_mesh(views, region, self.resolution, self.least_share, self._threads())
            self._write_mesh(self.mesh, mesh, metadata)
            print(f"{self.mesh}: {len(mesh.triangles)} triangles, {len(mesh.points)} points, ", end="")
            print(f"{_in_unit(region, metadata)}; {_megabytes(self.mesh)}, {time.monotonic() - began:.0f} s")
        if self.points is not None:
            spacing = self.spacing or region.longest / self.resolution
            points = surface_points(views, region, spacing, self.count, self._threads())
            self._check_found(points)
            write_bytes(self.points, ply(points, _comments(metadata)))
            print(f"{self.points}: {len(points.points)} points; {_megabytes(self.points)}")

    def _write_mesh(self, path: Path, mesh: SurfaceMesh, metadata: FieldMetadata) -> None:
        self._check_found(mesh)
        if path.suffix == ".glb":
            write_bytes(path, glb(mesh, metadata.metres_per_unit or 1.0, _extras(metadata)))
        else:
            write_bytes(path, ply(mesh, _comments(metadata)))

    def _check_found(self, surface: SurfacePoints) -> None:
        if not len(surface.points):
            raise FieldFileError(f"{self.file}: no surface is seen in the region; give another one, or train longer")


def _in_unit(region: Region, metadata: FieldMetadata) -> str:
    return f"within {' x '.join(f'{side:.3g}' for side in region.box[1] - region.box[0])} (lengths in: {metadata.unit})"


def _megabytes(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.1f} MB"


def _comments(metadata: FieldMetadata) -> list[str]:
    metres = metadata.metres_per_unit
    known = "unknown" if metres is None else f"{metres:g}"
    return [f"made by {metadata.made_by or 'fieldpose'}", f"unit: {metadata.unit}; metres per unit: {known}"]


def _extras(metadata: FieldMetadata) -> dict[str, Any]:
    metres = metadata.metres_per_unit
    scaled = "the unit is kept, since its length is not known" if metres is None else "lengths were scaled to metres"
    return {
        "unit": metadata.unit,
        "metres_per_unit": metres,
        "converted": f"z upwards was turned to y upwards; {scaled}",
    }
