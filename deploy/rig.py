"""Several objects and cameras in one run: every object is looked for in every camera's frames.

They are named on the command line, as FILE or NAME=FILE and as SOURCE or NAME=SOURCE, or in the tables of a
configuration file, which may change settings for each:

    [objects.lamp]
    field = "lamp.safetensors"
    tracking.guess = "train:047"

    [cameras.left]
    source = "camera:0"
    camera_file = "left.json"
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from fieldpose.bus.topics import Address
from fieldpose.deploy.plan import Plan, resolve
from fieldpose.deploy.settings import Settings, changed, read_file
from fieldpose.errors import ConfigError, UsageError
from fieldpose.stages.nerf.field import load_field
from fieldpose.stages.nerf.training_views import training_views

_NAMED = re.compile(r"([A-Za-z0-9_.\-]+)=(.+)")
_NO_NAME = re.compile(r"[^A-Za-z0-9_.\-]+")
_OF_OBJECTS, _OF_CAMERAS = "objects", "cameras"
_NOT_OF_AN_OBJECT = ("address", "camera")

Table = Mapping[str, Any]


@dataclass(frozen=True)
class Rig:
    """The objects and cameras of a configuration file, by name, each with the settings that are its own."""

    objects: Mapping[str, Table] = field(default_factory=dict)
    cameras: Mapping[str, Table] = field(default_factory=dict)
    origin: str = ""


def read_rig(path: Path | None) -> tuple[Settings, Rig]:
    """The settings of all, and what is told of each object and camera. Raises ConfigError."""
    if path is None:
        return Settings(), Rig()
    content = read_file(path)
    objects, cameras = (_tables(content.pop(name, {}), f"{path}: {name}") for name in (_OF_OBJECTS, _OF_CAMERAS))
    return changed(Settings(), content, str(path)), Rig(objects, cameras, str(path))


def planned_rig(settings: Settings, rig: Rig, fields: Sequence[str], sources: Sequence[str]) -> tuple[Plan, ...]:
    """The plan of each pipeline: of every object with every camera, camera by camera.

    Raises UsageError where there is no object or camera, or where two have one name, ConfigError, FieldFileError,
    SourceError and DatasetError.
    """
    objects = _objects(settings, rig, fields)
    cameras = _cameras(settings, rig, sources)
    names = tuple(objects) if len(objects) > 1 else ()
    paths = {name: Path(table["field"]) for name, table in objects.items()}
    views = {name: training_views(load_field(path)) for name, path in paths.items()}
    plans = []
    for camera_name, of_camera in cameras.items():
        camera = changed(settings.camera, dict(of_camera), rig.origin, f"{_OF_CAMERAS}.{camera_name}.")
        _refuse_shared_calibration(settings, camera_name, of_camera, several=len(cameras) > 1)
        if camera.truth_of is not None and camera.truth_of not in objects:
            raise ConfigError(f"camera {camera_name}: truth_of is {camera.truth_of}: expected {' or '.join(objects)}")
        for name, of_object in objects.items():
            own = {key: value for key, value in of_object.items() if key != "field"}
            theirs = changed(settings, own, rig.origin, f"{_OF_OBJECTS}.{name}.")
            address = replace(settings.address, object=name, camera=camera_name)
            theirs = replace(theirs, address=address, camera=replace(camera, objects=names))
            plan = resolve(theirs, views[name], paths[name])
            known = camera.truth_of or next(iter(objects))
            if plan.begins.disturbance is not None and name != known:
                raise ConfigError(f"object {name}: guess {plan.settings.tracking.guess} is made from true poses, and"
                                  f" {camera_name} knows those of {known}")  # fmt: skip
            plans.append(plan)
    return tuple(plans)


def _objects(settings: Settings, rig: Rig, fields: Sequence[str]) -> dict[str, Table]:
    """What is told of each object, its field among that; a single one has the name that the settings give."""
    several = len(fields) + len(rig.objects) > 1
    named = [_named(field) for field in fields]
    found = [
        (name or (_NO_NAME.sub("-", Path(file).stem) if several else settings.address.object), {"field": file})
        for name, file in named
    ]
    for name, table in rig.objects.items():
        where = f"{rig.origin}: {_OF_OBJECTS}.{name}"
        if not isinstance(table.get("field"), str):
            raise ConfigError(f"{where}: needs field = FILE, the field (.safetensors) of the object")
        for key in _NOT_OF_AN_OBJECT:
            if key in table:
                raise ConfigError(f"{where}: {key} is not an object's; a camera has a table [{_OF_CAMERAS}.NAME]")
        found.append((name, dict(table)))
    return _by_name(found, "object", "no field; give one, or several: fieldpose run FIELD --source SOURCE")


def _cameras(settings: Settings, rig: Rig, sources: Sequence[str]) -> dict[str, Table]:
    if not sources and not rig.cameras and settings.camera.source:
        sources = [settings.camera.source]
    several = len(sources) + len(rig.cameras) > 1
    found = [
        (name or (f"camera{i}" if several else settings.address.camera), {"source": source})
        for i, (name, source) in enumerate(_named(source) for source in sources)
    ]
    for name, table in rig.cameras.items():
        if not isinstance(table.get("source"), str):
            raise ConfigError(f'{rig.origin}: {_OF_CAMERAS}.{name}: needs source = SOURCE, for instance "camera:0"')
        found.append((name, dict(table)))
    return _by_name(found, "camera", "no source of images; give --source, for instance --source folder:DIR")


def _by_name(found: Iterable[tuple[str, Table]], what: str, missing: str) -> dict[str, Table]:
    tables: dict[str, Table] = {}
    for name, table in found:
        Address(object=name)
        if name in tables:
            raise UsageError(f"two {what}s are named {name}; give each a name of its own: NAME=…")
        tables[name] = table
    if not tables:
        raise UsageError(missing)
    return tables


def _named(text: str) -> tuple[str | None, str]:
    """A name and what it is of; a file of that very name needs none."""
    named = _NAMED.fullmatch(text)
    return (None, text) if named is None or Path(text).exists() else (named[1], named[2])


def _tables(content: Any, where: str) -> dict[str, Table]:
    if not isinstance(content, dict) or not all(isinstance(table, dict) for table in content.values()):
        raise ConfigError(f"{where}: expected a table for each, for instance [{where.rpartition(' ')[2]}.left]")
    return content


def _refuse_shared_calibration(settings: Settings, name: str, own: Table, several: bool) -> None:
    if several and settings.camera.camera_file is not None and "camera_file" not in own:
        raise ConfigError(
            f"camera {name}: one calibration, {settings.camera.camera_file}, is given for several cameras; give each"
            f" its own in a configuration file: [{_OF_CAMERAS}.{name}] with source and camera_file"
        )
