"""Writing the files of a site into a folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from fieldpose.deploy.reporting.output import write_bytes
from fieldpose.errors import OutputError


class _Plain(yaml.SafeDumper):
    """Without references, which people find hard to read; with strings as Kubernetes and Compose understand them."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def to_yaml(*documents: Any) -> bytes:
    """YAML in the order given; several documents with lines between them."""
    text = yaml.dump_all(documents, Dumper=_Plain, sort_keys=False, width=100, allow_unicode=True)
    return text.encode()


def write_all(folder: Path, files: Mapping[str, bytes], again: bool) -> None:
    """Write files into a folder. Raises OutputError where one is there with another content, unless `again`."""
    for name, content in files.items():
        path = folder / name
        if not again and path.exists() and path.read_bytes() != content:
            raise OutputError(f"{path}: is there already, and differs; give --again to write it anew")
    for name, content in files.items():
        write_bytes(folder / name, content)
