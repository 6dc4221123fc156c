"""Drone, EdgeNode and Depot: the nodes that applications are deployed on (thesis Listings 9 and 10)."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from typing import Any, Literal

from pydantic import Field, JsonValue

from fractus_core.api.formats import AUTOPILOT_CONNECTION, CAMERA_CONNECTION, DEVICE, RESOLUTION, SSID
from fractus_core.api.geometry import Point, Position
from fractus_core.api.methods import CameraMethod, MobilityMethod
from fractus_core.api.model import AGE, GROUP, READY, Conditions, InvalidObject, Model, OpenModel, Resource
from fractus_core.api.names import Name
from fractus_core.api.rules import Violation, referenced_by, rule
from fractus_core.documents import BadDocument, parse_document

Technology = Literal["Ethernet", "4G", "5G", "WiFi", "BLE"]
FlightState = Literal["unknown", "inactive", "charging", "takingOff", "flying", "landing"]
GROUNDED: frozenset[FlightState] = frozenset({"inactive", "charging"})
"""Flight states of a drone on the ground."""

BANDWIDTH_MBPS: dict[Technology, float] = {"Ethernet": 100.0, "4G": 8.0, "5G": 50.0, "WiFi": 12.0, "BLE": 0.7}
"""Default usable bandwidth of an interface at good reception, in Mbit/s."""

FLIGHT_REPORT_S = 5.0
DRONE_REPORT_S = 30.0
EDGE_REPORT_S = 60.0
"""Maximum interval between two status reports of an agent, in seconds: airborne drone, grounded drone, edge node."""


CONDITIONS_BY_TYPE: dict[str, JsonValue] = {"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["type"]}
"""Schema keywords of the list of conditions.

They let the agent and the operator write different entries of the list.
"""


GROUNDED_ANNOTATION = f"{GROUP}/grounded"
"""Annotation of a Drone: a person saw the drone on the ground. The value is the `lastSeen` of the drone's last report, or
`never` before its first report. After the next report, the annotation is ignored."""

ON_MISSION = "OnMission"
"""Condition of a Drone, set by the operator.

Unless the condition is False, the drone may have taken off since its last report.
"""


def is_airborne(state: str | None, last: str | None) -> bool:
    """Return True if a drone is airborne according to its last known state. An unreachable drone keeps its last state.

    Args:
        state: Current flight state. None if the drone never reported, which counts as on the ground.
        last: Last known flight state.
    """
    known = last if state in {None, "unknown"} else state
    return known not in {None, "unknown", *GROUNDED}


class Pairing(Model):
    """Network settings with which two interfaces of one technology connect."""

    mode: Literal["adhoc", "infrastructure"] = Field(
        default="adhoc", description="adhoc (directly), or infrastructure (through an access point)."
    )
    network_id: str = Field(
        min_length=1, max_length=32, pattern=SSID, description="Network name (SSID for WiFi), ASCII."
    )


class Interface(Model):
    """A network interface of a node."""

    technology: Technology = Field(description="Network technology of the interface.")
    device: str | None = Field(
        default=None,
        max_length=15,
        pattern=DEVICE,
        description="Name of the network device on the node, such as wlan0.",
    )
    range: float | None = Field(
        default=None, gt=0, le=100_000, description="Range of a direct link in metres; unset: no direct links."
    )
    pairing: Pairing | None = Field(
        default=None, description="Network settings for direct links; without them, the interface has no direct links."
    )
    bandwidth: float | None = Field(
        default=None,
        gt=0,
        le=100_000,
        description="Usable bandwidth at good reception, in Mbit/s; default: "
        + ", ".join(f"{mbps:g} for {technology}" for technology, mbps in BANDWIDTH_MBPS.items())
        + ".",
    )

    @property
    def bandwidth_mbps(self) -> float:
        """Declared bandwidth, or the default of the technology."""
        return self.bandwidth if self.bandwidth is not None else BANDWIDTH_MBPS[self.technology]


def direct_interface(interfaces: Iterable[Interface]) -> Interface | None:
    """Return the interface for direct links: the first interface with a device, a range and a pairing."""
    usable = (each for each in interfaces if each.device and each.range is not None and each.pairing is not None)
    return next(usable, None)


class Dimensions(Model):
    """Outer dimensions of an airframe."""

    height: float = Field(gt=0, description="Height in millimetres.")
    length: float = Field(gt=0, description="Length in millimetres.")
    width: float = Field(gt=0, description="Width in millimetres.")


class PhysicalFeatures(Model):
    """Physical properties of the airframe."""

    dimensions: Dimensions | None = None
    mtom: float | None = Field(default=None, gt=0, description="Maximum take-off mass in grams.")


class MobilityFeatures(Model):
    """The mobility service of a drone."""

    autopilot: Literal["ardupilot"] = Field(default="ardupilot", description="Autopilot firmware family.")
    connection: str = Field(
        default="tcp:127.0.0.1:5760",
        pattern=AUTOPILOT_CONNECTION,
        max_length=128,
        description="Connection from the node to the autopilot: tcp:HOST:PORT, udpin:HOST:PORT, udpout:HOST:PORT or serial:DEVICE:BAUD.",
    )
    max_altitude: float = Field(gt=0, le=20000, description="Maximum altitude in metres above home.")
    max_flight_time: float = Field(gt=0, le=1440, description="Flight time with a full battery, in minutes.")
    max_speed: float = Field(gt=0, le=100, description="Maximum ground speed in metres per second.")
    methods: tuple[MobilityMethod, ...] = Field(min_length=1, max_length=32, description="Supported methods.")


class CameraMount(Model):
    """Mounting position and orientation of a camera."""

    pitch: float = Field(
        default=-90, ge=-90, le=90, description="Pitch in degrees: 0 is forward, -90 straight down, 90 straight up."
    )
    yaw: float = Field(
        default=0,
        ge=-360,
        le=360,
        description="Yaw in degrees clockwise: from the nose of a drone, from true north on an edge node.",
    )
    stabilised: bool = Field(
        default=False, description="True if a gimbal keeps the camera level while the airframe tilts."
    )
    gimbal: bool = Field(
        default=False,
        description="True if a gimbal of the autopilot moves the camera. The measured gimbal attitude then determines its view.",
    )
    height: float | None = Field(
        default=None,
        ge=0,
        le=10_000,
        description="Height above the ground in metres, for edge nodes only. If unset, privacy policies assume that the"
        " camera may see everything around it.",
    )


def _coefficient(name: str) -> Any:
    return Field(default=None, ge=-100, le=100, description=f"Distortion coefficient {name} of OpenCV; unset: 0.")


class CameraLens(Model):
    """Projection model of a camera lens."""

    model: Literal["pinhole", "brownConrady", "equidistant"] = Field(
        description="Lens model. pinhole: straight lines stay straight (also for rectified images). brownConrady: pinhole with"
        " calibrated distortion coefficients. equidistant: fisheye, angles are proportional to pixels."
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
    def _coefficients(self) -> Violation:
        coefficients = [name for name in ("k1", "k2", "k3", "p1", "p2") if getattr(self, name) is not None]
        return coefficients[0] if coefficients and self.model != "brownConrady" else None


class CameraFeatures(Model):
    """The camera service of a node."""

    connection: str = Field(
        default="test:",
        pattern=CAMERA_CONNECTION,
        max_length=512,
        description="Image source: http://HOST/snapshot.jpg, v4l2:/dev/video0, picamera2:0, directory:/PATH with geotagged"
        " images, or test: for generated images.",
    )
    model: str = Field(default="", max_length=128, description="Manufacturer and model.")
    resolution: str = Field(default="1920x1080", pattern=RESOLUTION, description="WIDTHxHEIGHT in pixels.")
    sensor_type: Literal["RGB", "IR"] = Field(default="RGB", description="Spectral range: RGB or IR (infrared).")
    horizontal_field_of_view: float | None = Field(
        default=None,
        gt=0,
        lt=180,
        description="Horizontal field of view in degrees through the image centre, including distortion. If unset, privacy"
        " policies assume that the camera sees everything around it.",
    )
    lens: CameraLens | None = Field(
        default=None,
        description="Lens model. If unset, privacy policies assume the widest view of all supported models.",
    )
    mount: CameraMount | None = Field(
        default=None,
        description="Mounting of the camera. If unset, privacy policies assume that it may look in any direction.",
    )
    methods: tuple[CameraMethod, ...] = Field(min_length=1, max_length=32, description="Supported methods.")

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height in pixels."""
        width, height = self.resolution.split("x")
        return int(width), int(height)

    def unknown_view(self, fixed: bool) -> str:
        """Return the missing fields without which the field of view is unknown, comma-separated; empty if none is missing.

        Args:
            fixed: True for an edge node, False for a drone.
        """
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
    """Airframe, network interfaces and services of a drone."""

    mobility_type: Literal["quadcopter", "hexacopter", "octocopter"] = Field(
        default="quadcopter", description="Airframe type."
    )
    class_: Literal["C0", "C1", "C2", "C3", "C4", "C5", "C6"] | None = Field(
        default=None, alias="class", description="UAS class according to Delegated Regulation (EU) 2019/945."
    )
    physical_features: PhysicalFeatures = Field(default_factory=PhysicalFeatures)
    interfaces: tuple[Interface, ...] = Field(default=(), max_length=16, description="Network interfaces.")
    services: NodeServices = Field(default_factory=NodeServices)
    depot: Name | None = Field(default=None, description="Name of the Depot where the drone is kept.")
    home: Position | None = Field(
        default=None, description="Parking position; alt is the ground elevation in metres above mean sea level."
    )
    autonomy: int | None = Field(
        default=None,
        ge=0,
        description="Seconds for which pods stay on the drone while its node is unreachable; unset: no time limit.",
    )

    @rule(
        "!has(self.services) || !has(self.services.camera) || !has(self.services.camera.mount)"
        " || !has(self.services.camera.mount.height)",
        "mount.height applies to cameras of edge nodes only; remove it",
    )
    def _no_camera_height(self) -> Violation:
        mount = self.services.camera.mount if self.services.camera is not None else None
        return "services.camera.mount.height" if mount is not None and mount.height is not None else None


class Battery(OpenModel):
    """State of a drone's battery."""

    remaining: float = Field(ge=0, le=1, description="State of charge, 0 to 1.")
    voltage: float | None = Field(default=None, description="Voltage in volts.")
    current: float | None = Field(default=None, description="Current draw in amperes.")


_AUDIT: Any = Field(
    default=(),
    max_length=16,
    description="Last entries of the audit logs of the services as LOG:NUMBER:HASH, for `fractus audit verify --since`.",
)


class DroneStatus(OpenModel):
    """State of a drone as reported by its agent. Unavailable position and battery values keep their last known value."""

    flight_state: FlightState = Field(
        default="unknown", description="Current flight state; unknown without current telemetry."
    )
    last_flight_state: FlightState | None = Field(default=None, description="Last known flight state.")
    position: Position | None = None
    battery: Battery | None = None
    controller: str | None = Field(
        default=None, description="Control authority: system, pilot, or the component of the driver."
    )
    last_seen: datetime | None = Field(default=None, description="Time of the last report of the agent.")
    audit: tuple[str, ...] = _AUDIT
    records_address: str | None = Field(
        default=None,
        max_length=270,
        description="HOST:PORT of the agent's recording endpoint; unset: the agent serves no records.",
    )
    conditions: Conditions = Field(default=(), json_schema_extra=CONDITIONS_BY_TYPE)

    @property
    def in_air(self) -> bool:
        """True if the drone is airborne according to its last known state."""
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
        """True if the drone is airborne according to its last known state."""
        return self.status is not None and self.status.in_air and not self.grounded_by_hand

    @property
    def on_ground(self) -> bool:
        """True if the drone is on the ground according to its last known state. It is False before the first report."""
        if self.status is None or self.grounded_by_hand:
            return self.grounded_by_hand
        states = {self.status.flight_state, self.status.last_flight_state}
        return not self.in_air and not states.isdisjoint(GROUNDED)

    @property
    def may_take_off(self) -> bool:
        """True if the drone may have taken off since its last report."""
        conditions = self.status.conditions if self.status is not None else ()
        unsure = any(c.type == ON_MISSION and c.status != "False" for c in conditions)
        return unsure and not self.grounded_by_hand

    @property
    def grounded_by_hand(self) -> bool:
        """True if a person declared the drone grounded (`GROUNDED_ANNOTATION`) and the drone has not reported since."""
        declared = self.metadata.annotations.get(GROUNDED_ANNOTATION)
        last_seen = self.status.last_seen if self.status is not None else None
        if declared is None or last_seen is None:
            return declared == "never"
        try:
            return datetime.fromisoformat(declared.replace("Z", "+00:00")) == last_seen
        except ValueError:
            return False


class EdgeNodeSpec(Model):
    """A fixed node at the edge."""

    location: Position
    interfaces: tuple[Interface, ...] = Field(default=(), max_length=16, description="Network interfaces.")
    services: NodeServices = Field(default_factory=NodeServices)

    @rule("!has(self.services) || !has(self.services.mobility)", "an edge node cannot fly; remove services.mobility")
    def _no_mobility(self) -> Violation:
        return "services.mobility" if self.services.mobility is not None else None

    @rule(
        "!has(self.services) || !has(self.services.camera) || !has(self.services.camera.mount)"
        " || !has(self.services.camera.mount.gimbal) || !self.services.camera.mount.gimbal",
        "an edge node has no gimbal; remove gimbal and set pitch and yaw of the camera",
    )
    def _no_gimbal(self) -> Violation:
        mount = self.services.camera.mount if self.services.camera is not None else None
        return "services.camera.mount.gimbal" if mount is not None and mount.gimbal else None


class EdgeNodeStatus(OpenModel):
    """State of an edge node as reported by its agent."""

    last_seen: datetime | None = Field(default=None, description="Time of the last report of the agent.")
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
    """Location of a drone base."""

    location: Point
    radius: float = Field(default=30, gt=0, le=10_000, description="Radius of the depot around location, in metres.")


class Depot(Resource, plural="depots", short="dpt"):
    """A place where drones are kept and charged."""

    COLUMNS = (
        ("Latitude", "number", ".spec.location.lat"),
        ("Longitude", "number", ".spec.location.lon"),
        ("Radius", "number", ".spec.radius"),
    )

    kind: Literal["Depot"] = "Depot"
    spec: DepotSpec

    _nameable = referenced_by("Depot", "drones and applications")


class InvalidDescription(Exception):
    """A node description is invalid. The message states the line, the field and the remedy."""


def parse_description(text: str, *kinds: type[Drone | EdgeNode]) -> Drone | EdgeNode | None:
    """Parse a node description.

    Args:
        text: YAML with one manifest.
        kinds: Accepted kinds.

    Returns:
        The Drone or EdgeNode, or None if the text is empty.

    Raises:
        InvalidDescription: The text is not one valid manifest of an accepted kind.
    """
    try:
        body, document = parse_document(text.encode(), "description")
    except BadDocument as error:
        raise InvalidDescription(f"line {error.line}: {error.problem}") from None
    if body is None:
        return None
    kind = next((kind for kind in kinds if isinstance(body, dict) and body.get("kind") == kind.KIND), None)
    if kind is None:
        raise InvalidDescription(f"must contain one manifest of kind {' or '.join(kind.KIND for kind in kinds)}")
    try:
        return kind.from_body(body)
    except InvalidObject as error:
        raise InvalidDescription(f"line {document.line(body, error.field)}: {error}") from None
