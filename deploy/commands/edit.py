"""Edited versions of a recorded camera sequence."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from fieldpose.deploy.evaluation.edited import EditRecord, Recipe, edit_recording
from fieldpose.deploy.evaluation.edits import described
from fieldpose.deploy.reporting.output import check_writable, progress_console

_Edit = Annotated[str, tyro.conf.arg(help=f"What is done to the part chosen. {described()}.")]


@dataclass(frozen=True)
class Options:
    """Write an edited version of a recorded camera sequence, to test how far tracking can be trusted.

    Example: fieldpose edit recordings/demo/sequence.mcap --edit occluder --out out/occluder.mcap --seed 1

    The result is read like any other sequence, with --source mcap:FILE. Frames are numbered from 0, and every one
    keeps the true pose of the camera that took its image. edit.json, attached to the recording, has: edit, parameters,
    source, recipe (the options), frames (frame_id, source_frame_id, visible: the share of the image that shows the
    scene, edited: whether the edit shows there), in the order of sending.
    """

    sequence: tyro.conf.Positional[Path]
    """The recording (.mcap) whose camera frames and true poses are taken."""
    edit: _Edit
    out: Path
    """The recording to write (.mcap)."""
    recipe: Annotated[Recipe, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Recipe)

    def run(self) -> int:
        """Write the recording, say what is in it."""
        check_writable(self.out)
        with progress_console().status(self.edit) as status:
            record = edit_recording(
                self.sequence, self.out, self.edit, self.recipe,
                lambda done, total: status.update(f"{self.edit}: {done} of {total} frames"),
            )  # fmt: skip
        print(f"{self.out}: {_summary(record)}")
        return 0


def _summary(record: EditRecord) -> str:
    frames = record.frames
    edited, hidden = sum(frame.edited for frame in frames), sum(frame.visible == 0 for frame in frames)
    return f"{record.edit}, {len(frames)} frames, {edited} of them edited, {hidden} without the scene in view"
