"""The container of a component: image, environment, ports, resources, volumes."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterable
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from fractus_core.api.model import InvalidObject, Model, Quantity, keyed, quantity
from fractus_core.api.names import Name, PortName
from fractus_core.api.rules import Violation, rule

_RESOURCES = ("cpu", "memory", "ephemeral-storage")
_EXTENDED = (
    r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?([.][a-z0-9]([-a-z0-9]*[a-z0-9])?)*/[A-Za-z0-9]([-A-Za-z0-9_.]*[A-Za-z0-9])?$"
)
_NAME_LENGTH = 317
TLS_DIR = "/var/run/fractus/tls"
"""Directory with the certificate of a component."""
TMP_DIR = "/tmp"  # nosec B108  # noqa: S108  (the pod's own)
"""Directory that a component may write to."""
_OWN_VOLUMES = {"tls": TLS_DIR, "tmp": TMP_DIR}
_IMAGE = (
    r"^([a-zA-Z0-9]([-a-zA-Z0-9.]*[a-zA-Z0-9])?(:[0-9]+)?/)?[a-z0-9]+(([._]|__|-+)[a-z0-9]+)*"
    r"(/[a-z0-9]+(([._]|__|-+)[a-z0-9]+)*)*(:[A-Za-z0-9_][-A-Za-z0-9_.]{0,127})?(@[a-z0-9]+:[0-9a-f]{32,128})?$"
)


class ContainerPort(Model):
    """A port the component listens on."""

    port: int = Field(ge=1, le=65535, description="Port number.")
    name: PortName | None = Field(default=None, description="Port name; default: port- and the number.")
    protocol: Literal["TCP", "UDP"] = Field(default="TCP", description="Transport protocol (TCP or UDP).")

    @rule(
        "!has(self.name) || !self.name.startsWith('port-')",
        "names that begin with port- are reserved for ports without a name; choose another name or remove it",
    )
    def _own_name(self) -> Violation:
        return "name" if self.name is not None and self.name.startswith("port-") else None

    @property
    def label(self) -> str:
        """Name of the port, declared or generated."""
        return self.name or f"port-{self.port}{'-udp' if self.protocol == 'UDP' else ''}"


class EnvVar(Model):
    """An environment variable."""

    name: str = Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$", max_length=128, description="Name of the variable.")
    value: str = Field(default="", max_length=32768, description="Value as a string; put numbers in quotes.")

    @rule("!self.name.startsWith('FRACTUS_')", "names that begin with FRACTUS_ are reserved; choose another name")
    def _own_name(self) -> Violation:
        return "name" if self.name.startswith("FRACTUS_") else None


class Resources(Model):
    """Resource requests and limits: cpu, memory, ephemeral-storage and extended resources such as fractus.dev/gpu."""

    requests: dict[str, Quantity] = Field(
        default_factory=dict,
        max_length=32,
        description="Resources that the node must have available, as Kubernetes quantities.",
    )
    limits: dict[str, Quantity] = Field(
        default_factory=dict, max_length=32, description="Maximum resource usage, as Kubernetes quantities."
    )

    @rule(
        "[has(self.requests) ? self.requests : {}, has(self.limits) ? self.limits : {}]"
        f".all(m, m.all(k, k in {list(_RESOURCES)} || (k.size() <= {_NAME_LENGTH} && k.matches('{_EXTENDED}'))))",
        f"a resource must be {', '.join(_RESOURCES)}, or an extended resource such as fractus.dev/gpu",
    )
    def _known(self) -> Violation:
        for field, given in (("requests", self.requests), ("limits", self.limits)):
            for name in given:
                if name not in _RESOURCES and (len(name) > _NAME_LENGTH or not re.fullmatch(_EXTENDED, name)):
                    return field, f"not {name!r:.60}"
        return None

    @rule(
        "!has(self.requests) || !has(self.limits) || self.requests.all(k, !(k in self.limits) ||"
        " !isQuantity(string(self.requests[k])) || !isQuantity(string(self.limits[k])) ||"
        " quantity(string(self.requests[k])).compareTo(quantity(string(self.limits[k]))) <= 0)",
        "a request must not be above the limit of the same resource",
    )
    def _within_limits(self) -> Violation:
        for name, amount in self.requests.items():
            if name in self.limits and quantity(amount) > quantity(self.limits[name]):
                return f"requests.{name}", f"{amount} is above {self.limits[name]}"
        return None

    @rule(
        "!has(self.requests) || self.requests.all(k, !k.contains('/') || (has(self.limits) && k in self.limits &&"
        " (!isQuantity(string(self.requests[k])) || !isQuantity(string(self.limits[k])) ||"
        " quantity(string(self.requests[k])).compareTo(quantity(string(self.limits[k]))) == 0)))",
        "an extended resource needs a limit that is equal to its request",
    )
    def _not_overcommitted(self) -> Violation:
        for name, amount in self.requests.items():
            if "/" in name and (name not in self.limits or quantity(amount) != quantity(self.limits[name])):
                return f"limits.{name}"
        return None

    @rule(
        "!has(self.limits) || self.limits.all(k, !k.contains('/') || !isQuantity(string(self.limits[k])) ||"
        " quantity(string(self.limits[k])).isInteger())",
        "limits of extended resources must be whole numbers",
    )
    def _whole(self) -> Violation:
        parts = (name for name, amount in self.limits.items() if "/" in name and not quantity(amount).is_integer())
        return next((f"limits.{name}" for name in parts), None)


class EmptyDirectory(Model):
    """A directory that is empty at the start of the pod and deleted with it."""

    size_limit: Quantity | None = Field(
        default=None, description="Maximum size as a Kubernetes quantity, such as 256Mi; unset: limit of the node."
    )
    medium: Literal["disk", "memory"] = Field(
        default="disk", description="Storage medium; files in memory count as memory of the pod."
    )


class Volume(Model):
    """Files for a component: an empty directory, a ConfigMap, a Secret or a PersistentVolumeClaim."""

    name: Name = Field(description="Name of the volume, unique in the component.")
    mount_path: str = Field(
        pattern=r"^(/[^/:]+)+$", max_length=512, description="Absolute path of the volume in the container."
    )
    read_only: bool = Field(
        default=False, description="Mount without write access. ConfigMaps and Secrets are always read-only."
    )
    empty_dir: EmptyDirectory | None = None
    config_map: Name | None = Field(
        default=None, description="Name of a ConfigMap in the namespace of the application."
    )
    secret: Name | None = Field(default=None, description="Name of a Secret in the namespace of the application.")
    claim: Name | None = Field(
        default=None, description="Name of a PersistentVolumeClaim in the namespace of the application."
    )

    @rule(
        "[has(self.emptyDir), has(self.configMap), has(self.secret), has(self.claim)].filter(x, x).size() == 1",
        "give exactly one of emptyDir, configMap, secret and claim",
    )
    def _one_source(self) -> Violation:
        given = [s for s in (self.empty_dir, self.config_map, self.secret, self.claim) if s is not None]
        return "" if len(given) != 1 else None

    @rule(
        "!has(self.secret) || !self.secret.endsWith('-tls')",
        "Secrets with names ending in -tls are reserved for component certificates; choose another name",
    )
    def _own_secret(self) -> Violation:
        return "secret" if self.secret is not None and self.secret.endswith("-tls") else None

    @rule(
        f"!(self.name in {list(_OWN_VOLUMES)}) && !(self.mountPath in {list(_OWN_VOLUMES.values())})",
        f"the volumes {' and '.join(_OWN_VOLUMES)} at {' and '.join(_OWN_VOLUMES.values())} are reserved;"
        " choose another name and path",
    )
    def _apart(self) -> Violation:
        if self.name in _OWN_VOLUMES:
            return "name"
        return "mountPath" if self.mount_path in _OWN_VOLUMES.values() else None

    def pod_volume(self) -> dict[str, Any]:
        """Return the entry for `volumes` of the pod."""
        if self.empty_dir is not None:
            source: dict[str, Any] = {}
            if self.empty_dir.size_limit is not None:
                source["sizeLimit"] = self.empty_dir.size_limit
            if self.empty_dir.medium == "memory":
                source["medium"] = "Memory"
            return {"name": self.name, "emptyDir": source}
        if self.config_map is not None:
            return {"name": self.name, "configMap": {"name": self.config_map}}
        if self.secret is not None:
            return {"name": self.name, "secret": {"secretName": self.secret, "defaultMode": 0o440}}
        return {"name": self.name, "persistentVolumeClaim": {"claimName": self.claim}}

    def mount(self) -> dict[str, Any]:
        """Return the entry for `volumeMounts` of the container."""
        fixed = self.config_map is not None or self.secret is not None
        return {"name": self.name, "mountPath": self.mount_path, "readOnly": self.read_only or fixed}


class Container(Model):
    """The container of a component."""

    image: str = Field(
        min_length=1, max_length=512, pattern=_IMAGE, description="Image reference such as registry.example/app:1.2."
    )
    command: tuple[str, ...] = Field(
        default=(), max_length=64, description="Command of the container; default: the entry point of the image."
    )
    args: tuple[str, ...] = Field(default=(), max_length=64, description="Arguments of the command.")
    env: tuple[EnvVar, ...] = Field(
        default=(), max_length=256, json_schema_extra=keyed("name"), description="Environment variables."
    )
    ports: tuple[ContainerPort, ...] = Field(
        default=(),
        max_length=32,
        json_schema_extra=keyed("port", "protocol"),
        description="Ports that the component listens on. Components that name it in egress connect to the first one.",
    )
    resources: Resources = Field(default_factory=Resources)
    volumes: tuple[Volume, ...] = Field(
        default=(),
        max_length=16,
        json_schema_extra=keyed("name"),
        description="Volumes of the component.",
    )

    @model_validator(mode="after")
    def _distinct_keys(self) -> Self:
        """Reject duplicate list keys, as the API server does."""
        for i in _repeated(v.name for v in self.env):
            raise InvalidObject(f"env[{i}].name", f"{self.env[i].name} is duplicated; remove one of the entries")
        for i in _repeated((p.port, p.protocol) for p in self.ports):
            raise InvalidObject(f"ports[{i}].port", f"{self.ports[i].port} is duplicated; remove one of the entries")
        for i in _repeated(v.name for v in self.volumes):
            raise InvalidObject(f"volumes[{i}].name", f"{self.volumes[i].name} is duplicated; choose another name")
        return self

    @rule(
        "!has(self.ports) || self.ports.all(p, !has(p.name) || self.ports.exists_one(q, has(q.name) && q.name == p.name))",
        "port names must be unique; choose another name",
    )
    def _distinct_ports(self) -> Violation:
        return next((f"ports[{i}].name" for i in _repeated(p.label for p in self.ports)), None)

    @rule(
        "!has(self.volumes) || self.volumes.all(v, self.volumes.exists_one(w, w.mountPath == v.mountPath))",
        "mountPath must be unique; choose another path",
    )
    def _distinct_paths(self) -> Violation:
        return next((f"volumes[{i}].mountPath" for i in _repeated(v.mount_path for v in self.volumes)), None)


def _repeated(keys: Iterable[Hashable]) -> list[int]:
    """Return the indexes of keys that occurred before."""
    seen: set[Hashable] = set()
    repeated = []
    for i, key in enumerate(keys):
        if key in seen:
            repeated.append(i)
        seen.add(key)
    return repeated
