"""What makes a recording self-contained: the settings, the field, the versions that it was made with."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import metadata as packages
from pathlib import Path

from fieldpose.bus.logs import stage_logger
from fieldpose.bus.mcap_files import Attachment
from fieldpose.bus.reading import RecordingInfo, read_attachment
from fieldpose.bus.recording import Metadata
from fieldpose.deploy.plan import Plan
from fieldpose.deploy.settings import Settings, changed, to_json, without_unknown
from fieldpose.errors import RecordingError
from fieldpose.stages.cores import usable_cores

CORES = "cores"
RUN_RECORD, PLAN_RECORD, EDIT_RECORD = "fieldpose.run", "fieldpose.plan", "fieldpose.edit"
SETTINGS_ATTACHMENT = "settings.json"
FIELD_ATTACHMENT = "field.safetensors"
MOST_CORES = 1024
_PACKAGES = ("fieldpose", "numpy", "torch", "kornia", "numba", "opencv-python-headless", "eclipse-zenoh")


def metadata(plans: Sequence[Plan]) -> Metadata:
    """Names, seeds and versions, as text, and what was decided for the run; of each of several pipelines its own."""
    records: dict[str, Mapping[str, str]] = {}
    for plan in plans:
        records |= {_record(RUN_RECORD, plan, plans): made_with(plan), _record(PLAN_RECORD, plan, plans): plan.notes}
    return records


def attachments(plans: Sequence[Plan]) -> list[Attachment]:
    """The settings with which a run can be repeated, nothing in them left open, and the fields themselves."""
    items: dict[str, Attachment] = {}
    for plan in plans:
        whose, object = _folder(plan, plans), f"{plan.settings.address.object}/" if len(plans) > 1 else ""
        made = [Attachment(whose + SETTINGS_ATTACHMENT, "application/json", to_json(plan.settings))]
        if plan.field is not None:
            made.append(Attachment(object + FIELD_ATTACHMENT, "application/octet-stream", plan.field.read_bytes()))
        items |= {attachment.name: attachment for attachment in made}
    return list(items.values())


def pipelines_in(recording: RecordingInfo) -> list[str]:
    """OBJECT/CAMERA of each pipeline of a recording that holds several; nothing where it holds one."""
    ending = f"/{SETTINGS_ATTACHMENT}"
    return sorted(name.removesuffix(ending) for name in recording.attachments if name.endswith(ending))


def recorded_settings(path: Path, pipeline: str | None = None) -> Settings:
    """The settings of a recorded run, without those that this version no longer has, which is said in its log.

    pipeline: OBJECT/CAMERA, where the recording holds several. Raises RecordingError where it has none.
    """
    name = SETTINGS_ATTACHMENT if pipeline is None else f"{pipeline}/{SETTINGS_ATTACHMENT}"
    content = json.loads(read_attachment(path, name))
    gone = without_unknown(Settings(), content)
    if gone:
        stage_logger("replay").warning("settings of another version are left out", names=", ".join(gone))
    return changed(Settings(), content, f"{path}: {name}")


def recorded_cores(recording: RecordingInfo, pipeline: str | None = None) -> int | None:
    """How many cores the recorded run could use, from which its numbers of threads follow; None where it is not said.

    pipeline: OBJECT/CAMERA, where the recording holds several.
    """
    said = recording.metadata.get(RUN_RECORD if pipeline is None else f"{RUN_RECORD} {pipeline}", {}).get(CORES, "")
    return int(said) if said.isdecimal() and 0 < int(said) <= MOST_CORES else None


def recorded_field(path: Path, recording: RecordingInfo, folder: Path, pipeline: str | None = None) -> Path:
    """The field of a recorded run: its own file where that is still the same, else a copy put into `folder`.

    pipeline: OBJECT/CAMERA, where the recording holds several. Raises RecordingError where it has none.
    """
    record = RUN_RECORD if pipeline is None else f"{RUN_RECORD} {pipeline}"
    name = FIELD_ATTACHMENT if pipeline is None else f"{pipeline.partition('/')[0]}/{FIELD_ATTACHMENT}"
    noted = recording.metadata.get(record, {})
    original = Path(noted["field"]) if "field" in noted else None
    if original is not None and original.is_file() and sha256_of(original) == noted.get("field_sha256"):
        return original
    if name not in recording.attachments:
        raise RecordingError(f"{path}: holds no field, and {original or 'none'} is not there; give --field FIELD")
    copy = folder / FIELD_ATTACHMENT
    copy.write_bytes(read_attachment(path, name))
    return copy


def made_with(plan: Plan) -> dict[str, str]:
    """Names, seed and versions of a run, as text."""
    settings, field = plan.settings, plan.field
    values = {
        "source": settings.camera.source,
        "seed": str(settings.tracking.seed),
        "matcher": settings.matching.matcher,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        CORES: str(usable_cores()),
    }
    if field is not None:
        values |= {"field": str(field), "field_sha256": sha256_of(field)}
    return values | versions()


def versions() -> dict[str, str]:
    """Of the packages that results depend on, as text."""
    return {f"version {name}": _version(name) for name in _PACKAGES}


def _folder(plan: Plan, plans: Sequence[Plan]) -> str:
    return f"{plan.settings.address.pair}/" if len(plans) > 1 else ""


def _record(name: str, plan: Plan, plans: Sequence[Plan]) -> str:
    return f"{name} {plan.settings.address.pair}" if len(plans) > 1 else name


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
