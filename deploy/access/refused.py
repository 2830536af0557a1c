"""Why a hub does not let one in, in a line, found out by a TLS handshake of our own: Zenoh's session only waits."""

from __future__ import annotations

import socket
import ssl

from fieldpose.bus.access import Access
from fieldpose.deploy.processes.endpoints import host_of, port_of
from fieldpose.errors import TransportError

_ANSWER_S = 1.0
_ALERTS = {
    "CERTIFICATE_REQUIRED": "it wants a certificate",
    "CERTIFICATE_EXPIRED": "it says that {certificate} has expired; make new ones with `fieldpose certs`",
    "UNKNOWN_CA": "its certificates are of another CA than {certificate}; take those that its hub was started with",
    "DECRYPT_ERROR": "its certificates are of another CA than {certificate}; take those that its hub was started with",
    "BAD_CERTIFICATE": "it does not accept {certificate}; take those that its hub was started with",
}
_EXPIRED = 10


def why_refused(hub: str, access: Access | None) -> str | None:
    """What keeps one from a hub; None where nobody answers there, or nothing is found to be wrong."""
    try:
        return _of_open(hub) if access is None else _of_closed(hub, access)
    except (OSError, TransportError):
        return None


def nobody(hub: str, access: Access | None, waited_s: float) -> str:
    """What to say where no hub has answered for a while."""
    said = f"no hub answers at {hub} after {waited_s:g} s; start it, or name its address"
    try:
        socket.create_connection((host_of(hub), port_of(hub)), _ANSWER_S).close()
    except (OSError, TransportError):
        return said
    if access is None:
        return f"{said}; somebody listens there who is no hub, or hangs"
    return f"{said}; somebody listens there who hangs, or is no closed hub: one that is open is joined with --open"


def speaks_tls(host: str, port: int) -> bool | None:
    """Whether who listens there is closed; None where nobody says anything."""
    try:
        _handshake(host, port, _anybody())
    except ssl.SSLError as error:
        return "WRONG_VERSION_NUMBER" not in str(error) and "EOF" not in str(error)
    except TimeoutError:
        return False  # one that speaks Zenoh waits for the rest
    except OSError:
        return None
    return True


def _of_open(hub: str) -> str | None:
    if not speaks_tls(host_of(hub), port_of(hub)):
        return None
    return (
        f"refused: the hub at {hub} is closed, and none of your runs on this machine is there; it is another user's, or"
        " wants --tls DIR with certificates that its hub was started with"
    )


def _of_closed(hub: str, access: Access) -> str | None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    try:
        context.load_verify_locations(access.authority)
        context.load_cert_chain(access.certificate, access.key)
    except (ssl.SSLError, ValueError) as error:
        return f"{access.certificate} and {access.key}, or {access.authority}, do not belong together: {error}"
    try:
        _handshake(host_of(hub), port_of(hub), context)
    except ssl.SSLCertVerificationError as error:
        if error.verify_code == _EXPIRED:
            return f"the certificate of the hub at {hub} has expired; make new ones with `fieldpose certs`"
        return (
            f"the hub at {hub} has a certificate of another CA than {access.authority}; take the certificates that it"
            " was started with"
        )
    except ssl.SSLError as error:
        words = next((words for sign, words in _ALERTS.items() if sign in str(error)), None)
        if words is not None:
            return f"refused by the hub at {hub}: {words.format(certificate=access.certificate)}"
        if "WRONG_VERSION_NUMBER" in str(error):
            return f"the hub at {hub} is open, and speaks no TLS; give --open and tcp/ to join it nevertheless"
    return None


def _anybody() -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


def _handshake(host: str, port: int, context: ssl.SSLContext) -> None:
    """A handshake, and a moment for an alert: the other end looks at our certificate after we have looked at its."""
    with (
        socket.create_connection((host, port), _ANSWER_S) as plain,
        context.wrap_socket(plain, server_hostname=host) as link,
    ):
        link.settimeout(_ANSWER_S / 2)
        try:
            link.recv(1)
        except TimeoutError:
            return
