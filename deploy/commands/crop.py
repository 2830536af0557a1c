"""A field of the object alone, out of a field of all that is around it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from fieldpose.deploy.learning import described
from fieldpose.deploy.reporting.boxes import boxed, sheet
from fieldpose.deploy.reporting.output import check_writable, progress_console, write_bytes, write_json
from fieldpose.deploy.reporting.overlay import encoded
from fieldpose.errors import FieldFileError, OutputError, UsageError
from fieldpose.stages.cores import usable_cores
from fieldpose.stages.matching.core import MatchingConfig
from fieldpose.stages.nerf.cropping import cropped, in_words
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.nerf.from_dataset import own_views
from fieldpose.stages.nerf.loading import make_renderer
from fieldpose.stages.nerf.metadata import FieldMetadata
from fieldpose.stages.nerf.rendering_api import RayRenderer
from fieldpose.stages.nerf.surface.samples import sampled_surface
from fieldpose.stages.structure.box import object_box

_PICTURES, _LONGER_SIDE = 6, 480


@dataclass(frozen=True)
class Options:
    """Make a field of an object alone: what is in a box, so that it is found wherever it is moved.

    Example: fieldpose crop out/can.safetensors --out out/can-alone.safetensors --picture out/box.jpg

    Without --box the box is put around what stands apart in the midst of the training views, on what it stands on. Look
    at the picture, and give a better one where parts are cut off or something else is in it. What is outside is not
    rendered any more, which is faster, and the field remembers how its own views look now. `train --only box` does the
    same with the box of the dataset, and then also tries how well the object is found. The JSON file has: box.
    """

    field: tyro.conf.Positional[Path]
    """The field (.safetensors)."""
    out: Path | None = None
    """The field of the object alone to write; without, only the box is found and shown."""
    box: tuple[float, float, float, float, float, float] | None = None
    """The lowest and the highest corner, x y z x y z, in the field's frame and unit."""
    picture: Path | None = None
    """Write a picture of training views with the box into this file (.jpg or .png)."""
    matching: MatchingConfig = dataclasses.field(default_factory=MatchingConfig)
    """Its weights serve to remember how the views look."""
    json: Path | None = None
    """Write the box into this file."""

    def run(self) -> int:
        """Find the box, show it, cut the field."""
        check_writable(self.out, self.picture, self.json)
        if self.out is not None and self.out.resolve() == self.field.resolve():
            raise OutputError(f"{self.out}: would replace the field of the whole; name another file")
        if self.box is not None and not np.less(self.box[:3], self.box[3:]).all():
            raise UsageError("--box: expected the lowest corner, then the highest, each as x y z")
        field = load_field(self.field)
        renderer = make_renderer(field, usable_cores())
        box = self._found(renderer, field.metadata) if self.box is None else np.reshape(self.box, (2, 3))
        alone = cropped(field, box)
        if self.picture is not None and not field.metadata.cameras:
            raise FieldFileError(f"{self.field}: does not tell its training views, of which --picture would be made")
        if self.picture is not None:
            write_bytes(self.picture, encoded(_picture(renderer, field.metadata, box), self.picture))
            print(f"{self.picture}: training views with the box")
        write_json(self.json, {"box": box.tolist()})
        sides = " x ".join(f"{side:.4g}" for side in box[1] - box[0])
        print(f"box {in_words(box)}, sides {sides} (lengths in: {field.metadata.unit})")
        if self.out is None:
            print("only looked; --out FILE writes the object alone, --box X Y Z X Y Z corrects the box")
            return 0
        alone.descriptors = described(own_views(alone, usable_cores()), self.matching, progress_console().print)
        alone.save(self.out)
        print(f"{self.out}: the object alone, {alone.occupied.sum()} cells of the scene's {field.occupied.sum()}")
        print("how exactly it is found is not known; `train --only box` learns and tries it")
        return 0

    def _found(self, renderer: RayRenderer, metadata: FieldMetadata) -> np.ndarray:
        if not metadata.cameras:
            raise FieldFileError(f"{self.field}: does not tell its training views; give --box X Y Z X Y Z")
        poses = np.stack([camera.pose for camera in metadata.cameras])
        found = object_box(sampled_surface(renderer, metadata).points, poses)
        if found is None:
            raise FieldFileError(
                f"{self.field}: nothing stands apart where the training views look; give --box X Y Z X Y Z"
            )
        return found


def _picture(renderer: RayRenderer, metadata: FieldMetadata, box: np.ndarray) -> np.ndarray:
    pictures = []
    for view in metadata.cameras[:: -(-len(metadata.cameras) // _PICTURES) or 1]:
        camera = view.camera.undistorted().shrunk(_LONGER_SIDE)
        pictures.append(boxed(renderer.render_view(camera, view.pose).rgb, camera, view.pose, box))
    return sheet(pictures)
