"""What makes a recording self-contained: the settings, the field, the versions that it was made with."""

from __future__ import annotations

import hashlib
import json
import platform
from functools import cache
from importlib import metadata as packages
from pathlib import Path

from fieldpose.bus.logs import stage_logger
from fieldpose.bus.recording import Metadata
from fieldpose.bus.replay import Attachment, RecordingInfo, read_attachment
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.settings import Settings, changed, to_json, without_unknown
from fieldpose.errors import RecordingError

RUN_RECORD, PLAN_RECORD, EDIT_RECORD = "fieldpose.run", "fieldpose.plan", "fieldpose.edit"
SETTINGS_ATTACHMENT = "settings.json"
FIELD_ATTACHMENT = "field.safetensors"
_PACKAGES = ("fieldpose", "numpy", "torch", "kornia", "numba", "opencv-python-headless", "eclipse-zenoh")


def metadata(plan: Plan) -> Metadata:
    """Names, seeds and versions, as text, and what was decided for the run."""
    settings, field = plan.settings, plan.field
    values = {
        "source": settings.camera.source,
        "seed": str(settings.tracking.seed),
        "matcher": settings.matching.matcher,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
    }
    if field is not None:
        values |= {"field": str(field), "field_sha256": sha256_of(field)}
    return {RUN_RECORD: values | {f"version {name}": _version(name) for name in _PACKAGES}, PLAN_RECORD: plan.notes}


def attachments(plan: Plan) -> list[Attachment]:
    """The settings with which a run can be repeated, nothing in them left open, and the field itself."""
    items = [Attachment(SETTINGS_ATTACHMENT, "application/json", to_json(plan.settings))]
    if plan.field is not None:
        items.append(Attachment(FIELD_ATTACHMENT, "application/octet-stream", plan.field.read_bytes()))
    return items


def recorded_settings(path: Path) -> Settings:
    """The settings of a recorded run, without those that this version no longer has, which is said in its log.

    Raises RecordingError where the recording has none.
    """
    content = json.loads(read_attachment(path, SETTINGS_ATTACHMENT))
    gone = without_unknown(Settings(), content)
    if gone:
        stage_logger("replay").warning("settings of another version are left out", names=", ".join(gone))
    return changed(Settings(), content, f"{path}: {SETTINGS_ATTACHMENT}")


def recorded_field(path: Path, recording: RecordingInfo, folder: Path) -> Path:
    """The field of a recorded run: its own file where that is still the same, else a copy put into `folder`.

    Raises RecordingError where the recording has none.
    """
    noted = recording.metadata.get(RUN_RECORD, {})
    original = Path(noted["field"]) if "field" in noted else None
    if original is not None and original.is_file() and sha256_of(original) == noted.get("field_sha256"):
        return original
    if FIELD_ATTACHMENT not in recording.attachments:
        raise RecordingError(f"{path}: holds no field, and {original or 'none'} is not there; give --field FIELD")
    copy = folder / FIELD_ATTACHMENT
    copy.write_bytes(read_attachment(path, FIELD_ATTACHMENT))
    return copy


@cache
def sha256_of(path: Path) -> str:
    """Hash of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _version(package: str) -> str:
    try:
        return packages.version(package)
    except packages.PackageNotFoundError:
        return "not installed"
