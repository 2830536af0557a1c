"""Certificates for several hosts."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import tyro

from fieldpose.bus.access import AUTHORITY, Role
from fieldpose.deploy.access.roles import in_words, role_named, roles
from fieldpose.errors import OutputError, UsageError

_MOST_DAYS = 36500


@dataclass(frozen=True)
class Options:
    """Make the certificates by which the hosts of a pipeline know each other, one for each role, and their authority's.

    Example: fieldpose certs certs --hosts robot 10.0.0.2 server

    Copy ca.pem and the two files of a role to the host where it runs, and give their folder to each command with --tls,
    or in the environment variable FIELDPOSE_TLS. Whoever has a role's key has that role: it may send, hear and ask what
    that role may, and nothing else. The authority's own key is not kept, so that nobody can be let in later: for other
    hosts or roles, and before they expire, make all of them anew. Nothing is overwritten.
    """

    folder: tyro.conf.Positional[Path]
    """The folder to make; it must not be there, or be empty."""
    hosts: tuple[str, ...] = ()
    """Names and addresses of the hosts, for clients that compare them, as those of other languages do; this machine's
    loopback addresses are always among them."""
    days: int = 365
    """How long they are valid."""
    roles: tuple[str, ...] = ()
    """Only these roles (default: all)."""

    def run(self) -> int:
        """Make them, and say what goes where."""
        # It brings the library, which takes a moment.
        from fieldpose.deploy.access.certificates import make_certificates

        if not 1 <= self.days <= _MOST_DAYS:
            raise UsageError(f"--days {self.days}: expected 1 to {_MOST_DAYS}")
        those = tuple(role_named(name) for name in dict.fromkeys(self.roles)) or roles()
        made = self._beside()
        try:
            make_certificates(made, [role.name for role in those], self.hosts, timedelta(days=self.days))
            made.rename(self.folder)
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be made: {error.strerror}") from error
        finally:
            shutil.rmtree(made, ignore_errors=True)
        for line in self._said(those):
            print(line)
        return 0

    def _beside(self) -> Path:
        """A folder that becomes the one wanted once everything is in it. Raises OutputError."""
        if os.path.lexists(self.folder) and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise OutputError(f"{self.folder}: is there already, and is not overwritten; choose another folder")
        try:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            return Path(tempfile.mkdtemp(dir=self.folder.parent, prefix=f".{self.folder.name}-"))
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be made: {error.strerror}") from error

    def _said(self, those: tuple[Role, ...]) -> list[str]:
        width = max(len(role.name) for role in those) + len(".key")
        lines = [
            f"{self.folder}: certificates valid for {self.days} days; to every host: {AUTHORITY}, and of its role:"
        ]
        lines += [f"  {role.name + '.pem':{width}} {role.name + '.key':{width}}  {in_words(role)}" for role in those]
        lines.append("the .key files are secrets: copy them by ssh, and only to where they are used")
        return lines
