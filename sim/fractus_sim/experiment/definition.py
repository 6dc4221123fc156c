"""Data model of experiment files: vehicles, environment, tasks, programs, timed faults and checks."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

from fractus_core.api.geometry import AltitudeBand, Area, VehicleHome
from fractus_core.api.model import InvalidObject, Model
from fractus_core.api.names import Name
from fractus_core.documents import BadDocument, parse_document
from fractus_vehicle.earth import Place
from pydantic import AfterValidator, Field, ValidationError, model_validator

from fractus_sim.experiment.checks import (
    ApplicationPhase,
    CallJudged,
    Check,
    DataSent,
    Detections,
    InsideZone,
    OutsideZone,
    ProgramEnded,
    TaskDone,
    VehicleCheck,
)
from fractus_sim.experiment.task_steps import Step
from fractus_sim.experiment.timed_faults import LINK_OF_MODE, Fault, LinkLoss, NodePowerOff

Mode = Literal["vehicles", "standalone", "cluster"]
ParameterName = Annotated[str, Field(pattern=r"^[A-Z][A-Z0-9_]{0,15}$")]
MAX_VEHICLES = 50
MAX_PORT = 65535


def _tcp_link(text: str) -> str:
    match = re.fullmatch(r"tcp:[^:\s]+:(\d{1,5})", text)
    if match is None or not 1 <= int(match[1]) <= MAX_PORT:
        raise InvalidObject(
            "",
            f"must be tcp:HOST:PORT, not {text!r}; connect other links, such as UDP, through MAVProxy or mavlink-router",
        )
    return text


TcpLink = Annotated[str, AfterValidator(_tcp_link)]


class Wind(Model):
    """Wind at the start."""

    speed: float = Field(default=0, ge=0, lt=60, description="Metres per second.")
    direction: float = Field(default=270, ge=0, lt=360, description="Direction that the wind comes from, degrees.")
    turbulence: float = Field(default=0, ge=0, lt=30, description="Standard deviation, metres per second.")


class CameraWorld(Model):
    """World that cameras see (mode standalone)."""

    seed: int = Field(default=1, description="Seed of the generated ground.")
    arguments: tuple[str, ...] = Field(default=(), description="Additional arguments of `fractus camera-world`.")


class VehicleEntry(Model):
    """A vehicle, or a row of identical vehicles."""

    name: Name = Field(description="Name of the vehicle. If `count` is above 1, the names are NAME-1, NAME-2, ...")
    count: int = Field(default=1, ge=1, le=MAX_VEHICLES)
    spacing: float = Field(default=10, gt=0, le=1000, description="Metres between the vehicles of a row.")
    bearing: float = Field(default=90, ge=0, lt=360, description="Direction in which the row extends, degrees.")
    home: VehicleHome | None = None
    heading: float = Field(default=0, ge=0, lt=360, description="Degrees.")
    parameters: dict[ParameterName, float] = Field(default_factory=dict, description="Autopilot parameters.")
    ready_after: float = Field(default=5, ge=1, le=120, description="Seconds until the autopilot is ready to arm.")
    connection: TcpLink | None = Field(
        default=None,
        description="tcp:HOST:PORT of a running autopilot, such as ArduPilot SITL (modes vehicles and standalone). The autopilot"
        " must accept several connections.",
    )
    camera: bool = Field(default=False, description="Add a camera and the camera service (mode standalone).")
    task: tuple[Step, ...] = Field(
        default=(), max_length=500, description="Steps that the ground station of the experiment flies."
    )

    @model_validator(mode="after")
    def _check_running_autopilot(self) -> Self:
        if self.connection is not None and (self.count > 1 or self.parameters):
            raise InvalidObject("connection", "count and parameters cannot be set for a running autopilot; remove them")
        return self

    def names(self) -> tuple[str, ...]:
        """Return the name of each vehicle of this entry."""
        if self.count == 1:
            return (self.name,)
        return tuple(f"{self.name}-{number}" for number in range(1, self.count + 1))


class NamedZone(Model):
    """An airspace volume. Checks refer to it, and figures show it."""

    name: Name
    kind: Literal["exclusion", "inclusion", "other"] = "other"
    area: Area
    altitude: AltitudeBand | None = None


class Program(Model):
    """A program that runs during the experiment.

    In mode vehicles, the environment variable FRACTUS_VEHICLE contains the MAVLink connection of the vehicle. In mode
    standalone, the program runs as a component of the application, with the environment of the component's pod.
    """

    name: Name
    command: tuple[str, ...] = Field(min_length=1, description="Relative paths are relative to the experiment file.")
    vehicle: Name | None = Field(default=None, description="Vehicle that the program flies (mode vehicles).")
    component: str | None = Field(default=None, description="Component that the program implements (mode standalone).")
    node: Name | None = Field(
        default=None, description="Entry of `nodes` on which the program runs. Unset: the drone of the component."
    )
    port: int | None = Field(
        default=None,
        ge=1024,
        le=65535,
        description="Port where the program listens. Other programs get the address by the name of the component (mode standalone).",
    )
    environment: dict[str, str] = Field(default_factory=dict)
    background: bool = Field(default=False, description="Do not wait for the program; stop it at the end.")


class NodeEntry(Model):
    """An edge node, or the cloud."""

    name: Name
    place: VehicleHome | None = Field(
        default=None, description="Position. Unset: the ranges of networks do not apply, as for the cloud."
    )


class SimulatedNetwork(Model):
    """A network between nodes. Delay and bandwidth refer to real time, also with `speedup`."""

    name: Name
    participants: tuple[Name, ...] = Field(min_length=1, description="Names of vehicles and nodes.")
    range: float | None = Field(default=None, gt=0, description="Maximum distance, metres. Unset: unlimited.")
    loss: float = Field(default=0, ge=0, lt=1, description="Share of lost packets.")
    delay: float = Field(default=0, ge=0, le=10, description="Seconds in each direction.")
    bandwidth: float = Field(default=1000, gt=0, le=1000, description="Mbit/s that each participant can send.")


class ClusterPart(Model):
    """The embedded cluster and its manifests."""

    file: str = Field(description="Cluster file, relative to the experiment file.")
    images: tuple[str, ...] = Field(default=(), description="Additional targets of the Dockerfile to build.")
    apply: tuple[str, ...] = Field(min_length=1, description="Manifests. The Applications among them are applied last.")


@dataclass(frozen=True, slots=True)
class VehicleSetup:
    """A vehicle of an experiment.

    Attributes:
        entry: Entry of the experiment file that the vehicle belongs to.
        home: Start position. None for a running autopilot, or if the cluster file defines it.
    """

    name: str
    system_id: int
    entry: VehicleEntry
    home: VehicleHome | None


class Experiment(Model):
    """An experiment."""

    name: Name
    description: str = ""
    mode: Mode = Field(
        default="vehicles",
        description="vehicles: autopilots only; standalone: with the services of Fractus as local processes; cluster: on the"
        " embedded Kubernetes cluster.",
    )
    seed: int = Field(default=1, ge=0, description="Seed of all noise.")
    speedup: float | None = Field(
        default=None,
        ge=0,
        le=100,
        description="Factor of real time. 0 (mode vehicles, default without programs): lockstep, as fast as possible and"
        " exactly repeatable.",
    )
    timeout: float = Field(default=300, gt=0, le=7200, description="Maximum duration, seconds of the experiment.")
    settle: float = Field(default=3, ge=0, le=600, description="Seconds to continue after the last task and fault.")
    wind: Wind = Wind()
    world: CameraWorld = CameraWorld()
    vehicles: tuple[VehicleEntry, ...] = Field(min_length=1, max_length=MAX_VEHICLES)
    zones: tuple[NamedZone, ...] = ()
    manifests: tuple[str, ...] = Field(
        default=(),
        description="Files or directories with Application, Policy, Zone, Depot and Drone manifests (mode standalone).",
    )
    programs: tuple[Program, ...] = ()
    nodes: tuple[NodeEntry, ...] = Field(default=(), description="Edge nodes and the cloud (mode standalone).")
    networks: tuple[SimulatedNetwork, ...] = Field(
        default=(),
        max_length=8,
        description="Networks between vehicles and nodes (mode standalone; needs Linux and root). The programs of participants run"
        " in network namespaces, and reach only each other and the services of their drone.",
    )
    cluster: ClusterPart | None = None
    faults: tuple[Fault, ...] = ()
    checks: tuple[Check, ...] = ()

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        _check_vehicles(self)
        _check_mode(self)
        _check_networks(self)
        _check_faults(self)
        _check_checks(self)
        return self

    @property
    def pace(self) -> float:
        """Factor of real time. 0 means lockstep."""
        if self.speedup is not None:
            return self.speedup
        return 0.0 if self.mode == "vehicles" and not self.programs and not self.external else 1.0

    @property
    def external(self) -> bool:
        """True if a vehicle is a running autopilot outside of the experiment."""
        return any(entry.connection is not None for entry in self.vehicles)

    def setups(self) -> tuple[VehicleSetup, ...]:
        """Return all vehicles with consecutive system ids. Rows are expanded."""
        setups: list[VehicleSetup] = []
        for entry in self.vehicles:
            for index, name in enumerate(entry.names()):
                setups.append(VehicleSetup(name, len(setups) + 1, entry, _row_position(entry, index)))
        return tuple(setups)


def load(path: Path) -> Experiment:
    """Read an experiment file.

    Raises:
        InvalidObject: The file is missing, is not YAML, or has an invalid field that the message names.
    """
    try:
        content, positions = parse_document(path.read_bytes(), str(path))
    except OSError as error:
        raise InvalidObject("", f"cannot read {path}: {error.strerror}") from None
    except BadDocument as error:
        raise InvalidObject("", str(error)) from None
    try:
        return parse(content)
    except InvalidObject as error:
        raise InvalidObject("", f"{positions.where(content, error.field)}: {error}") from None


def parse(content: object) -> Experiment:
    """Create an experiment from parsed YAML.

    Raises:
        InvalidObject: A field is invalid. The message names the field.
    """
    try:
        return Experiment.model_validate(content)
    except ValidationError as error:
        raise _unknown_tag(error) or InvalidObject.from_pydantic(error) from None


def _unknown_tag(error: ValidationError) -> InvalidObject | None:
    """Return the error for an unknown fault, check or step. Return None for other validation errors."""
    detail = error.errors(include_url=False)[0]
    context = detail.get("ctx", {})
    field = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in detail["loc"]).lstrip(".")
    name = str(context.get("discriminator", "")).strip("'")
    if detail["type"] == "union_tag_not_found":
        return InvalidObject(f"{field}.{name}", "is missing; `fractus experiment schema` lists the possible values")
    if detail["type"] != "union_tag_invalid":
        return None
    known = [tag.strip(" '") for tag in str(context["expected_tags"]).split(",")]
    near = difflib.get_close_matches(str(context["tag"]), known, n=1)
    hint = f"did you mean {near[0]}?" if near else f"possible values: {', '.join(known)}"
    return InvalidObject(f"{field}.{name}", f"unknown value {context['tag']}; {hint}")


def _row_position(entry: VehicleEntry, index: int) -> VehicleHome | None:
    """Return the home of a vehicle of a row by its index in the row."""
    if entry.home is None or index == 0:
        return entry.home
    bearing = math.radians(entry.bearing)
    start = Place.from_degrees(entry.home.lat, entry.home.lon, entry.home.alt)
    distance_m = index * entry.spacing
    place = start.offset(distance_m * math.cos(bearing), distance_m * math.sin(bearing))
    return VehicleHome(lat=place.lat_e7 / 1e7, lon=place.lon_e7 / 1e7, alt=entry.home.alt)


def _check_vehicles(experiment: Experiment) -> None:
    names = [name for entry in experiment.vehicles for name in entry.names()]
    duplicates = sorted({name for name in names if names.count(name) > 1})
    if duplicates:
        raise InvalidObject("vehicles", f"the name {duplicates[0]} is used twice; names must be unique")
    if len(names) > MAX_VEHICLES:
        raise InvalidObject("vehicles", f"{len(names)} vehicles; the maximum is {MAX_VEHICLES}")
    for index, entry in enumerate(experiment.vehicles):
        starts_elsewhere = entry.connection is not None and experiment.mode == "vehicles"
        if entry.home is None and not starts_elsewhere and experiment.mode != "cluster":
            raise InvalidObject(
                f"vehicles[{index}].home", f"is required in mode {experiment.mode}: the start position of {entry.name}"
            )
        if entry.home is not None and starts_elsewhere:
            raise InvalidObject(
                f"vehicles[{index}].home", "cannot be set for a running autopilot in mode vehicles; remove it"
            )
        if entry.connection is not None and experiment.mode == "cluster":
            raise InvalidObject(
                f"vehicles[{index}].connection",
                "is not supported in mode cluster; the cluster starts the vehicle of each drone",
            )
        if entry.task and experiment.mode != "vehicles":
            raise InvalidObject(
                f"vehicles[{index}].task",
                f"is only supported in mode vehicles; in mode {experiment.mode} applications fly the drone",
            )
        if entry.camera and experiment.mode != "standalone":
            raise InvalidObject(f"vehicles[{index}].camera", "is only supported in mode standalone")


def _check_mode(experiment: Experiment) -> None:
    mode = experiment.mode
    if (experiment.cluster is not None) != (mode == "cluster"):
        raise InvalidObject("cluster", "is required in mode cluster and not supported in other modes")
    if bool(experiment.manifests) != (mode == "standalone"):
        raise InvalidObject("manifests", "are required in mode standalone and not supported in other modes")
    if mode == "cluster" and (experiment.speedup not in {None, 1.0} or experiment.programs):
        raise InvalidObject("", "mode cluster runs in real time and programs are pods; remove speedup and programs")
    if experiment.speedup == 0 and (mode != "vehicles" or experiment.programs or experiment.external):
        raise InvalidObject(
            "speedup", "0 (lockstep) is only supported in mode vehicles without programs and connections"
        )
    names = {name for entry in experiment.vehicles for name in entry.names()}
    for index, program in enumerate(experiment.programs):
        if mode == "vehicles":
            if program.vehicle is None:
                raise InvalidObject(f"programs[{index}].vehicle", f"is required in mode {mode}")
            _check_known(f"programs[{index}].vehicle", [program.vehicle], names, "vehicle")
        elif program.component is None:
            raise InvalidObject(f"programs[{index}].component", f"is required in mode {mode}")


def _check_networks(experiment: Experiment) -> None:
    if experiment.mode != "standalone" and (experiment.nodes or experiment.networks):
        field = "nodes" if experiment.nodes else "networks"
        raise InvalidObject(
            field, "are only supported in mode standalone; mode cluster has its nodes and radio in its file"
        )
    nodes = [node.name for node in experiment.nodes]
    vehicles = [name for entry in experiment.vehicles for name in entry.names()]
    for field, names in (
        ("nodes", [*vehicles, *nodes]),
        ("networks", [network.name for network in experiment.networks]),
        *((f"networks[{index}].participants", each.participants) for index, each in enumerate(experiment.networks)),
    ):
        duplicates = sorted({name for name in names if names.count(name) > 1})
        if duplicates:
            raise InvalidObject(field, f"the name {duplicates[0]} is used twice; names must be unique")
    for index, network in enumerate(experiment.networks):
        _check_known(f"networks[{index}].participants", network.participants, [*vehicles, *nodes], "vehicle or node")
    for index, program in enumerate(experiment.programs):
        if program.node is not None:
            _check_known(f"programs[{index}].node", [program.node], nodes, "node")


def _check_faults(experiment: Experiment) -> None:
    names = {name for entry in experiment.vehicles for name in entry.names()}
    for index, fault in enumerate(experiment.faults):
        field = f"faults[{index}]"
        _check_known(f"{field}.vehicles", fault.vehicles, names, "vehicle")
        if isinstance(fault, LinkLoss) and fault.link not in {None, LINK_OF_MODE[experiment.mode]}:
            raise InvalidObject(
                f"{field}.link",
                f"{fault.link} does not exist in mode {experiment.mode}; use {LINK_OF_MODE[experiment.mode]}",
            )
        if isinstance(fault, NodePowerOff):
            if experiment.mode == "vehicles":
                raise InvalidObject(f"{field}.fault", "nodePowerOff needs a node; use mode standalone or cluster")
            if fault.node is not None and experiment.mode != "cluster":
                raise InvalidObject(f"{field}.node", "is only supported in mode cluster; use `vehicles`")


def _check_checks(experiment: Experiment) -> None:
    names = {name for entry in experiment.vehicles for name in entry.names()}
    zones = {zone.name for zone in experiment.zones}
    programs = {program.name for program in experiment.programs}
    fault_kinds = {fault.fault for fault in experiment.faults}
    for index, check in enumerate(experiment.checks):
        field = f"checks[{index}]"
        if isinstance(check, VehicleCheck):
            _check_known(f"{field}.vehicles", check.vehicles, names, "vehicle")
        if isinstance(check, OutsideZone | InsideZone):
            _check_known(f"{field}.zone", [check.zone], zones, "zone")
        if isinstance(check, ProgramEnded):
            _check_known(f"{field}.program", [check.program], programs, "program")
        if isinstance(check, CallJudged) and experiment.mode == "vehicles":
            raise InvalidObject(f"{field}.check", "call is only supported in modes standalone and cluster")
        if isinstance(check, ApplicationPhase) and experiment.mode != "cluster":
            raise InvalidObject(f"{field}.check", "phase is only supported in mode cluster")
        if isinstance(check, TaskDone) and not any(entry.task for entry in experiment.vehicles):
            raise InvalidObject(f"{field}.check", "task: no vehicle has a task")
        if isinstance(check, DataSent) and check.level != "autopilot" and not experiment.networks:
            raise InvalidObject(f"{field}.level", f"{check.level} is only measured with `networks`")
        if isinstance(check, DataSent) and experiment.mode != "standalone":
            raise InvalidObject(f"{field}.check", "dataSent is only supported in mode standalone")
        if isinstance(check, Detections) and not any(entry.camera for entry in experiment.vehicles):
            raise InvalidObject(f"{field}.check", "detections needs a vehicle with a camera (mode standalone)")
        after = getattr(check, "after", None)
        if after is not None:
            _check_known(f"{field}.after", [after], fault_kinds, "fault")


def _check_known(field: str, names: Iterable[str], known: Iterable[str], kind: str) -> None:
    """Check that names exist.

    Raises:
        InvalidObject: A name is unknown. The message lists the known names.
    """
    for name in names:
        if name not in known:
            raise InvalidObject(field, f"unknown {kind} {name}; known: {', '.join(sorted(known)) or 'none'}")
