"""Writing the files of a site into a folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from fieldpose.deploy.reporting.output import write_bytes
from fieldpose.errors import OutputError

_MADE_BY = b"# Written by `fieldpose deploy"


class _Plain(yaml.SafeDumper):
    """Without references, which people find hard to read; with strings as Kubernetes and Compose understand them."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def to_yaml(*documents: Any) -> bytes:
    """YAML in the order given; several documents with lines between them."""
    text = yaml.dump_all(documents, Dumper=_Plain, sort_keys=False, width=100, allow_unicode=True)
    return text.encode()


def write_all(folder: Path, files: Mapping[str, bytes], again: bool) -> list[str]:
    """Write files into a folder. Raises OutputError where one is there with another content, unless `again`.

    Of earlier files, those that are of no service any more are removed, and named in what is returned.
    """
    old = [path for path in _ours(folder) if path.name not in files]
    if old and not again:
        raise OutputError(f"{old[0]}: is of another site, or of a service that is no more; give --again to remove it")
    for name, content in files.items():
        path = folder / name
        if not again and path.exists() and path.read_bytes() != content:
            raise OutputError(f"{path}: is there already, and differs; give --again to write it anew")
    for name, content in files.items():
        write_bytes(folder / name, content)
    for path in old:
        path.unlink()
    return [path.name for path in old]


def _ours(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return [path for path in sorted(folder.glob("fieldpose-*.service")) if path.read_bytes().startswith(_MADE_BY)]
