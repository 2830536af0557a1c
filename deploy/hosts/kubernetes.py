"""A site as manifests for Kubernetes: `kubectl apply -k` of a folder, with the certificates in it."""

from __future__ import annotations

from typing import Any

from fieldpose.deploy.graph import HUB
from fieldpose.deploy.hosts.services import CACHE, CONFIG, FIELDS, PORT, STATE, TLS, Service, Site
from fieldpose.deploy.hosts.writing import to_yaml
from fieldpose.errors import UsageError

_HUB = f"tls/{HUB}:{PORT}"
_CONFIG_MAP = "fieldpose-config"
_PART_OF = {"app.kubernetes.io/part-of": "fieldpose"}
_HUB_LABELS = {"app.kubernetes.io/name": HUB, **_PART_OF}
_NODE_OF_CAMERA = "fieldpose/camera"
_USER, _VIDEO = 1000, 44
_READ_BY_GROUP = 0o440
_FIELDS_GB, _STATE_GB = 5, 50
_MOST_RETRIES = 100
"""Of a camera of files, while the hub is not there yet; the waits grow to five minutes."""


def files(site: Site) -> dict[str, bytes]:
    """The files of a folder, by their names in it. Raises UsageError where pods are to share memory."""
    if site.shared_memory:
        raise UsageError("pods do not share /dev/shm; leave out --shared-memory")
    documents = [
        {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": site.namespace}},
        *_claims(site),
        _service_of_hub(),
        *_network_policies(),
        *(_workload(service, site) for service in site.services),
    ]
    return {
        "kustomization.yaml": site.note.encode() + to_yaml(_kustomization(site)),
        "fieldpose.yaml": site.note.encode() + to_yaml(*documents),
        **{f"config/{name}": content for name, content in site.files.items()},
    }


def _kustomization(site: Site) -> dict[str, Any]:
    its = {service.row.name: service.certificates for service in site.services}
    return {
        "apiVersion": "kustomize.config.k8s.io/v1beta1",
        "kind": "Kustomization",
        "namespace": site.namespace,
        "resources": ["fieldpose.yaml"],
        "configMapGenerator": [{"name": _CONFIG_MAP, "files": [f"config/{name}" for name in site.files]}],
        "secretGenerator": [
            {"name": _secret(role), "files": [f"certs/{name}" for name in its[role]]} for role in site.roles
        ],
    }  # fmt: skip


def _secret(role: str) -> str:
    return f"fieldpose-tls-{role}"


def _claims(site: Site) -> list[dict[str, Any]]:
    made = [_claim("fields", "ReadWriteMany", _FIELDS_GB)]
    if any(service.writes for service in site.services):
        made.append(_claim("state", "ReadWriteOnce", _STATE_GB))
    return made


def _claim(name: str, mode: str, size_gb: int) -> dict[str, Any]:
    resources = {"requests": {"storage": f"{size_gb}Gi"}}
    spec = {"accessModes": [mode], "resources": resources}
    return {"apiVersion": "v1", "kind": "PersistentVolumeClaim", "metadata": {"name": name}, "spec": spec}


def _service_of_hub() -> dict[str, Any]:
    ports = [{"name": "zenoh", "port": PORT, "targetPort": PORT, "protocol": "TCP"}]
    spec = {"selector": _HUB_LABELS, "ports": ports}
    return {"apiVersion": "v1", "kind": "Service", "metadata": {"name": HUB, "labels": _PART_OF}, "spec": spec}


def _network_policies() -> list[dict[str, Any]]:
    # Whatever else runs in the cluster has no business at their ports, though it would have no certificate either.
    own = {"podSelector": {"matchLabels": _PART_OF}}
    # Hubs of other groups, which may be in namespaces of their own.
    others = {"namespaceSelector": {}, "podSelector": {"matchLabels": _HUB_LABELS}}
    port = [{"port": PORT, "protocol": "TCP"}]
    return [
        _policy("fieldpose", _PART_OF, {"from": [own]}),
        _policy("fieldpose-hubs", _HUB_LABELS, {"from": [others], "ports": port}),
    ]


def _policy(name: str, labels: dict[str, str], ingress: dict[str, Any]) -> dict[str, Any]:
    spec = {"podSelector": {"matchLabels": labels}, "policyTypes": ["Ingress"], "ingress": [ingress]}
    about = {"name": name, "labels": _PART_OF}
    return {"apiVersion": "networking.k8s.io/v1", "kind": "NetworkPolicy", "metadata": about, "spec": spec}


def _workload(service: Service, site: Site) -> dict[str, Any]:
    """A deployment; a job where it ends by itself, as a camera of files does."""
    labels = {"app.kubernetes.io/name": service.name, **_PART_OF}
    about = {"name": service.name, "labels": labels}
    template = {"metadata": {"labels": labels}, "spec": _pod(service, site)}
    if service.reads is not None:
        template["spec"]["restartPolicy"] = "OnFailure"
        spec: dict[str, Any] = {"backoffLimit": _MOST_RETRIES, "template": template}
        return {"apiVersion": "batch/v1", "kind": "Job", "metadata": about, "spec": spec}
    spec = {
        "replicas": 1,
        # Never two that would answer the same message; more hosts take shares of their own.
        "strategy": {"type": "Recreate"},
        "selector": {"matchLabels": labels},
        "template": template,
    }
    return {"apiVersion": "apps/v1", "kind": "Deployment", "metadata": about, "spec": spec}


def _pod(service: Service, site: Site) -> dict[str, Any]:
    volumes, mounts = _volumes(service)
    groups = {"supplementalGroups": [_VIDEO]} if service.device is not None else {}
    # A camera is plugged in, or its files are, somewhere; that node is given the label.
    tied = service.device is not None or service.reads is not None
    return {
        **({"nodeSelector": {_NODE_OF_CAMERA: service.name}} if tied else {}),
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "terminationGracePeriodSeconds": round(service.stop_s),
        "securityContext": {
            "runAsNonRoot": True, "runAsUser": _USER, "runAsGroup": _USER, "fsGroup": _USER, **groups,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [{
            "name": service.row.name,
            "image": site.image,
            # In an argument it would stand for a variable.
            "args": [word.replace("$(", "$$(") for word in service.command(_HUB, TLS, shared_memory=False)],
            "env": [{"name": name, "value": value} for name, value in service.environment.items()],
            **({"ports": [{"name": "zenoh", "containerPort": PORT}]} if service.row.name == HUB else {}),
            "resources": {
                "requests": {"cpu": str(service.threads), "memory": f"{service.memory_mb // 4}Mi"},
                "limits": {"memory": f"{service.memory_mb}Mi"},
            },
            "securityContext": _context(service),
            "volumeMounts": mounts,
        }],
        "volumes": volumes,
    }  # fmt: skip


def _context(service: Service) -> dict[str, Any]:
    context: dict[str, Any] = {"readOnlyRootFilesystem": True}
    if service.device is not None:
        # Without a plugin for devices Kubernetes gives them to no one else.
        return {**context, "privileged": True}
    return {**context, "allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}


def _volumes(service: Service) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """What a pod has, and where its container has it."""
    those: list[tuple[str, dict[str, Any], str, bool]] = [
        ("tls", {"secret": {"secretName": _secret(service.row.name), "defaultMode": _READ_BY_GROUP}}, TLS, True),
        ("tmp", {"emptyDir": {}}, "/tmp", False),
    ]
    if service.row.make is not None:
        those.append(("config", {"configMap": {"name": _CONFIG_MAP}}, CONFIG, True))
        those.append(("cache", {"emptyDir": {}}, CACHE, False))
    if service.with_fields:
        those.append(("fields", {"persistentVolumeClaim": {"claimName": "fields", "readOnly": True}}, FIELDS, True))
    if service.writes:
        those.append(("state", {"persistentVolumeClaim": {"claimName": "state"}}, STATE, False))
    device = service.container_device
    if device is not None:
        those.append(("device", {"hostPath": {"path": device, "type": "CharDevice"}}, device, False))
    if service.reads is not None:
        those.append(("source", {"hostPath": {"path": service.reads}}, service.reads, True))
    volumes = [{"name": name, **volume} for name, volume, _, _ in those]
    mounts = [{"name": name, "mountPath": at, **({"readOnly": True} if read else {})} for name, _, at, read in those]
    return volumes, mounts
