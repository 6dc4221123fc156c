"""Data model of cluster files."""

from __future__ import annotations

import re
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from fractus_core.api import API_VERSION, Drone, EdgeNode, InvalidObject, Resource
from fractus_core.api.geometry import VehicleHome
from fractus_core.api.names import DNS_LABEL
from fractus_core.documents import BadDocument, Documents, dump_documents, parse_document
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from fractus_cluster.errors import ClusterError

NodeClass = Literal["drone", "edge", "cloud"]

_SUFFIXES: dict[str, Decimal | int] = {
    "": 1,
    "m": Decimal("0.001"),
    "k": 10**3,
    "M": 10**6,
    "G": 10**9,
    "T": 10**12,
    "Ki": 2**10,
    "Mi": 2**20,
    "Gi": 2**30,
    "Ti": 2**40,
}
MIN_DISK_BYTES = 16 * 2**20
"""Minimum size of a node's disk. It is sufficient for the file system and some files."""

_DEFAULT_CONNECTION = "tcp:127.0.0.1:5760"


def parse_quantity(text: str) -> Decimal:
    """Return the value of a Kubernetes quantity ("500m", "2Gi", "4").

    Raises:
        ValueError: The text is not a quantity.
    """
    match = re.fullmatch(r"([0-9.]+)([A-Za-z]*)", text.strip())
    if match is None or match[2] not in _SUFFIXES:
        raise ValueError(f"{text!r} is not a quantity such as 2, 500m or 4Gi")
    try:
        return Decimal(match[1]) * _SUFFIXES[match[2]]
    except InvalidOperation as error:
        raise ValueError(f"{text!r} is not a quantity such as 2, 500m or 4Gi") from error


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class VehicleHardware(_Frozen):
    """Simulated vehicle of a drone node.

    Attributes:
        home: Start position. Default: `description.location`.
        listen: Autopilot endpoint in the node's network namespace. Default: `description.services.mobility.connection`.
        charge: Percent per minute by which the battery charges while the vehicle is disarmed within 20 m of `home`.
        arguments: Additional arguments of `fractus-vehicle`.
    """

    home: VehicleHome | None = None
    listen: str | None = None
    charge: Annotated[float, Field(ge=0, le=6000, allow_inf_nan=False)] = 10.0
    arguments: tuple[str, ...] = ()


class Place(_Frozen):
    """A position on the ground, degrees (WGS 84)."""

    lat: Annotated[float, Field(ge=-85, le=85)]
    lon: Annotated[float, Field(ge=-180, le=180)]


class CameraHardware(_Frozen):
    """Simulated camera of a drone or edge node. Its properties are taken from `description.services.camera`.

    Attributes:
        origin: Centre of the landscape. Default: all cameras of a cluster use the position of the first.
        seed: Seed of landscape and moving objects. Cameras with the same seed share a world.
        arguments: Additional arguments of `fractus-camera-world`.
    """

    origin: Place | None = None
    seed: int = 7
    arguments: tuple[str, ...] = ()


class WifiHardware(_Frozen):
    """A WiFi device of a node in the simulated radio.

    Attributes:
        device: Device name on the node.
        range: Actual range, metres. Default: the range in `description.interfaces`.
    """

    device: Annotated[str, Field(max_length=15)] = "wlan0"
    range: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None


class UplinkHardware(_Frozen):
    """A mobile uplink that replaces a wire.

    Attributes:
        rate: Mbit/s in each direction.
        delay: Milliseconds in each direction.
    """

    rate: Annotated[float, Field(gt=0, le=100)] = 8.0
    delay: Annotated[float, Field(ge=0, le=10_000)] = 60.0


class DiskHardware(_Frozen):
    """A separate disk for a node's /var/lib/fractus. Default: the disk of the machine.

    Attributes:
        size: Bytes, as a quantity. An existing disk keeps its size.
    """

    size: str

    @field_validator("size")
    @classmethod
    def _holds_files(cls, value: str) -> str:
        if parse_quantity(value) < MIN_DISK_BYTES:
            raise ValueError(f"the minimum size of a disk is {MIN_DISK_BYTES // 2**20}Mi")
        return value

    @property
    def size_bytes(self) -> int:
        """Size in bytes."""
        return int(parse_quantity(self.size))


class Hardware(_Frozen):
    """Simulated hardware of a node. It keeps its power when the node is powered off."""

    vehicle: VehicleHardware | None = None
    camera: CameraHardware | None = None
    wifi: WifiHardware | None = None
    uplink: UplinkHardware | None = None
    disk: DiskHardware | None = None


class AirSpec(_Frozen):
    """Settings shared by all WiFi devices of a cluster.

    Attributes:
        fading: Shape of Nakagami fading, at least 0.5. Smaller values blur the range limit more. Default: sharp limit.
        seed: Seed of fading.
    """

    fading: Annotated[float, Field(ge=0.5, le=100)] | None = None
    seed: int = 1


class NodeSpec(_Frozen):
    """One node.

    Attributes:
        name: Name of the Kubernetes node.
        node_class: Field `class` of the file.
        resources: Resources for pods: cpu, memory, pods, and extended resources by full name.
        labels: Additional labels of the node.
        description: Spec of the node's Drone or EdgeNode, written to /etc/fractus/node.yaml. If empty, there is no such
            file and the node is not registered.
        hardware: Simulated hardware of the node.
    """

    name: Annotated[str, Field(pattern=DNS_LABEL, max_length=40)]
    node_class: Annotated[NodeClass, Field(alias="class")]
    resources: dict[str, str] = Field(default_factory=dict)
    labels: dict[str, str] = Field(default_factory=dict)
    description: dict[str, Any] = Field(default_factory=dict)
    hardware: Hardware = Hardware()

    @field_validator("resources", mode="before")
    @classmethod
    def _as_text(cls, value: object) -> object:
        return {key: str(amount) for key, amount in value.items()} if isinstance(value, dict) else value

    @field_validator("resources")
    @classmethod
    def _quantities(cls, value: dict[str, str]) -> dict[str, str]:
        for key, amount in value.items():
            if key not in ("cpu", "memory", "pods") and "/" not in key:
                raise ValueError(f"{key!r}: resources are cpu, memory, pods or <domain>/<name>")
            parse_quantity(amount)
        return value

    @model_validator(mode="after")
    def _hardware_fits(self) -> NodeSpec:
        if self.hardware.vehicle is not None and self.node_class != "drone":
            raise ValueError(f"node {self.name}: hardware.vehicle is for nodes of class drone")
        if self.hardware.camera is not None:
            self._camera_fits()
        if self.hardware.wifi is not None:
            if self.wifi() is None:
                raise ValueError(
                    f"node {self.name}: hardware.wifi has no range; set its range, or the range of "
                    f"{self.hardware.wifi.device} in description.interfaces"
                )
            if self.vehicle() is None and self.place() is None:
                raise ValueError(f"node {self.name}: hardware.wifi needs a vehicle or description.location")
        return self

    def _camera_fits(self) -> None:
        if self.node_class == "cloud":
            raise ValueError(f"node {self.name}: hardware.camera is for drones and edge nodes")
        if self.vehicle() is None and self.place() is None:
            raise ValueError(f"node {self.name}: hardware.camera needs a vehicle or description.location")
        height = _dig(self.description, "services", "camera", "mount", "height")
        if self.node_class == "edge" and height is None:
            raise ValueError(
                f"node {self.name}: hardware.camera has no height; "
                "set description.services.camera.mount.height, metres above the ground"
            )
        if camera_address(self.camera_url) is None:
            raise ValueError(
                f"node {self.name}: hardware.camera cannot serve {self.camera_url!r}; "
                "set description.services.camera.connection to http://127.0.0.1:8090/snapshot.jpg"
            )

    @model_validator(mode="after")
    def _description_fits(self) -> NodeSpec:
        if self.node_class == "cloud" and self.description:
            raise ValueError(f"node {self.name}: description is for drones and edge nodes, not for cloud nodes")
        if self.manifest is not None:
            kind: type[Resource] = Drone if self.node_class == "drone" else EdgeNode
            try:
                kind.from_body(self.manifest)
            except InvalidObject as error:
                raise ValueError(f"node {self.name}: description: {error}") from error
        return self

    @property
    def extended_resources(self) -> dict[str, str]:
        """Extended resources: all except cpu, memory and pods."""
        return {key: amount for key, amount in self.resources.items() if "/" in key}

    @property
    def manifest(self) -> dict[str, Any] | None:
        """Drone or EdgeNode manifest of this node. None without description."""
        if self.node_class == "cloud" or not self.description:
            return None
        kind = "Drone" if self.node_class == "drone" else "EdgeNode"
        return {"apiVersion": API_VERSION, "kind": kind, "metadata": {"name": self.name}, "spec": self.description}

    def vehicle(self) -> tuple[VehicleHome, str, tuple[str, ...]] | None:
        """Return home, autopilot endpoint and additional arguments of the node's vehicle. Return None without vehicle.

        Raises:
            ClusterError: The node is a drone and the position of its vehicle is not specified.
        """
        vehicle = self.hardware.vehicle
        connection = _dig(self.description, "services", "mobility", "connection")
        if self.node_class != "drone" or (vehicle is None and connection is None):
            return None
        vehicle = vehicle or VehicleHardware()
        listen = vehicle.listen or (connection if isinstance(connection, str) else _DEFAULT_CONNECTION)
        home = vehicle.home or self._location()
        if home is None:
            raise ClusterError(
                f"node {self.name}: its vehicle has no start position; "
                "set hardware.vehicle.home or description.location with lat and lon"
            )
        return home, listen, vehicle.arguments

    def wifi(self) -> tuple[str, float] | None:
        """Return device name and range in metres of the node's simulated WiFi. Return None without WiFi or range."""
        wifi = self.hardware.wifi
        if wifi is None:
            return None
        described = self.description.get("interfaces") or []
        interfaces = (each for each in described if isinstance(each, dict) and each.get("device") == wifi.device)
        range_m = wifi.range or next((each["range"] for each in interfaces if each.get("range")), None)
        return None if range_m is None else (wifi.device, float(range_m))

    @property
    def camera_url(self) -> str:
        """URL of the pictures for the node's camera service."""
        url = _dig(self.description, "services", "camera", "connection")
        return url if isinstance(url, str) else "test:"

    def place(self) -> VehicleHome | None:
        """Return the start position of the node, or None if it is not specified."""
        vehicle = self.hardware.vehicle
        if vehicle is not None and vehicle.home is not None:
            return vehicle.home
        return self._location()

    def _location(self) -> VehicleHome | None:
        location = _dig(self.description, "location")
        if not isinstance(location, dict) or "lat" not in location or "lon" not in location:
            return None
        return VehicleHome(lat=location["lat"], lon=location["lon"], alt=location.get("alt") or 0.0)


class ClusterSpec(_Frozen):
    """A cluster: name, nodes, and radio settings."""

    name: Annotated[str, Field(pattern=DNS_LABEL, max_length=30)]
    air: AirSpec = AirSpec()
    nodes: Annotated[tuple[NodeSpec, ...], Field(min_length=1, max_length=100)]

    @model_validator(mode="after")
    def _names_differ(self) -> ClusterSpec:
        names = [node.name for node in self.nodes]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"nodes: several nodes have the name {', '.join(twice)}")
        return self

    @property
    def world_origin(self) -> Place | None:
        """Centre of the landscape of the cameras. None without cameras."""
        origin: Place | None = None
        for node in self.nodes:
            if node.hardware.camera is None:
                continue
            if node.hardware.camera.origin is not None:
                return node.hardware.camera.origin
            home = node.place()
            if origin is None and home is not None:
                origin = Place(lat=home.lat, lon=home.lon)
        return origin

    @classmethod
    def placeholder(cls, name: str) -> ClusterSpec:
        """Return a cluster with only its name."""
        return cls.model_validate({"name": name, "nodes": [{"name": "unknown", "class": "cloud"}]})

    def to_yaml(self) -> str:
        """Return the cluster as a file that `load_spec` reads back as an equal value."""
        return dump_documents([self.model_dump(mode="json", by_alias=True)])


def parse_spec(content: object, *, source: str, documents: Documents | None = None) -> ClusterSpec:
    """Create the cluster from parsed YAML.

    Args:
        content: Result of the YAML parser.
        source: Source for messages.
        documents: Maps fields to line numbers.

    Raises:
        ClusterError: A field is missing or invalid. The message names it.
    """
    try:
        return ClusterSpec.model_validate(content)
    except ValidationError as error:
        problem = InvalidObject.from_pydantic(error, ClusterSpec)
        where = documents.where(content, problem.field) if documents is not None else source
        raise ClusterError(f"{where}: {problem}") from error


def load_spec(path: Path) -> ClusterSpec:
    """Read a cluster file.

    Raises:
        ClusterError: The file is missing, is not YAML, or has an invalid field.
    """
    try:
        content, documents = parse_document(path.read_bytes(), str(path))
    except OSError as error:
        raise ClusterError(f"cannot read {path}: {error.strerror}") from error
    except BadDocument as error:
        raise ClusterError(str(error)) from None
    return parse_spec(content, source=str(path), documents=documents)


def camera_address(url: str) -> tuple[str, int] | None:
    """Return host and port of a snapshot URL that is served on the same node. Return None for any other URL."""
    try:
        parts = urlsplit(url)
        host = parts.hostname
        port = parts.port or 80
    except ValueError:
        return None
    local = parts.scheme == "http" and host in ("127.0.0.1", "localhost", "::1") and parts.path == "/snapshot.jpg"
    if not local:
        return None
    return "127.0.0.1" if host == "localhost" else str(host), port


def _dig(tree: object, *keys: str) -> object:
    """Return the value below nested mappings, or None if a key is missing."""
    for key in keys:
        if not isinstance(tree, dict):
            return None
        tree = tree.get(key)
    return tree
