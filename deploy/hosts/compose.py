"""A site as a file for Docker Compose, of which each host starts the services that it is to run."""

from __future__ import annotations

from typing import Any

from fieldpose.bus.access import AUTHORITY
from fieldpose.deploy.graph import CAMERA
from fieldpose.deploy.hosts.services import CACHE, CONFIG, FIELDS, PORT, STATE, TLS, Service, Site
from fieldpose.deploy.hosts.writing import to_yaml

_HUB = f"${{FIELDPOSE_HUB:-tls/127.0.0.1:{PORT}}}"
_USER = "${FIELDPOSE_USER:-1000:1000}"


def files(site: Site) -> dict[str, bytes]:
    """The files of a folder, by their names in it."""
    composed = {
        "name": "fieldpose",
        "services": {service.name: _service(service, site) for service in site.services},
        "secrets": {
            name: {"file": f"${{FIELDPOSE_CERTS:-./certs}}/{name}"}
            for name in sorted({AUTHORITY, *(name for service in site.services for name in service.certificates)})
        },
        "volumes": {"cache": {}, "state": {}},
    }
    return {
        "compose.yaml": site.note.encode() + to_yaml(composed),
        **{f"config/{name}": content for name, content in site.files.items()},
    }


def _service(service: Service, site: Site) -> dict[str, Any]:
    made: dict[str, Any] = {
        "image": site.image,
        "command": [_literal(word) for word in service.command(_HUB, TLS, site.shared_memory)],
        "environment": {name: _literal(value) for name, value in service.environment.items()},
        "user": _USER,
        # Peers listen on ports of their own choice, which other hosts must reach.
        "network_mode": "host",
        # Shared memory is locked: by a sender its own, by a receiver that of all that it hears.
        **({"ipc": "host", "ulimits": {"memlock": -1}} if site.shared_memory else {}),
        "init": True,
        "read_only": True,
        "tmpfs": ["/tmp"],
        "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges:true"],
        # A camera ends with its source; what ends with an error begins again.
        "restart": "on-failure" if service.row.name == CAMERA else "unless-stopped",
        "stop_grace_period": f"{service.stop_s:g}s",
        "deploy": {"resources": {"limits": {"memory": f"{service.memory_mb}M"}}},
        "secrets": [{"source": name, "target": f"{TLS}/{name}"} for name in service.certificates],
    }
    if service.container_device is not None:
        device = _literal(service.container_device)
        made["devices"] = [f"{device}:{device}"]
        made["group_add"] = ["video"]
    mounts = _mounts(service)
    return {**made, "volumes": mounts} if mounts else made


def _literal(text: str) -> str:
    """Without what Compose would take for a variable; the hub's is meant so."""
    return text if text == _HUB else text.replace("$", "$$")


def _mounts(service: Service) -> list[dict[str, Any]]:
    if service.row.make is None:
        return []
    mounts = [_bound("./config", CONFIG), {"type": "volume", "source": "cache", "target": CACHE}]
    if service.with_fields:
        mounts.append(_bound("${FIELDPOSE_FIELDS:-./fields}", FIELDS))
    if service.reads is not None:
        mounts.append(_bound(_literal(service.reads), _literal(service.reads)))
    if service.writes:
        mounts.append({"type": "volume", "source": "state", "target": STATE})
    return mounts


def _bound(source: str, target: str) -> dict[str, Any]:
    # A folder that is not there is an error, not an empty folder of root's.
    bind = {"create_host_path": False}
    return {"type": "bind", "source": source, "target": target, "read_only": True, "bind": bind}
