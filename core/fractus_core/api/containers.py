"""The container of a component: image, environment, ports, resources, volumes."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from fractus_core.api.model import InvalidObject, Model, Quantity
from fractus_core.api.names import Name
from fractus_core.api.rules import Broken, rule


class ContainerPort(Model):
    """A port the component listens on."""

    port: int = Field(ge=1, le=65535)
    name: Name | None = None
    protocol: Literal["TCP", "UDP"] = "TCP"


class EnvVar(Model):
    """An environment variable."""

    name: str = Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$", max_length=128)
    value: str = Field(default="", max_length=32768)


class Resources(Model):
    """Kubernetes resources: cpu, memory, and extended ones such as fractus.dev/gpu."""

    requests: dict[str, Quantity] = Field(default_factory=dict, max_length=32)
    limits: dict[str, Quantity] = Field(default_factory=dict, max_length=32)


class EmptyDirectory(Model):
    """An empty directory that lives as long as the pod."""

    size_limit: Quantity | None = Field(default=None, description="Bytes, such as 256Mi; unset: what the node allows.")
    medium: Literal["disk", "memory"] = "disk"


class Volume(Model):
    """Files that the component sees: an empty directory, a ConfigMap, a Secret or a claim of storage."""

    name: Name
    mount_path: str = Field(
        pattern=r"^/[^:]*$", max_length=512, description="Where the component finds it; an absolute path."
    )
    read_only: bool = Field(default=False, description="ConfigMaps and Secrets are read-only anyway.")
    empty_dir: EmptyDirectory | None = None
    config_map: Name | None = Field(default=None, description="A ConfigMap of the application's namespace.")
    secret: Name | None = Field(default=None, description="A Secret of the application's namespace.")
    claim: Name | None = Field(default=None, description="A PersistentVolumeClaim of the application's namespace.")

    @rule(
        "[has(self.emptyDir), has(self.configMap), has(self.secret), has(self.claim)].filter(x, x).size() == 1",
        "give exactly one of emptyDir, configMap, secret and claim",
    )
    def _one_source(self) -> Broken:
        given = [s for s in (self.empty_dir, self.config_map, self.secret, self.claim) if s is not None]
        return "" if len(given) != 1 else None

    @rule(
        "!has(self.secret) || !self.secret.endsWith('-tls')",
        "Secrets whose names end in -tls are certificates of components; give yours another name",
    )
    def _own_secret(self) -> Broken:
        return "secret" if self.secret is not None and self.secret.endswith("-tls") else None

    def pod_volume(self) -> dict[str, Any]:
        """The entry for volumes of a pod."""
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
        """The entry for volumeMounts of a container."""
        fixed = self.config_map is not None or self.secret is not None
        return {"name": self.name, "mountPath": self.mount_path, "readOnly": self.read_only or fixed}


class Container(Model):
    """What runs in the component's pods."""

    image: str = Field(min_length=1, max_length=512)
    command: tuple[str, ...] = Field(default=(), max_length=64)
    args: tuple[str, ...] = Field(default=(), max_length=64)
    env: tuple[EnvVar, ...] = Field(default=(), max_length=256)
    ports: tuple[ContainerPort, ...] = Field(default=(), max_length=32)
    resources: Resources = Field(default_factory=Resources)
    volumes: tuple[Volume, ...] = Field(default=(), max_length=16)

    @model_validator(mode="after")
    def _distinct_names(self) -> Self:
        for i in _repeated(v.name for v in self.env):
            raise InvalidObject(f"env[{i}].name", f"{self.env[i].name} is there twice; remove one of them")
        for i in _repeated((p.port, p.protocol) for p in self.ports):
            raise InvalidObject(f"ports[{i}].port", f"{self.ports[i].port} is there twice; remove one of them")
        for i in _repeated(p.name for p in self.ports):
            raise InvalidObject(f"ports[{i}].name", f"{self.ports[i].name} is taken; choose another name")
        # The pod has volumes of its own, of these names.
        for i in _repeated((v.name for v in self.volumes), taken=("tls", "tmp")):
            raise InvalidObject(f"volumes[{i}].name", f"{self.volumes[i].name} is taken; choose another name")
        for i in _repeated(v.mount_path for v in self.volumes):
            raise InvalidObject(
                f"volumes[{i}].mountPath", f"{self.volumes[i].mount_path} is taken; choose another path"
            )
        return self


def _repeated(keys: Iterable[Hashable | None], taken: Iterable[Hashable] = ()) -> list[int]:
    """Where keys are that are taken, or came before; None is no key."""
    seen, found = set(taken), []
    for i, key in enumerate(keys):
        if key is not None and key in seen:
            found.append(i)
        seen.add(key)
    return found
