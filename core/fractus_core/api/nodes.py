"""Drone, EdgeNode and Depot: what there is to deploy on (thesis Listings 9 and 10)."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from fractus_core.api.geometry import Point, Position
from fractus_core.api.methods import CameraMethod, MobilityMethod
from fractus_core.api.model import AGE, READY, Condition, Model, OpenModel, Resource
from fractus_core.api.names import Name

Technology = Literal["Ethernet", "4G", "5G", "WiFi", "BLE"]
FlightState = Literal["inactive", "charging", "takingOff", "flying", "landing"]
GROUNDED: frozenset[FlightState] = frozenset({"inactive", "charging"})
"""Flight states of a drone on the ground."""


class Pairing(Model):
    """How two interfaces of one technology find each other."""

    mode: Literal["adhoc", "infrastructure"] = Field(default="adhoc", description="Ad hoc, or through an access point.")
    network_id: str = Field(min_length=1, max_length=64, description="Name of the network (SSID for WiFi).")


class Interface(Model):
    """A network interface of a node."""

    technology: Technology
    device: str | None = Field(
        default=None, max_length=15, description="Name of the device on the node, such as wlan0."
    )
    range: float | None = Field(
        default=None, gt=0, le=100_000, description="Reach of a direct link in metres; unset: no direct links."
    )
    pairing: Pairing | None = Field(default=None, description="Needed for direct links.")


class Dimensions(Model):
    """Outer dimensions of an airframe."""

    height: float = Field(gt=0, description="Millimetres.")
    length: float = Field(gt=0, description="Millimetres.")
    width: float = Field(gt=0, description="Millimetres.")


class PhysicalFeatures(Model):
    """The airframe."""

    dimensions: Dimensions | None = None
    mtom: float | None = Field(default=None, gt=0, description="Maximum take-off mass in grams.")


class MobilityFeatures(Model):
    """What the mobility service of a drone offers."""

    autopilot: Literal["ardupilot"] = Field(default="ardupilot", description="The autopilot's firmware family.")
    connection: str = Field(
        default="tcp:127.0.0.1:5760",
        pattern=r"^(tcp|udpin|udpout|serial):.+$",
        max_length=128,
        description="Link to the autopilot on the node: tcp:, udpin:, udpout: or serial:DEVICE:BAUD.",
    )
    max_altitude: float = Field(gt=0, le=20000, description="Metres above home.")
    max_flight_time: float = Field(gt=0, le=1440, description="Minutes with a full battery.")
    max_speed: float = Field(gt=0, le=100, description="Metres per second over ground.")
    methods: tuple[MobilityMethod, ...] = Field(min_length=1, max_length=32, description="Methods offered.")


class CameraMount(Model):
    """How a camera sits on its node."""

    pitch: float = Field(
        default=-90, ge=-90, le=90, description="Degrees: 0 looks forward, -90 straight down, 90 straight up."
    )
    yaw: float = Field(
        default=0,
        ge=-360,
        le=360,
        description="Degrees clockwise from the drone's nose; on an edge node from true north.",
    )
    stabilised: bool = Field(default=False, description="Whether a gimbal keeps it level while the airframe tilts.")
    height: float | None = Field(
        default=None,
        ge=0,
        le=10_000,
        description="On an edge node: metres above the ground. Unset: unknown, and it may see everything around it.",
    )


class CameraFeatures(Model):
    """What the camera service of a node offers."""

    connection: str = Field(
        default="test:",
        pattern=r"^(https?://[^/].*|v4l2:/dev/.+|picamera2:[0-9]|directory:/.+|test:)$",
        max_length=512,
        description="Where pictures come from: http://HOST/snapshot.jpg, v4l2:/dev/video0, picamera2:0, directory:/PATH"
        " of geotagged pictures, or test: for a drawn one.",
    )
    model: str = Field(default="", max_length=128, description="Make and model.")
    resolution: str = Field(default="1920x1080", pattern=r"^\d{2,5}x\d{2,5}$", description="Pixels, WIDTHxHEIGHT.")
    sensor_type: Literal["RGB", "IR"] = Field(default="RGB", description="What the sensor sees.")
    horizontal_field_of_view: float | None = Field(
        default=None,
        gt=0,
        lt=180,
        description="Degrees from side to side. Unset: unknown, and privacy policies take it to see everything around.",
    )
    mount: CameraMount | None = Field(
        default=None, description="Unset: unknown, and privacy policies take it to look everywhere."
    )
    methods: tuple[CameraMethod, ...] = Field(min_length=1, max_length=32, description="Methods offered.")

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height."""
        width, height = self.resolution.split("x")
        return int(width), int(height)


class NodeServices(Model):
    """The system services of a node."""

    mobility: MobilityFeatures | None = None
    camera: CameraFeatures | None = None


class DroneSpec(Model):
    """A drone: airframe, interfaces, services."""

    mobility_type: Literal["quadcopter", "hexacopter", "octocopter"] = Field(
        default="quadcopter", description="How it moves."
    )
    class_: Literal["C0", "C1", "C2", "C3", "C4", "C5", "C6"] | None = Field(
        default=None, alias="class", description="Class of Commission Delegated Regulation (EU) 2019/945."
    )
    physical_features: PhysicalFeatures = Field(default_factory=PhysicalFeatures)
    interfaces: tuple[Interface, ...] = Field(default=(), max_length=16)
    services: NodeServices = Field(default_factory=NodeServices)
    depot: Name | None = Field(default=None, description="The Depot it is kept in.")
    home: Position | None = Field(
        default=None, description="Where it stands when not in use; alt is AMSL ground height."
    )
    autonomy: int | None = Field(
        default=None,
        ge=0,
        description="Seconds its pods stay when the node is unreachable; unset: indefinitely.",
    )


class Battery(OpenModel):
    """State of a drone's battery."""

    remaining: float = Field(ge=0, le=1, description="Share of the full charge, 0 to 1.")
    voltage: float | None = Field(default=None, description="Volts.")
    current: float | None = Field(default=None, description="Amperes drawn.")


class DroneStatus(OpenModel):
    """What the node's agent last saw, on change and every 10 s at most."""

    flight_state: FlightState = "inactive"
    position: Position | None = None
    battery: Battery | None = None
    controller: str | None = Field(default=None, description="Who flies: system, pilot, or the driver's identity.")
    last_seen: datetime | None = None
    conditions: tuple[Condition, ...] = ()


class Drone(Resource, plural="drones", short="drn"):
    """A drone that can host components."""

    COLUMNS = (
        ("Class", "string", ".spec.class"),
        ("Depot", "string", ".spec.depot"),
        ("State", "string", ".status.flightState"),
        ("Battery", "number", ".status.battery.remaining"),
        READY,
        AGE,
    )

    kind: Literal["Drone"] = "Drone"
    spec: DroneSpec
    status: DroneStatus | None = None


class EdgeNodeSpec(Model):
    """A fixed node at the edge."""

    location: Position
    interfaces: tuple[Interface, ...] = Field(default=(), max_length=16)
    services: NodeServices = Field(default_factory=NodeServices)


class EdgeNodeStatus(OpenModel):
    """What the node's agent last saw."""

    last_seen: datetime | None = None
    conditions: tuple[Condition, ...] = ()


class EdgeNode(Resource, plural="edgenodes", short="edn"):
    """A fixed node at the edge that can host components."""

    COLUMNS = (
        ("Latitude", "number", ".spec.location.lat"),
        ("Longitude", "number", ".spec.location.lon"),
        READY,
        AGE,
    )

    kind: Literal["EdgeNode"] = "EdgeNode"
    spec: EdgeNodeSpec
    status: EdgeNodeStatus | None = None


class DepotSpec(Model):
    """Where drones are kept and charged."""

    location: Point
    radius: float = Field(default=30, gt=0, le=10_000, description="Metres around location that belong to the depot.")


class Depot(Resource, plural="depots", short="dpt"):
    """A place where drones are kept and charged."""

    COLUMNS = (
        ("Latitude", "number", ".spec.location.lat"),
        ("Longitude", "number", ".spec.location.lon"),
        ("Radius", "number", ".spec.radius"),
    )

    kind: Literal["Depot"] = "Depot"
    spec: DepotSpec
