"""Who may say and hear what on a closed bus: roles, as Zenoh's TLS and access control are told of them.

Every process proves by a certificate which role it has, and has whom it meets prove theirs, whoever of the two opened
the link. By users and passwords Zenoh (1.10.2) knows only who opened it: of two processes that meet directly one would
not know the other's role, and could let pass everything or nothing; where both open one at once it logs errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fieldpose.bus.topics import STATS, Address, Topic, key_matches
from fieldpose.errors import TransportError

PRESENCE = "peers/*"
"""What all say of themselves, see `presence`."""
AUTHORITY = "ca.pem"
_ANYWHERE = Address("*", "*", "*")
_TLS = "transport/link/tls/"
_MESSAGES = ("put", "delete", "declare_subscriber", "query", "declare_queryable", "reply")
Deed = Literal["send on", "listen to", "answer at", "ask at"]


@dataclass(frozen=True)
class Role:
    """What the holder of a certificate may do; its name is the certificate's common name.

    asks: it may ask stages to do something. answers: it is asked under its name. passes_on: all, as the hub does.
    """

    name: str
    reads: tuple[Topic[Any], ...] = ()
    writes: tuple[Topic[Any], ...] = ()
    asks: bool = False
    answers: bool = False
    passes_on: bool = False

    def keys(self, deed: Deed) -> list[str]:
        """Patterns of the keys of which it may do something."""
        if self.passes_on:
            return ["**"]
        if deed == "send on":
            # Everybody may tell how it is, under its own name.
            return [*(_ANYWHERE.key(topic, self.name) for topic in (*self.writes, STATS)), PRESENCE]
        if deed == "listen to":
            return [*(_ANYWHERE.key(topic) for topic in self.reads), PRESENCE]
        if deed == "answer at":
            return [_ANYWHERE.control(self.name)] if self.answers else []
        return [_ANYWHERE.control("*")] if self.asks else []

    def may(self, deed: Deed, key: str) -> bool:
        """Whether it may do that of a key, or of all that a pattern stands for."""
        return self.passes_on or any(key_matches(pattern, key) for pattern in self.keys(deed))


@dataclass(frozen=True)
class Access:
    """A process's own part in a closed bus: its role among all there are, and the folder of its certificate and key."""

    folder: Path
    role: Role
    roles: tuple[Role, ...]

    @property
    def authority(self) -> Path:
        """The certificate of who has signed all the others."""
        return self.folder / AUTHORITY

    @property
    def certificate(self) -> Path:
        return certificate_of(self.folder, self.role.name)

    @property
    def key(self) -> Path:
        return key_of(self.folder, self.role.name)

    def check(self, deed: Deed, key: str) -> None:
        """Raise TransportError for what the others would not let pass, silently."""
        if not self.role.may(deed, key):
            able = ", ".join(role.name for role in self.roles if role.may(deed, key) and not role.passes_on)
            mend = f"that takes a certificate of {able}" if able else "nobody may"
            raise TransportError(f"refused: the role {self.role.name} may not {deed} {key}; {mend}")

    def settings(self) -> dict[str, Any]:
        """Zenoh's configuration, by path."""
        certificate, key = str(self.certificate), str(self.key)
        return {
            # What others say of where they listen is followed by TLS alone.
            "transport/link/protocols": ["tls"],
            _TLS + "root_ca_certificate": str(self.authority),
            _TLS + "enable_mtls": True,
            # Peers learn of each other by addresses that no certificate can know; the role tells who it is.
            _TLS + "verify_name_on_connect": False,
            _TLS + "connect_certificate": certificate,
            _TLS + "connect_private_key": key,
            _TLS + "listen_certificate": certificate,
            _TLS + "listen_private_key": key,
            "access_control": access_control(self.roles),
        }


def certificate_of(folder: Path, role: str) -> Path:
    """Where the certificate of a role is."""
    return folder / f"{role}.pem"


def key_of(folder: Path, role: str) -> Path:
    """Where the private key of a role is."""
    return folder / f"{role}.key"


def access_control(roles: Sequence[Role]) -> dict[str, Any]:
    """Zenoh's access control: what each process lets pass of, and to, whoever is at the other end of a link."""
    rules: list[dict[str, Any]] = []
    subjects, policies = [], []
    for role in roles:
        its = [rule for flow, towards in _FLOWS for rule in _rules(role, flow, towards)]
        rules += its
        subjects.append({"id": role.name, "cert_common_names": [role.name]})
        policies.append({"rules": [rule["id"] for rule in its], "subjects": [role.name]})
    return {
        "enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
    }  # fmt: skip


_FLOWS: tuple[tuple[str, dict[Deed, tuple[str, ...]]], ...] = (
    ("ingress", {
        "send on": ("put",), "listen to": ("declare_subscriber",), "answer at": ("declare_queryable", "reply"),
        "ask at": ("query",),
    }),
    # It is told of no subscription that it may send nothing to, so that it does not even try.
    ("egress", {
        "send on": ("declare_subscriber",), "listen to": ("put",), "answer at": ("query",),
        "ask at": ("declare_queryable", "reply"),
    }),
)  # fmt: skip


def _rules(role: Role, flow: str, messages: dict[Deed, tuple[str, ...]]) -> list[dict[str, Any]]:
    if role.passes_on:
        return [_rule(f"{role.name} {flow}", flow, _MESSAGES, ["**"])]
    named = [(f"{role.name} {flow} {deed}", kinds, _keys(role, flow, deed)) for deed, kinds in messages.items()]
    return [_rule(name, flow, kinds, keys) for name, kinds, keys in named if keys]


def _keys(role: Role, flow: str, deed: Deed) -> list[str]:
    # Who listens to how everybody is listens to a pattern, of which its own key is a part.
    return [*role.keys(deed), _ANYWHERE.key(STATS)] if (flow, deed) == ("egress", "send on") else role.keys(deed)


def _rule(name: str, flow: str, messages: Sequence[str], keys: Sequence[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": list(keys)}
