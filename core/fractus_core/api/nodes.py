"""Drone, EdgeNode and Depot: what there is to deploy on (thesis Listings 9 and 10)."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from typing import Any, Literal

from pydantic import Field, JsonValue

from fractus_core.api.geometry import Point, Position
from fractus_core.api.methods import CameraMethod, MobilityMethod
from fractus_core.api.model import AGE, GROUP, READY, Conditions, Model, OpenModel, Resource
from fractus_core.api.names import Name
from fractus_core.api.rules import Broken, named_by_others, rule

Technology = Literal["Ethernet", "4G", "5G", "WiFi", "BLE"]
FlightState = Literal["unknown", "inactive", "charging", "takingOff", "flying", "landing"]
GROUNDED: frozenset[FlightState] = frozenset({"inactive", "charging"})
"""Flight states of a drone on the ground."""

BANDWIDTH_MBPS: dict[Technology, float] = {"Ethernet": 100.0, "4G": 8.0, "5G": 50.0, "WiFi": 12.0, "BLE": 0.7}
"""What applications get of an interface in a good place, where its node does not say: Mbit/s."""

FLIGHT_REPORT_S, DRONE_REPORT_S, EDGE_REPORT_S = 5.0, 30.0, 60.0
"""Seconds between two reports of an agent at most: of a drone in the air, of one on the ground, of an edge node."""


CONDITIONS_BY_TYPE: dict[str, JsonValue] = {"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["type"]}
"""Agent and operator each write conditions of their own."""


GROUNDED_ANNOTATION = f"{GROUP}/grounded"
"""On a Drone: someone sees it on the ground; the value is the lastSeen that this is said of, and it counts until the next report."""

ON_MISSION = "OnMission"
"""Condition of a Drone, by the operator: unless False, it may have taken off since its last report."""


def is_airborne(state: str | None, last: str | None) -> bool:
    """Whether a drone is in the air for all that is known: one that is not heard of any more is where it was.

    Args:
        state: its flight state; None while it was never heard of, which takes it to be on the ground.
        last: the last one that was known.
    """
    known = last if state in {None, "unknown"} else state
    return known not in {None, "unknown", *GROUNDED}


class Pairing(Model):
    """How two interfaces of one technology find each other."""

    mode: Literal["adhoc", "infrastructure"] = Field(default="adhoc", description="Ad hoc, or through an access point.")
    network_id: str = Field(
        min_length=1, max_length=32, pattern=r"^[ -~]+$", description="Name of the network (SSID for WiFi), in ASCII."
    )


class Interface(Model):
    """A network interface of a node."""

    technology: Technology = Field(description="What it connects by.")
    device: str | None = Field(
        default=None,
        max_length=15,
        pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$",
        description="Name of the device on the node, such as wlan0.",
    )
    range: float | None = Field(
        default=None, gt=0, le=100_000, description="Reach of a direct link in metres; unset: no direct links."
    )
    pairing: Pairing | None = Field(default=None, description="Needed for direct links.")
    bandwidth: float | None = Field(
        default=None,
        gt=0,
        le=100_000,
        description="Mbit/s that applications get of it in a good place; unset: "
        + ", ".join(f"{mbps:g} for {technology}" for technology, mbps in BANDWIDTH_MBPS.items())
        + ".",
    )

    @property
    def bandwidth_mbps(self) -> float:
        """The bandwidth, declared or usual for its technology."""
        return self.bandwidth if self.bandwidth is not None else BANDWIDTH_MBPS[self.technology]


def direct_interface(interfaces: Iterable[Interface]) -> Interface | None:
    """The interface that a node's agent makes direct links over: the first with a device, a range and a pairing."""
    usable = (each for each in interfaces if each.device and each.range is not None and each.pairing is not None)
    return next(usable, None)


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
    gimbal: bool = Field(
        default=False,
        description="Whether a gimbal of the autopilot's moves it: its view then follows the attitude that is measured.",
    )
    height: float | None = Field(
        default=None,
        ge=0,
        le=10_000,
        description="On an edge node: metres above the ground. Unset: unknown, and it may see everything around it.",
    )


def _coefficient(name: str) -> Any:
    return Field(default=None, ge=-100, le=100, description=f"Distortion coefficient {name} of OpenCV; unset: 0.")


class CameraLens(Model):
    """How a camera's lens projects what it sees."""

    model: Literal["pinhole", "brownConrady", "equidistant"] = Field(
        description="pinhole: straight lines stay straight (as do those of a picture that is rectified); brownConrady: pinhole"
        " with the distortion that calibration tells; equidistant: a fisheye, with angles in proportion to pixels."
    )
    k1: float | None = _coefficient("k1")
    k2: float | None = _coefficient("k2")
    k3: float | None = _coefficient("k3")
    p1: float | None = _coefficient("p1")
    p2: float | None = _coefficient("p2")

    @rule(
        "self.model == 'brownConrady' || !(has(self.k1) || has(self.k2) || has(self.k3) || has(self.p1) || has(self.p2))",
        "distortion coefficients belong to model brownConrady",
    )
    def _coefficients(self) -> Broken:
        given = [name for name in ("k1", "k2", "k3", "p1", "p2") if getattr(self, name) is not None]
        return given[0] if given and self.model != "brownConrady" else None


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
    resolution: str = Field(
        default="1920x1080", pattern=r"^[1-9][0-9]{1,4}x[1-9][0-9]{1,4}$", description="Pixels, WIDTHxHEIGHT."
    )
    sensor_type: Literal["RGB", "IR"] = Field(default="RGB", description="What the sensor sees.")
    horizontal_field_of_view: float | None = Field(
        default=None,
        gt=0,
        lt=180,
        description="Degrees from side to side through the middle of the picture, distortion included. Unset: unknown, and"
        " privacy policies take it to see everything around.",
    )
    lens: CameraLens | None = Field(
        default=None, description="Unset: unknown, and privacy policies take it to see what any of these lenses may."
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

    def unknown_view(self, fixed: bool) -> str:
        """What is missing to know what it sees, on a fixed node or a drone; empty when nothing is."""
        missing = [] if self.horizontal_field_of_view is not None else ["horizontalFieldOfView"]
        if self.mount is None:
            missing.append("mount")
        elif fixed and self.mount.height is None:
            missing.append("mount.height")
        return ", ".join(missing)


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
    interfaces: tuple[Interface, ...] = Field(default=(), max_length=16, description="Its network interfaces.")
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

    @rule(
        "!has(self.services) || !has(self.services.camera) || !has(self.services.camera.mount)"
        " || !has(self.services.camera.mount.height)",
        "height is for the camera of an edge node; a drone's is where the drone is",
    )
    def _flies_its_camera(self) -> Broken:
        mount = self.services.camera.mount if self.services.camera is not None else None
        return "services.camera.mount.height" if mount is not None and mount.height is not None else None


class Battery(OpenModel):
    """State of a drone's battery."""

    remaining: float = Field(ge=0, le=1, description="Share of the full charge, 0 to 1.")
    voltage: float | None = Field(default=None, description="Volts.")
    current: float | None = Field(default=None, description="Amperes drawn.")


_AUDIT: Any = Field(
    default=(),
    max_length=16,
    description="LOG:NUMBER:HASH of the last entries of the services' audit logs, for `fractus audit verify --since`.",
)


class DroneStatus(OpenModel):
    """What the node's agent sees; where it sees nothing, the position and battery are the last known ones."""

    flight_state: FlightState = Field(
        default="unknown", description="What the drone does now; unknown while nothing is heard of it."
    )
    last_flight_state: FlightState | None = Field(default=None, description="The last flight state that was known.")
    position: Position | None = None
    battery: Battery | None = None
    controller: str | None = Field(default=None, description="Who flies: system, pilot, or the driver's identity.")
    last_seen: datetime | None = Field(default=None, description="When its agent last wrote this.")
    audit: tuple[str, ...] = _AUDIT
    conditions: Conditions = Field(default=(), json_schema_extra=CONDITIONS_BY_TYPE)

    @property
    def in_air(self) -> bool:
        """Whether it is in the air, for all that is known."""
        return is_airborne(self.flight_state, self.last_flight_state)


class Drone(Resource, plural="drones", short="drn"):
    """A drone that can host components."""

    COLUMNS = (
        ("Class", "string", ".spec.class"),
        ("Depot", "string", ".spec.depot"),
        ("State", "string", ".status.flightState"),
        ("Controller", "string", ".status.controller"),
        ("Battery", "number", ".status.battery.remaining"),
        READY,
        ("Reason", "string", ".status.conditions[?(@.type=='Ready')].reason"),
        AGE,
    )

    kind: Literal["Drone"] = "Drone"
    spec: DroneSpec
    status: DroneStatus | None = None

    @property
    def in_air(self) -> bool:
        """Whether it is in the air, for all that is known."""
        return self.status is not None and self.status.in_air and not self.grounded_by_hand

    @property
    def may_take_off(self) -> bool:
        """Whether it may have taken off since its last report, for all that is known."""
        conditions = self.status.conditions if self.status is not None else ()
        unsure = any(c.type == ON_MISSION and c.status != "False" for c in conditions)
        return unsure and not self.grounded_by_hand

    @property
    def grounded_by_hand(self) -> bool:
        """Whether someone saw it on the ground, and nothing was heard of it since."""
        said, seen = self.metadata.annotations.get(GROUNDED_ANNOTATION), self.status and self.status.last_seen
        try:
            return said is not None and seen is not None and datetime.fromisoformat(said.replace("Z", "+00:00")) == seen
        except ValueError:
            return False


class EdgeNodeSpec(Model):
    """A fixed node at the edge."""

    location: Position
    interfaces: tuple[Interface, ...] = Field(default=(), max_length=16, description="Its network interfaces.")
    services: NodeServices = Field(default_factory=NodeServices)

    @rule("!has(self.services) || !has(self.services.mobility)", "an edge node does not fly; remove services.mobility")
    def _fixed(self) -> Broken:
        return "services.mobility" if self.services.mobility is not None else None

    @rule(
        "!has(self.services) || !has(self.services.camera) || !has(self.services.camera.mount)"
        " || !has(self.services.camera.mount.gimbal) || !self.services.camera.mount.gimbal",
        "a gimbal belongs to a drone's autopilot; give pitch and yaw of the camera",
    )
    def _no_gimbal(self) -> Broken:
        mount = self.services.camera.mount if self.services.camera is not None else None
        return "services.camera.mount.gimbal" if mount is not None and mount.gimbal else None


class EdgeNodeStatus(OpenModel):
    """What the node's agent last saw."""

    last_seen: datetime | None = Field(default=None, description="When its agent last wrote this.")
    audit: tuple[str, ...] = _AUDIT
    conditions: Conditions = Field(default=(), json_schema_extra=CONDITIONS_BY_TYPE)


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

    _nameable = named_by_others("Depot", "drones and applications")
