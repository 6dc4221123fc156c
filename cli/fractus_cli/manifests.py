"""Manifests of any mix of kinds, from files and directories, as an inventory and the applications to plan."""

from __future__ import annotations

import difflib
import math
import pathlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, TypeVar

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

from fractus_cli.output import printable

R = TypeVar("R", bound=Resource)

_SUFFIXES = frozenset({".yaml", ".yml", ".json"})
_ASSUMED_CLOUD = "cloud"
_READ: tuple[type[Resource], ...] = (Application, DeploymentPlan, Depot, Drone, EdgeNode, Policy, Zone)
_EVERY = frozenset(kind.KIND for kind in KINDS)
_METADATA = frozenset(
    {
        "name", "generateName", "namespace", "labels", "annotations", "finalizers", "ownerReferences", "managedFields",
        "uid", "generation", "resourceVersion", "selfLink", "creationTimestamp", "deletionTimestamp",
        "deletionGracePeriodSeconds",
    }
)  # fmt: skip
"""The fields of ObjectMeta."""


class BadManifest(Exception):
    """A manifest cannot be used; one sentence that names the file, the line, the object and the field."""

    def __init__(self, sentence: str) -> None:
        super().__init__(printable(sentence))


@dataclass(frozen=True, slots=True)
class Manifest:
    """An object as a file has it."""

    file: pathlib.Path
    body: dict[str, Any]
    _documents: Documents

    def bad(self, problem: InvalidObject, *, described: str = "") -> BadManifest:
        """That something is wrong with it, and where.

        Args:
            problem: what, and the field.
            described: how the object is called in the sentence; by default by its kind and name.
        """
        metadata = self.body.get("metadata")
        name = metadata.get("name", "") if isinstance(metadata, dict) else ""
        about = described or f"{self.body.get('kind')} {name}".strip()
        return BadManifest(f"{self.where(problem.field)}: {about}: {problem}")

    def where(self, path: str = "") -> str:
        """FILE:LINE of a field."""
        return self._documents.where(self.body, path)


@dataclass(frozen=True, slots=True)
class Found:
    """An object and the manifest it was read from."""

    manifest: Manifest
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

    def bad(self, application: Application, problem: InvalidObject) -> BadManifest:
        """That something is wrong with an application, and where."""
        return self.found[(Application.KIND, *application.key)].manifest.bad(problem)

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


def read_manifests(paths: Iterable[pathlib.Path], kinds: Iterable[type[Resource]] = _READ) -> Manifests:
    """Read files, and the .yaml, .yml and .json files in directories and below.

    Args:
        paths: of files and directories.
        kinds: what is read; others are passed over.

    Raises:
        BadManifest: a file cannot be read or parsed, an object breaks the rules of its kind, or is there twice.
    """
    manifests, read = Manifests(), {kind.KIND: kind for kind in kinds}
    for file, strict in _files(paths):
        for manifest in documents(file, strict=strict):
            resource = _resource(manifest, read)
            if resource is not None:
                _add(manifests, Found(manifest, resource))
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


def documents(file: pathlib.Path, *, strict: bool = True) -> Iterator[Manifest]:
    """The objects of a file, also those in Lists.

    Args:
        file: YAML or JSON.
        strict: whether what is no Kubernetes object is an error, rather than passed over.

    Raises:
        BadManifest: the file cannot be read or parsed, or, if strict, holds something else.
    """
    try:
        found = parse_documents(read_file(file), str(file), is_json=file.suffix == ".json")
    except BadDocument as error:
        raise BadManifest(str(error)) from None
    for body in found.values:
        if not isinstance(body, dict) or not isinstance(body.get("kind"), str):
            if strict:
                raise BadManifest(f"{found.where(body)}: a document has no kind; it is no Kubernetes object")
            continue
        items = body.get("items")
        if body["kind"].endswith("List") and isinstance(items, list):
            yield from (Manifest(file, item, found) for item in items if isinstance(item, dict))
        else:
            yield Manifest(file, body, found)


def read_file(file: pathlib.Path) -> bytes:
    """The content of a file, as far as it may be long: also of a device or pipe that never ends.

    Raises:
        BadManifest: it cannot be read, or is too long.
    """
    try:
        with file.open("rb") as opened:
            content = opened.read(MAX_BYTES + 1)
    except OSError as error:
        raise BadManifest(f"{file}: {error.strerror}") from None
    if len(content) > MAX_BYTES:
        raise BadManifest(f"{file}: it has more than {MAX_BYTES // 2**20} MiB; split it")
    return content


def _resource(manifest: Manifest, kinds: Mapping[str, type[Resource]]) -> Resource | Host | None:
    body = manifest.body
    kind = body.get("kind")
    try:
        if not _is_ours(body, kinds):
            return None
        metadata = body.get("metadata")
        if not isinstance(metadata, dict) or not isinstance(metadata.get("name"), str):
            raise InvalidObject("metadata.name", "must be a text; give the object a name")
        unknown = sorted(metadata.keys() - _METADATA)
        if unknown:
            raise InvalidObject(f"metadata.{unknown[0]}", "there is no such field; remove it, or correct its name")
        return _host(body) if kind == "Node" else kinds[str(kind)].from_body(body)
    except InvalidObject as error:
        raise manifest.bad(error) from None


def _is_ours(body: Mapping[str, Any], kinds: Collection[str]) -> bool:
    """Whether this is an object that is read, rather than one of another project or of another use.

    Raises:
        InvalidObject: it says that it is one of Fractus' kinds, and there is no such kind.
    """
    kind, version = str(body.get("kind")), body.get("apiVersion")
    if version is None and kind in _EVERY:
        raise InvalidObject("apiVersion", f"is missing; write {API_VERSION}")
    group, _, _ = str(version).rpartition("/")
    if kind in _EVERY and group != GROUP and (not group or difflib.get_close_matches(group, [GROUP], cutoff=0.7)):
        raise InvalidObject("apiVersion", f"{version} has no kind {kind}; write {API_VERSION}")
    if group == GROUP and kind not in _EVERY:
        near = difflib.get_close_matches(kind, _EVERY, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(sorted(_EVERY))}"
        raise InvalidObject("kind", f"{GROUP} has no kind {kind}; {hint}")
    return kind == "Node" or (kind in kinds and group == GROUP)


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


def _add(manifests: Manifests, found: Found) -> None:
    resource = found.resource
    kind = "Node" if isinstance(resource, Host) else resource.kind
    namespace = ""
    if isinstance(resource, Resource) and resource.NAMESPACED:
        namespace = resource.metadata.namespace or "default"
    key = (kind, namespace, resource.name)
    if key in manifests.found:
        there = manifests.found[key].manifest.where("metadata.name")
        raise found.manifest.bad(InvalidObject("metadata.name", f"{there} has it too; remove one of them"))
    manifests.found[key] = found


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
            raise found.manifest.bad(error) from None


def _reported(drone: Drone) -> Drone:
    """The drone as it stands ready, unless its manifest says how it is."""
    status = drone.status or DroneStatus()
    if any(c.type == "Ready" for c in status.conditions):
        return drone
    ready = Condition(
        type="Ready", status="True", reason="Assumed", last_transition_time=datetime.fromtimestamp(0, tz=UTC)
    )
    return drone.model_copy(update={"status": status.model_copy(update={"conditions": (*status.conditions, ready)})})
