"""Certificates by role, all signed by one authority made for them: by the library `cryptography`."""

from __future__ import annotations

import ipaddress
import os
import re
import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fieldpose.bus.access import AUTHORITY, certificate_of, key_of
from fieldpose.errors import OutputError, TransportError, UsageError

LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
_HOST = re.compile(
    r"(?=.{1,253}$)[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?(\.[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?)*"
)
# A clock that is a little behind is not to make certificates that are not valid yet.
_EARLIER = timedelta(hours=1)
_ALWAYS = (datetime(1970, 1, 1, tzinfo=UTC), datetime(9999, 12, 31, 23, 59, 59, tzinfo=UTC))


@dataclass(frozen=True)
class Authority:
    """Who signs certificates, all for the same hosts; whoever trusts its own lets their holders in."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey
    names: x509.SubjectAlternativeName

    @staticmethod
    def new(hosts: Sequence[str], since: datetime, until: datetime) -> Authority:
        """A new one. Raises UsageError for what is no host."""
        key = ec.generate_private_key(ec.SECP256R1())
        # A name of its own, so that another one is recognised as another.
        name = _name(f"fieldpose CA {secrets.token_hex(4)}")
        usage = x509.KeyUsage(False, False, False, False, False, True, True, False, False)
        builder = _builder(name, name, key.public_key(), since, until)
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        builder = builder.add_extension(usage, critical=True)
        builder = builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        return Authority(builder.sign(key, SHA256()), key, _alternative_names(hosts))

    def write(self, folder: Path) -> None:
        """Write its certificate; its key is never written. Raises OutputError where the file is there already."""
        _write(folder / AUTHORITY, self.certificate.public_bytes(Encoding.PEM), 0o644)

    def write_role(self, folder: Path, role: str, since: datetime, until: datetime) -> None:
        """Write a certificate and a key of a role. Raises OutputError where a file is there already."""
        key = ec.generate_private_key(ec.SECP256R1())
        signer = x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key())
        # Of two peers either may open the link between them.
        both = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
        builder = _builder(_name(role), self.certificate.subject, key.public_key(), since, until)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        for extension in (self.names, both, signer):
            builder = builder.add_extension(extension, critical=False)
        pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        _write(key_of(folder, role), pem, 0o600)
        _write(certificate_of(folder, role), builder.sign(self.key, SHA256()).public_bytes(Encoding.PEM), 0o644)


def make_certificates(
    folder: Path, roles: Iterable[str], hosts: Sequence[str] = LOCAL_HOSTS, valid: timedelta | None = None,
    begins: datetime | None = None,
) -> None:  # fmt: skip
    """Write a new authority's certificate, and for each role a certificate and a key, into a folder that is there.

    hosts: names and addresses that the certificates are for. valid: how long, from `begins` (default: an hour ago); for
    ever without it. Files of keys can be read by their owner alone; the authority's own key is never written, so that
    nobody else can be let in later. Raises UsageError for what is no host, OutputError where a file is there already.
    """
    since, until = _ALWAYS if valid is None else _span(begins, valid)
    authority = Authority.new(hosts, since, until)
    authority.write(folder)
    for role in roles:
        authority.write_role(folder, role, since, until)


def check_certificate(path: Path) -> None:
    """Raise TransportError for what is no certificate, or none that is valid today."""
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        raise TransportError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError:
        raise TransportError(f"{path}: no certificate; make new ones with `fieldpose certs`") from None
    now, since, until = datetime.now(UTC), certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now > until:
        raise TransportError(f"{path}: expired on {until:%Y-%m-%d}; make new certificates with `fieldpose certs`")
    if now < since:
        raise TransportError(f"{path}: not valid before {since:%Y-%m-%d %H:%M} UTC; is the clock right?")


def _span(begins: datetime | None, valid: timedelta) -> tuple[datetime, datetime]:
    since = begins or datetime.now(UTC) - _EARLIER
    return since, since + valid + (timedelta() if begins else _EARLIER)


def _alternative_names(hosts: Sequence[str]) -> x509.SubjectAlternativeName:
    return x509.SubjectAlternativeName([_host(host) for host in dict.fromkeys((*hosts, *LOCAL_HOSTS))])


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, since: datetime, until: datetime
) -> x509.CertificateBuilder:
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key)
    return builder.serial_number(x509.random_serial_number()).not_valid_before(since).not_valid_after(until)


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        pass
    if not _HOST.fullmatch(text):
        raise UsageError(f"{text!r} is no host; expected a name or an address, as robot or 10.0.0.2")
    return x509.DNSName(text)


def _write(path: Path, content: bytes, mode: int) -> None:
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    except FileExistsError:
        raise OutputError(f"{path}: is there already, and is not overwritten; choose another folder") from None
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)
