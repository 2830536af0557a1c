"""A field of an object alone: of all that was learnt, what is in a box."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np

from fieldpose.errors import ConfigError
from fieldpose.stages.nerf.field import Field
from fieldpose.stages.nerf.metadata import Space
from fieldpose.stages.nerf.normalise import normalised_points
from fieldpose.stages.nerf.occupancy import cell_positions, from_cube


def cropped(field: Field, box: np.ndarray) -> Field:
    """The field within a box (2, 3), lowest and highest corner in object coordinates; nothing else is rendered.

    How well it was learnt and is found, and how its views look, is not known of the part. Where the field was turned
    against its dataset, the box's sides are kept to a cell. ConfigError as of box_within, and where it holds nothing.
    """
    space = field.metadata.space
    low, high = box_within(space, box)
    n = len(field.occupied)
    # Half the length of a cell, from its middle to a corner.
    slack = np.sqrt(3) * (2.0 if space.contracted else 1.0) / n * space.scale
    cells = np.flatnonzero(field.occupied)
    centres = from_cube(space, cell_positions(cells, n, np.full((1, 3), 0.5)))
    occupied = np.zeros(n**3, bool)
    occupied[cells[((centres >= box[0] - slack) & (centres <= box[1] + slack)).all(axis=1)]] = True
    if not occupied.any():
        raise ConfigError(f"nothing of the field is in the box {in_words(box)}; give one around the object")
    accuracy = field.metadata.accuracy
    metadata = msgspec.structs.replace(
        field.metadata,
        space=msgspec.structs.replace(space, box=(*low.tolist(), *high.tolist())),
        has_background=False,
        psnr_db=None,
        accuracy=None,
        error_scale=field.metadata.error_scale if accuracy is None else accuracy.error_scale,
    )
    return Field(metadata, field.net, occupied.reshape(n, n, n))


def box_within(space: Space, box: np.ndarray) -> np.ndarray:
    """The part (2, 3) of a field's space, in its coordinates, that a box (2, 3) in object coordinates is in.

    ConfigError where there is none, or it reaches beyond the ball that an unbounded field knows at full resolution.
    """
    corners = normalised_points(space, np.array(list(itertools.product(*box.T))))
    low, high = corners.min(axis=0), corners.max(axis=0)
    if space.contracted and np.linalg.norm(np.maximum(np.abs(low), np.abs(high))) > 1:
        raise ConfigError(
            f"the box {in_words(box)} reaches beyond what is known at full resolution, the ball of radius"
            f" {space.scale:.4g} around ({', '.join(f'{v:.4g}' for v in space.centre)}); give a smaller one"
        )
    if space.corners is not None:
        low, high = np.maximum(low, space.corners[0]), np.minimum(high, space.corners[1])
    if not ((box[0] < box[1]).all() and (low < high).all()):
        raise ConfigError(f"nothing of the field is in the box {in_words(box)}; give one around the object")
    return np.stack([low, high])


def in_words(box: np.ndarray) -> str:
    """The corners of a box (2, 3)."""
    low, high = (", ".join(f"{value:.4g}" for value in corner) for corner in box)
    return f"({low}) to ({high})"
