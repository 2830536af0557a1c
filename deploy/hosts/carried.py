"""Settings as other hosts read them: what they name of this machine is taken along."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import Any

from fieldpose.deploy.plan import Plan
from fieldpose.deploy.settings import to_json
from fieldpose.errors import ConfigError, UsageError

_MOST_BYTES = 1_000_000
"""What a ConfigMap of Kubernetes can hold of all files together, 1 MiB, less what it says of them."""


class Carried:
    """The files of a site, gathered. config, fields: where the hosts have them."""

    def __init__(self, config: str, fields: str) -> None:
        self._config, self._fields = config, fields
        self.files: dict[str, bytes] = {}
        self.fields: dict[str, Path] = {}

    def settings(self, plan: Plan, several: bool) -> str:
        """Take in the settings of a plan; gives the file's name. Raises ConfigError and UsageError.

        What a host decides by what it has, its devices, stays open.
        """
        decided, given = plan.settings, plan.given
        matching = replace(decided.matching, device=given.matching.device)
        address = decided.address
        name = f"settings-{address.object}-{address.camera}" if several else "settings"
        open_again = replace(decided, backend=given.backend, matching=matching)
        guess = open_again.tracking.guess
        if guess is not None and not guess.startswith(("perturb:", "train:")):
            tracking = replace(open_again.tracking, guess=str(self._along(Path(guess))))
            open_again = replace(open_again, tracking=tracking)
        self.add(f"{name}.json", to_json(self._with_files(open_again)))
        return f"{name}.json"

    def field(self, plan: Plan) -> str:
        """Take in the field of a plan; gives its path there."""
        if plan.field is None:
            raise UsageError("a field is needed")
        name = plan.field.name
        if self.fields.setdefault(name, plan.field) != plan.field:
            raise UsageError(f"{self.fields[name]} and {plan.field} have one name; rename one of them")
        return f"{self._fields}/{name}"

    def add(self, name: str, content: bytes) -> None:
        """Take in a file. Raises UsageError where another has its name, or all together are too large."""
        if self.files.setdefault(name, content) != content:
            raise UsageError(f"two files named {name} would be needed; rename one of them")
        size = sum(map(len, self.files.values()))
        if size > _MOST_BYTES:
            raise UsageError(f"{name}: with it the files that settings name have {size} bytes, at most {_MOST_BYTES}")

    def _with_files(self, config: Any) -> Any:
        """Settings with the files that they name, wherever in the tree, where the hosts have them."""
        new: dict[str, Any] = {}
        for part in dataclasses.fields(config):
            value = getattr(config, part.name)
            if isinstance(value, Path):
                new[part.name] = self._along(value)
            elif dataclasses.is_dataclass(value):
                new[part.name] = self._with_files(value)
        return replace(config, **new)

    def _along(self, path: Path) -> Path:
        try:
            self.add(path.name, path.read_bytes())
        except OSError as error:
            raise ConfigError(f"{path}: cannot be taken along to other hosts: {error.strerror}") from error
        return Path(self._config) / path.name
