"""Make the small edited sequences, each with what tracking believes of its frames.

Run with the project's own environment, in a few minutes; files that are there are replaced:

    .venv/bin/python recordings/demo/make_edited.py recordings/demo/edited
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import msgspec

from fieldpose.bus.mcap_files import Attachment
from fieldpose.bus.reading import info, read_attachment, read_recording
from fieldpose.bus.recording import RecordingWriter
from fieldpose.bus.topics import FRAME, STATE, TRUTH, Address
from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.evaluation.edited import EDIT_ATTACHMENT, Recipe, edit_recording
from fieldpose.deploy.evaluation.edits import EDITS
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.replaying.feeding import Feeding
from fieldpose.deploy.reporting.provenance import SETTINGS_ATTACHMENT
from fieldpose.deploy.settings import Settings, changed, to_json

HERE = Path(__file__).parent
RECIPE = Recipe(seed=1, every=4, frames=36, size=240, quality=60)
LONGER = {"occluder": replace(RECIPE, frames=56)}
"""Where an edit lasts longer than these four seconds."""
SETTINGS = {
    "camera": {"source": "mcap:edited.mcap", "pace": "lockstep"},
    "tracking": {"sequence": "video"},
    "following": {"when": "always"},
    "rendering": {"size": 192},
}


def write(edit: str, out: Path, plan: Plan, parts: Parts) -> None:
    """An edited sequence with a State for each frame."""
    address = Address()
    with tempfile.TemporaryDirectory() as folder:
        edited = Path(folder) / "edited.mcap"
        edit_recording(HERE / "sequence.mcap", edited, edit, LONGER.get(edit, RECIPE), lambda done, total: None)
        kept = list(read_recording(edited, (FRAME, TRUTH)))
        record = read_attachment(edited, EDIT_ATTACHMENT)
        metadata = {name: values for name, values in info(edited).metadata.items() if name != "fieldpose.recording"}
        feeding = Feeding(edited, address, "camera", parts)
        states = [said.message for one in feeding.play() for said in one.said if said.topic is STATE]
    out.unlink(missing_ok=True)
    attachments = [
        Attachment(SETTINGS_ATTACHMENT, "application/json", to_json(plan.settings)),
        Attachment(EDIT_ATTACHMENT, "application/json", record),
    ]
    writer = RecordingWriter(out, metadata, attachments)
    for one in kept:
        writer.write(one.key, one.topic, one.message, one.log_time_ns)
    for number, state in enumerate(states):
        state.header = msgspec.structs.replace(state.header, sequence=number, sent_ns=state.header.capture_ns)
        writer.write(address.key(STATE), STATE, state, state.header.capture_ns)
    writer.close()
    sure = sum(state.is_sure for state in states)
    print(f"{out.name}: {len(states)} frames, tracking sure of {sure}, {out.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    field = HERE / "field.safetensors"
    plan = planned(changed(Settings(), SETTINGS, "the edited sequences"), field)
    for edit in EDITS:
        write(edit, folder / f"{edit}.mcap", plan, Parts(plan, threads=1))


if __name__ == "__main__":
    main()
