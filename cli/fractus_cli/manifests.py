"""Read manifests from files and directories, and provide the inventory and Applications for planning."""

from __future__ import annotations

import difflib
import errno
import math
import pathlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, TypeVar

from fractus_core import plausibility
from fractus_core.api import (
    API_VERSION,
    GROUP,
    KINDS,
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
from fractus_core.documents import MAX_BYTES, BadDocument, Documents, parse_documents
from fractus_core.planning import Host, Inventory
from fractus_core.planning.inventory import amount_of
from fractus_core.validation import check_policy, check_zone
from fractus_runtime import files

from fractus_cli.output import printable

R = TypeVar("R", bound=Resource)

_SUFFIXES = frozenset({".yaml", ".yml", ".json"})
_ASSUMED_CLOUD = "cloud"
_DEFAULT_KINDS: tuple[type[Resource], ...] = (Application, DeploymentPlan, Depot, Drone, EdgeNode, Policy, Zone)
_ALL_KINDS = frozenset(kind.KIND for kind in KINDS)
_METADATA = frozenset(
    {
        "name", "generateName", "namespace", "labels", "annotations", "finalizers", "ownerReferences", "managedFields",
        "uid", "generation", "resourceVersion", "selfLink", "creationTimestamp", "deletionTimestamp",
        "deletionGracePeriodSeconds",
    }
)  # fmt: skip
"""Fields of ObjectMeta."""


class BadManifest(Exception):
    """A manifest is invalid. The message names file, line, object and field."""

    def __init__(self, sentence: str) -> None:
        super().__init__(printable(sentence))


@dataclass(frozen=True, slots=True)
class Manifest:
    """Object that was read from a file."""

    file: pathlib.Path
    body: dict[str, Any]
    _documents: Documents

    def bad(self, problem: InvalidObject, *, described: str = "") -> BadManifest:
        """Return the error for a problem, with its file and line.

        Args:
            problem: Problem and field.
            described: Description of the object in the message. Default: its kind and name.
        """
        metadata = self.body.get("metadata")
        name = metadata.get("name", "") if isinstance(metadata, dict) else ""
        subject = described or f"{self.body.get('kind')} {name}".strip()
        return BadManifest(f"{self.where(problem.field)}: {subject}: {problem}")

    def where(self, path: str = "") -> str:
        """Return FILE:LINE of a field."""
        return self._documents.where(self.body, path)


@dataclass(frozen=True, slots=True)
class LoadedObject:
    """Object and the manifest from which it was read."""

    manifest: Manifest
    resource: Resource | Host


@dataclass
class Manifests:
    """All objects of the manifests, by kind, namespace and name."""

    objects: dict[tuple[str, str, str], LoadedObject] = field(default_factory=dict)

    def of(self, kind: type[R]) -> dict[str, R]:
        """Return the objects of a cluster-scoped kind by name."""
        return {f.resource.name: f.resource for f in self.objects.values() if isinstance(f.resource, kind)}

    def applications(self) -> list[Application]:
        """Return the Applications in planning order: first those with a driver (passengers may share its drone), then by name."""
        applications = [f.resource for f in self.objects.values() if isinstance(f.resource, Application)]
        return sorted(applications, key=lambda a: (a.spec.driver is None, a.key))

    def notes(self) -> Iterator[str]:
        """Yield notes about valid objects that are probably mistakes."""
        return plausibility.notes(
            depots=self.of(Depot).values(),
            zones=self.of(Zone).values(),
            edge_nodes=self.of(EdgeNode).values(),
            policies=self.of(Policy).values(),
            applications=self.applications(),
        )

    def previous(self, application: Application) -> DeploymentPlan | None:
        """Return the current plan of an Application if the manifests contain it."""
        namespace, name = application.key
        plans = [f.resource for f in self.objects.values() if isinstance(f.resource, DeploymentPlan)]
        return next(
            (
                p
                for p in plans
                if (p.metadata.namespace or "default") == namespace and p.spec.application == name and p.spec.placements
            ),
            None,
        )

    def bad(self, application: Application, problem: InvalidObject) -> BadManifest:
        """Return the error for a problem of an Application, with its file and line."""
        return self.objects[(Application.KIND, *application.key)].manifest.bad(problem)

    def inventory(self) -> Inventory:
        """Return the inventory for planning.

        Drones without a reported status are assumed to be Ready and fully charged. If there is no Node object, each drone
        and edge node has a host with unlimited resources, and there is a cloud host.
        """
        hosts = {f.resource.name: f.resource for f in self.objects.values() if isinstance(f.resource, Host)}
        drones = self.of(Drone)
        edge_nodes = self.of(EdgeNode)
        if not hosts:
            classes = {**dict.fromkeys(drones, "drone"), **dict.fromkeys(edge_nodes, "edge"), _ASSUMED_CLOUD: "cloud"}
            hosts = {name: Host(name, {CLASS_LABEL: c}, Unlimited()) for name, c in classes.items()}
        return Inventory(
            hosts=hosts,
            drones={name: _assume_ready(drone) for name, drone in drones.items()},
            edge_nodes=edge_nodes,
            depots=self.of(Depot),
            zones=self.of(Zone),
            policies=self.of(Policy),
        )


class Unlimited(Mapping[str, float]):
    """Unlimited resources, for a host without a Node object."""

    def __getitem__(self, resource: str) -> float:
        """Return infinity."""
        return math.inf

    def __iter__(self) -> Iterator[str]:
        """Return an empty iterator, because no resource is limited."""
        return iter(())

    def __len__(self) -> int:
        """Return 0, because no resource is limited."""
        return 0


def read_manifests(paths: Iterable[pathlib.Path], kinds: Iterable[type[Resource]] = _DEFAULT_KINDS) -> Manifests:
    """Read files, and the .yaml, .yml and .json files in directories, recursively.

    Args:
        paths: Files and directories.
        kinds: Kinds to read. Other kinds are skipped.

    Raises:
        BadManifest: A file cannot be read or parsed, or an object is invalid or a duplicate.
    """
    manifests = Manifests()
    read = {kind.KIND: kind for kind in kinds}
    for file, strict in _files(paths):
        for manifest in read_documents(file, strict=strict):
            resource = _resource(manifest, read)
            if resource is not None:
                _add(manifests, LoadedObject(manifest, resource))
    _check(manifests)
    return manifests


def _files(paths: Iterable[pathlib.Path]) -> Iterator[tuple[pathlib.Path, bool]]:
    for path in paths:
        if path.is_dir():
            inside = sorted(p for p in path.rglob("*") if p.suffix in _SUFFIXES and p.is_file())
            if not inside:
                raise BadManifest(f"{path}: the directory contains no .yaml, .yml or .json file")
            yield from ((p, False) for p in inside)
        else:
            yield path, True


def read_documents(file: pathlib.Path, *, strict: bool = True) -> Iterator[Manifest]:
    """Return the objects of a file, including the items of Lists.

    Args:
        file: YAML or JSON file.
        strict: True to reject documents that are not Kubernetes objects. False to skip them.

    Raises:
        BadManifest: The file cannot be read or parsed, or, if strict, contains a document that is not a Kubernetes object.
    """
    try:
        parsed = parse_documents(read_file(file), str(file), is_json=file.suffix == ".json")
    except BadDocument as error:
        raise BadManifest(str(error)) from None
    for body in parsed.values:
        if not isinstance(body, dict) or not isinstance(body.get("kind"), str):
            if strict:
                raise BadManifest(
                    f"{parsed.where(body)}: the document has no kind, so it is not a Kubernetes object; add apiVersion and kind"
                )
            continue
        items = body.get("items")
        if body["kind"].endswith("List") and isinstance(items, list):
            yield from (Manifest(file, item, parsed) for item in items if isinstance(item, dict))
        else:
            yield Manifest(file, body, parsed)


def read_file(file: pathlib.Path) -> bytes:
    """Return the content of a file.

    Raises:
        BadManifest: The file cannot be read, is not a regular file, or is too large.
    """
    try:
        return files.read_file(file, MAX_BYTES)
    except files.UnsuitableFile as error:
        if error.errno == errno.EFBIG:
            raise BadManifest(f"{files.path_text(file)}: larger than {MAX_BYTES // 2**20} MiB; split it") from None
        raise BadManifest(f"{files.path_text(file)}: is not a regular file; write its content to a file") from None
    except OSError as error:
        raise BadManifest(f"{files.path_text(file)}: {error.strerror}") from None


def _resource(manifest: Manifest, kinds: Mapping[str, type[Resource]]) -> Resource | Host | None:
    body = manifest.body
    kind = body.get("kind")
    try:
        if not _is_read(body, kinds):
            return None
        metadata = body.get("metadata")
        if not isinstance(metadata, dict) or not isinstance(metadata.get("name"), str):
            raise InvalidObject(
                "metadata.name", "must be a string; specify the name of the object, in quotes if it is a number"
            )
        unknown = sorted(metadata.keys() - _METADATA)
        if unknown:
            similar = difflib.get_close_matches(unknown[0], _METADATA, n=1)
            remedy = f"did you mean {similar[0]}?" if similar else "remove it, or correct its name"
            raise InvalidObject(f"metadata.{unknown[0]}", f"there is no such field; {remedy}")
        return _host(body) if kind == "Node" else kinds[str(kind)].from_body(body)
    except InvalidObject as error:
        raise manifest.bad(error) from None


def _is_read(body: Mapping[str, Any], kinds: Collection[str]) -> bool:
    """Return True if an object must be parsed. Objects of other projects and kinds that are not in `kinds` are skipped.

    Raises:
        InvalidObject: The object has a kind that the group of Fractus does not have, or a kind of Fractus in a wrong group.
    """
    kind = str(body.get("kind"))
    version = body.get("apiVersion")
    if version is None and kind in _ALL_KINDS:
        raise InvalidObject("apiVersion", f"is missing; write {API_VERSION}")
    group, _, _ = str(version).rpartition("/")
    if kind in _ALL_KINDS and group != GROUP and (not group or difflib.get_close_matches(group, [GROUP], cutoff=0.7)):
        raise InvalidObject("apiVersion", f"{version} has no kind {kind}; write {API_VERSION}")
    if group == GROUP and kind not in _ALL_KINDS:
        similar = difflib.get_close_matches(kind, _ALL_KINDS, n=1)
        hint = f"did you mean {similar[0]}?" if similar else f"use one of: {', '.join(sorted(_ALL_KINDS))}"
        raise InvalidObject("kind", f"{GROUP} has no kind {kind}; {hint}")
    return kind == "Node" or (kind in kinds and group == GROUP)


def _host(document: dict[str, Any]) -> Host:
    """Convert a Node to a host. Without allocatable resources the host has unlimited resources.

    Raises:
        InvalidObject: A quantity is invalid or a field has the wrong type.
    """
    metadata = document["metadata"]
    spec = _part(document, "spec")
    status = _part(document, "status")
    labels = _part(metadata, "labels", "metadata.labels")
    resources = _part(status, "allocatable", "status.allocatable") or _part(status, "capacity", "status.capacity")
    conditions = status.get("conditions") or ()
    if not isinstance(conditions, list | tuple) or not all(isinstance(c, dict) for c in conditions):
        raise InvalidObject("status.conditions", "must be a list of conditions")
    allocatable: Mapping[str, float] = Unlimited()
    if resources:
        amounts: dict[str, float] = {}
        for resource, amount in resources.items():
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


def _add(manifests: Manifests, loaded: LoadedObject) -> None:
    resource = loaded.resource
    kind = "Node" if isinstance(resource, Host) else resource.kind
    namespace = ""
    if isinstance(resource, Resource) and resource.NAMESPACED:
        namespace = resource.metadata.namespace or "default"
    key = (kind, namespace, resource.name)
    if key in manifests.objects:
        first = manifests.objects[key].manifest.where("metadata.name")
        raise loaded.manifest.bad(InvalidObject("metadata.name", f"duplicate of {first}; remove one of them"))
    manifests.objects[key] = loaded


def _check(manifests: Manifests) -> None:
    """Check rules of Zones, Policies and names of nodes that the schema cannot express."""
    zones = manifests.of(Zone)
    drones = manifests.of(Drone)
    for loaded in manifests.objects.values():
        resource = loaded.resource
        try:
            if isinstance(resource, Zone):
                check_zone(resource)
            elif isinstance(resource, Policy):
                check_policy(resource, zones)
            elif isinstance(resource, EdgeNode) and resource.name in drones:
                drone = manifests.objects[(Drone.KIND, "", resource.name)].manifest.where("metadata.name")
                raise InvalidObject(
                    "metadata.name",
                    f"{drone} is the Drone {resource.name}, and a node is either a drone or an edge node; rename one of them",
                )
        except InvalidObject as error:
            raise loaded.manifest.bad(error) from None


def _assume_ready(drone: Drone) -> Drone:
    """Add a Ready condition unless the manifest has one."""
    status = drone.status or DroneStatus()
    if any(c.type == "Ready" for c in status.conditions):
        return drone
    ready = Condition(
        type="Ready", status="True", reason="Assumed", last_transition_time=datetime.fromtimestamp(0, tz=UTC)
    )
    return drone.model_copy(update={"status": status.model_copy(update={"conditions": (*status.conditions, ready)})})
