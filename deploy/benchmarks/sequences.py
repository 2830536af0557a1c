"""The camera sequences that are followed live: the demo's, a hand-held video of a kitchen, and the user's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fieldpose.deploy.benchmarks.fields import kept_field
from fieldpose.deploy.learning import learn_field
from fieldpose.deploy.scene import demo_file
from fieldpose.errors import UsageError
from fieldpose.stages.camera.config import CameraConfig
from fieldpose.stages.camera.core import CapturedFrame
from fieldpose.stages.camera.sources import open_source
from fieldpose.stages.geometry import Limit
from fieldpose.stages.nerf.config import FieldConfig, TrainingConfig

DEMO, KITCHEN = "demo", "kitchen"
LIMIT = Limit(2.0, 0.05)
"""A pose beyond is wrong, where a sequence has no limit of its own."""
_DEMO_LIMIT = Limit(1.0, 0.02)
_SIZE = 400


@dataclass(frozen=True)
class Sequence:
    """A recording (.mcap) with true poses, and the field that its camera moves in; limit: a pose beyond is wrong."""

    name: str
    recording: Path
    field: Path
    limit: Limit = LIMIT


@dataclass(frozen=True)
class Fields:
    """Where fields are found: the kitchen's and that of recordings, or, for the kitchen, how one is trained.

    kitchen_data: its folder, of posed images and sequence.mcap; folder: where its field is kept once it is trained.
    """

    kitchen_data: Path
    folder: Path
    minutes: float = 5.0
    kitchen: Path | None = None
    recordings: Path | None = None


def found(names: tuple[str, ...], fields: Fields, report: Callable[[str], None]) -> list[Sequence]:
    """The sequences by name, without the kitchen where its data is not there; trains its field if need be.

    Raises UsageError where none is left and for a recording without a field, and what training raises.
    """
    sequences = []
    for name in dict.fromkeys(names):
        if name == KITCHEN and not (fields.kitchen_data / "sequence.mcap").is_file():
            report(f"kitchen is left out: {fields.kitchen_data} is not there")
        else:
            sequences.append(_sequence(name, fields, report))
    if not sequences:
        raise UsageError("bench track: no sequence to follow")
    return sequences


def demo() -> Sequence:
    """The sequence of the demo scene. Raises FieldposeError where fieldpose was installed without it."""
    return Sequence(DEMO, demo_file("sequence.mcap"), demo_file("field.safetensors"), _DEMO_LIMIT)


def there_and_back(recording: Path) -> list[CapturedFrame]:
    """The frames of a recording, and back again without its ends, so that they can follow one another for ever."""
    frames = list(open_source(CameraConfig(f"mcap:{recording}")).frames(0))
    return frames + frames[-2:0:-1]


def _sequence(name: str, fields: Fields, report: Callable[[str], None]) -> Sequence:
    if name == DEMO:
        return demo()
    if name == KITCHEN:
        field = fields.kitchen or _learnt(fields, report)
        return Sequence(KITCHEN, fields.kitchen_data / "sequence.mcap", field)
    recording = Path(name)
    if recording.suffix != ".mcap" or not recording.is_file():
        raise UsageError(f"bench track: sequence {name!r}: expected {DEMO}, {KITCHEN} or a recording (.mcap)")
    if fields.recordings is None:
        raise UsageError(f"bench track: sequence {name!r}: give its field with --field")
    return Sequence(recording.stem, recording, fields.recordings)


def _learnt(fields: Fields, report: Callable[[str], None]) -> Path:
    """The kitchen's field as `fieldpose train` makes it, trained only once."""
    path = kept_field(fields.folder / "learnt", fields.kitchen_data, _SIZE, fields.minutes)
    if not path.is_file():
        report(f"training {path}")
        training = TrainingConfig(minutes=fields.minutes)
        learn_field(fields.kitchen_data, path, _SIZE, "auto", training, FieldConfig(), say=report)
    return path
