"""Manifests of any mix of kinds, from files and directories, as an inventory and the applications to plan."""

from __future__ import annotations

import json
import math
import pathlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, TypeVar

import yaml
from fractus_core.api import (
    API_VERSION,
    GROUP,
    Application,
    Condition,
    DeploymentPlan,
    Depot,
    Drone,
    EdgeNode,
    InvalidObject,
    Policy,
    Resource,
    Zone,
)
from fractus_core.api.names import CLASS_LABEL
from fractus_core.api.nodes import DroneStatus
from fractus_core.planning import Host, Inventory
from fractus_core.planning.quantities import amount_of
from fractus_core.validation import check_policy, check_zone

R = TypeVar("R", bound=Resource)

_SUFFIXES = frozenset({".yaml", ".yml", ".json"})
_ASSUMED_CLOUD = "cloud"
_READ: tuple[type[Resource], ...] = (Application, DeploymentPlan, Depot, Drone, EdgeNode, Policy, Zone)
_KINDS: dict[str, type[Resource]] = {kind.KIND: kind for kind in _READ}


class BadManifest(Exception):
    """A manifest cannot be used; one sentence that names the file, the object and the field."""


@dataclass(frozen=True, slots=True)
class Found:
    """An object and the file it was read from."""

    origin: str
    resource: Resource | Host


@dataclass
class Manifests:
    """Everything that was read, by kind and (namespace, name)."""

    found: dict[tuple[str, str, str], Found] = field(default_factory=dict)

    def of(self, kind: type[R]) -> dict[str, R]:
        """The objects of a cluster-scoped kind by name."""
        return {f.resource.name: f.resource for f in self.found.values() if isinstance(f.resource, kind)}

    def applications(self) -> list[Application]:
        """The applications to plan: those with a driver first, for passengers may come along; else by name."""
        every = [f.resource for f in self.found.values() if isinstance(f.resource, Application)]
        return sorted(every, key=lambda a: (a.spec.driver is None, a.key))

    def previous(self, application: Application) -> DeploymentPlan | None:
        """The plan that is in force for an application, if its manifest is among those read."""
        namespace, name = application.key
        plans = [f.resource for f in self.found.values() if isinstance(f.resource, DeploymentPlan)]
        return next(
            (
                p
                for p in plans
                if (p.metadata.namespace or "default") == namespace and p.spec.application == name and p.spec.placements
            ),
            None,
        )

    def origin(self, application: Application) -> str:
        """The file an application is from."""
        return self.found[(Application.KIND, *application.key)].origin

    def inventory(self) -> Inventory:
        """What applications can be planned on.

        Drones that do not say how they are count as Ready and full. Without any Node object every drone and edge node
        has a host of unlimited resources, and there is a cloud.
        """
        hosts = {f.resource.name: f.resource for f in self.found.values() if isinstance(f.resource, Host)}
        drones, edge_nodes = self.of(Drone), self.of(EdgeNode)
        if not hosts:
            classes = {**dict.fromkeys(drones, "drone"), **dict.fromkeys(edge_nodes, "edge"), _ASSUMED_CLOUD: "cloud"}
            hosts = {name: Host(name, {CLASS_LABEL: c}, Unlimited()) for name, c in classes.items()}
        return Inventory(
            hosts=hosts,
            drones={name: _reported(drone) for name, drone in drones.items()},
            edge_nodes=edge_nodes,
            depots=self.of(Depot),
            zones=self.of(Zone),
            policies=self.of(Policy),
        )


class Unlimited(Mapping[str, float]):
    """Resources of a host without a description: as much as is asked for."""

    def __getitem__(self, resource: str) -> float:
        """Without end."""
        return math.inf

    def __iter__(self) -> Iterator[str]:
        """No resource is named."""
        return iter(())

    def __len__(self) -> int:
        """No resource is named."""
        return 0


def read_manifests(paths: Iterable[pathlib.Path]) -> Manifests:
    """Read files, and the .yaml, .yml and .json files in directories and below; other kinds are passed over.

    Raises:
        BadManifest: a file cannot be read or parsed, an object breaks the rules of its kind, or is there twice.
    """
    manifests = Manifests()
    for file, strict in _files(paths):
        for document in documents(file, strict=strict):
            resource = _resource(document, str(file))
            if resource is not None:
                _add(manifests, resource, str(file))
    _check(manifests)
    return manifests


def _files(paths: Iterable[pathlib.Path]) -> Iterator[tuple[pathlib.Path, bool]]:
    for path in paths:
        if path.is_dir():
            inside = sorted(p for p in path.rglob("*") if p.suffix in _SUFFIXES and p.is_file())
            if not inside:
                raise BadManifest(f"{path}: the directory has no .yaml, .yml or .json file")
            yield from ((p, False) for p in inside)
        else:
            yield path, True


def documents(file: pathlib.Path, *, strict: bool = True) -> Iterator[dict[str, Any]]:
    """The objects of a file, also those in Lists.

    Args:
        file: YAML or JSON.
        strict: whether what is no Kubernetes object is an error, rather than passed over.

    Raises:
        BadManifest: the file cannot be read or parsed, or, if strict, holds something else.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
        found = [json.loads(text)] if file.suffix == ".json" else list(yaml.safe_load_all(text))
    except OSError as error:
        raise BadManifest(f"{file}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise BadManifest(f"{file}: this is no text file in UTF-8") from None
    except RecursionError:
        raise BadManifest(f"{file}: it is nested too deeply; flatten it") from None
    except json.JSONDecodeError as error:
        raise BadManifest(f"{file}:{error.lineno}: {error.msg[:1].lower()}{error.msg[1:]}") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark is not None else ""
        raise BadManifest(f"{file}{line}: {getattr(error, 'problem', None) or 'this is no YAML'}") from None
    for document in (document for document in found if document is not None):
        if not isinstance(document, dict) or not isinstance(document.get("kind"), str):
            if strict:
                raise BadManifest(f"{file}: a document has no kind; it is no Kubernetes object")
            continue
        items = document.get("items")
        if document["kind"].endswith("List") and isinstance(items, list):
            yield from (item for item in items if isinstance(item, dict))
        else:
            yield document


def _resource(document: dict[str, Any], origin: str) -> Resource | Host | None:
    kind = document.get("kind")
    if kind in _KINDS and str(document.get("apiVersion", API_VERSION)).partition("/")[0] != GROUP:
        return None  # another project's kind of the same name
    metadata = document.get("metadata")
    name = metadata.get("name") if isinstance(metadata, dict) else None
    if kind != "Node" and kind not in _KINDS:
        return None
    if not isinstance(name, str):
        raise BadManifest(f"{origin}: {kind}: metadata.name: give the object a name")
    try:
        return _host(document) if kind == "Node" else _KINDS[str(kind)].from_body(document)
    except InvalidObject as error:
        raise BadManifest(f"{origin}: {kind} {name}: {error}") from None


def _host(document: dict[str, Any]) -> Host:
    """A Node as a host; one without allocatable resources has as much as anyone asks for.

    Raises:
        InvalidObject: a quantity is none, or a field has the wrong type.
    """
    metadata, spec, status = document["metadata"], _part(document, "spec"), _part(document, "status")
    labels = _part(metadata, "labels", "metadata.labels")
    described = _part(status, "allocatable", "status.allocatable") or _part(status, "capacity", "status.capacity")
    conditions = status.get("conditions") or ()
    if not isinstance(conditions, list | tuple) or not all(isinstance(c, dict) for c in conditions):
        raise InvalidObject("status.conditions", "must be a list of conditions")
    allocatable: Mapping[str, float] = Unlimited()
    if described:
        amounts: dict[str, float] = {}
        for resource, amount in described.items():
            try:
                amounts[resource] = amount_of(amount)
            except (ValueError, TypeError):
                raise InvalidObject(f"status.allocatable.{resource}", f"{amount!r} is not a quantity") from None
        allocatable = amounts
    ready = [c.get("status") == "True" for c in conditions if c.get("type") == "Ready"]
    return Host(
        name=metadata["name"],
        labels=dict(labels),
        allocatable=allocatable,
        ready=all(ready),
        schedulable=not spec.get("unschedulable", False),
    )


def _part(document: dict[str, Any], key: str, name: str = "") -> dict[str, Any]:
    part = document.get(key)
    if part is not None and not isinstance(part, dict):
        raise InvalidObject(name or key, f"must be an object, not {part!r:.40}")
    return part or {}


def _add(manifests: Manifests, resource: Resource | Host, origin: str) -> None:
    kind = "Node" if isinstance(resource, Host) else resource.kind
    namespace = ""
    if isinstance(resource, Resource) and resource.NAMESPACED:
        namespace = resource.metadata.namespace or "default"
    key = (kind, namespace, resource.name)
    if key in manifests.found:
        raise BadManifest(f"{origin}: {kind} {resource.name}: metadata.name: {manifests.found[key].origin} has it too")
    manifests.found[key] = Found(origin, resource)


def _check(manifests: Manifests) -> None:
    """Refuse zones and policies that no schema can refuse."""
    zones = manifests.of(Zone)
    for found in manifests.found.values():
        resource = found.resource
        try:
            if isinstance(resource, Zone):
                check_zone(resource)
            elif isinstance(resource, Policy):
                check_policy(resource, zones)
        except InvalidObject as error:
            raise BadManifest(f"{found.origin}: {resource.name}: {error}") from None


def _reported(drone: Drone) -> Drone:
    """The drone as it stands ready, unless its manifest says how it is."""
    status = drone.status or DroneStatus()
    if any(c.type == "Ready" for c in status.conditions):
        return drone
    ready = Condition(
        type="Ready", status="True", reason="Assumed", last_transition_time=datetime.fromtimestamp(0, tz=UTC)
    )
    return drone.model_copy(update={"status": status.model_copy(update={"conditions": (*status.conditions, ready)})})
