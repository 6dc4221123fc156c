"""Grant and NodeGrants: everything that a node needs to enforce policies without the API server."""

from __future__ import annotations

import base64
import binascii
import json
import lzma
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from fractus_core.api.components import (
    ComponentClass,
    ContactLoss,
    ControlPoint,
    ControlScope,
    PointsOfInterest,
    ServiceRequest,
)
from fractus_core.api.geometry import Area, Point, Position
from fractus_core.api.methods import Interface, Service
from fractus_core.api.model import AGE, Conditions, InvalidObject, Model, ObservedGeneration, OpenModel, Resource, keyed
from fractus_core.api.names import component_identity, is_subdomain
from fractus_core.api.policies import PolicySpec, ZoneShape


class GrantedZone(ZoneShape):
    """A zone of a granted policy with its geometry, so that the node can enforce it offline."""

    name: str = Field(description="Name of the Zone.")


class GrantedPolicy(Model):
    """A policy that applies to the instance, with its zones resolved."""

    name: str = Field(description="Name of the Policy.")
    spec: PolicySpec
    selected: bool = Field(
        default=False,
        description="True if the application selected spec.action; false if spec.action is the default of the Policy.",
    )
    selected_land_at: Point | None = Field(
        default=None,
        description="Landing place that the application selected; unset: spec.landAt is the landing place of the Policy.",
    )
    zones: tuple[GrantedZone, ...] = Field(
        default=(),
        description="Zones of spec.selector.zones with their areas; empty if the policy applies everywhere.",
    )

    @model_validator(mode="after")
    def _resolved(self) -> Self:
        """Reject a policy if the area of one of its zones is missing. Such a zone would restrict nothing."""
        missing = sorted(set(self.spec.selector.zones) - {zone.name for zone in self.zones})
        if missing:
            raise InvalidObject(
                "zones", f"policy {self.name} selects {', '.join(missing)}; add the area of each selected zone"
            )
        return self


class ApplicationReference(Model):
    """Reference to an application. The uid distinguishes it from other applications of the same name."""

    namespace: str = Field(description="Namespace of the application.")
    name: str = Field(description="Name of the application.")
    uid: str = Field(description="metadata.uid of the application.")


class GrantedLimits(Model):
    """Performance limits of the airframe."""

    max_altitude: float = Field(gt=0, description="Maximum altitude in metres above home.")
    max_speed: float = Field(gt=0, description="Maximum ground speed in metres per second.")


class GrantSpec(Model):
    """The policy configuration of one component instance on one node."""

    node: str = Field(description="Name of the node whose services the instance may call.")
    application: ApplicationReference
    component: str = Field(description="Name of the component.")
    instance: str = Field(description="Name of the instance, unique in the namespace.")
    class_: ComponentClass | None = Field(
        default=None,
        alias="class",
        description="Class of a drone component: driver (commands the drone) or passenger (does not); unset for other nodes.",
    )
    control: ControlScope | None = Field(
        default=None,
        description="Control of a driver: full (the whole flight) or partial (only at its control points).",
    )
    control_points: tuple[ControlPoint, ...] = Field(
        default=(), description="Control points of the driver, in flight order."
    )
    points_of_interest: PointsOfInterest | None = None
    tour: tuple[Position, ...] = Field(
        default=(),
        description="Positions that the system visits in this order before it returns home: the mission of an application"
        " without a driver. Empty: a driver flies, or the application shares the flight of another application.",
    )
    services: tuple[ServiceRequest, ...] = Field(
        default=(), description="System services that the instance may call, with the methods."
    )
    operation_area: tuple[Area, ...] = Field(
        default=(),
        description="Area in which services may be used; required on a drone. Empty: no bounds (fixed nodes).",
    )
    corridor: tuple[Area, ...] = Field(
        default=(), description="Area in which the drone may fly between its depot and the operation area."
    )
    depot: Point | None = None
    home: Position | None = None
    limits: GrantedLimits | None = None
    awaits: tuple[str, ...] = Field(
        default=(),
        max_length=50,
        description="Components that are not ready yet, for a driver or a tour of an application with start: whenReady. The drone"
        " does not take off for the mission while there are any.",
    )
    policies: tuple[GrantedPolicy, ...] = Field(default=(), description="Policies that apply to the instance.")
    contact_lost: ContactLoss | None = Field(
        default=None,
        description="Reaction when the drone loses contact with the API server; unset: the mission continues.",
    )
    mission: str | None = Field(
        default=None,
        max_length=253,
        description="Identifier of the mission, set when the Grant is signed. The drone stores finished missions, so a new"
        " mission needs a new identifier.",
    )
    issued_at: datetime | None = Field(
        default=None,
        description="Time of signing. If there are several Grants for an instance, the latest one applies.",
    )

    @property
    def identity(self) -> str:
        """SPIFFE ID of the instance."""
        return component_identity(self.application.namespace, self.application.name, self.component, self.instance)

    @property
    def unsigned(self) -> Self:
        """The specification without the fields that signing adds."""
        return self.model_copy(update={"mission": None, "issued_at": None})

    @property
    def mission_key(self) -> str:
        """Identifier of the mission.

        The identifier contains the identity of the instance, so a Grant cannot name the mission of another instance.
        """
        return f"{self.identity}#{self.mission or ''}"

    @property
    def unbounded(self) -> str:
        """Reason why no drone may fly under the Grant; empty if the flight is bounded.

        A missing operation area must not allow flight anywhere, so unlimited flight needs an explicit, large area.
        """
        flies = self.class_ or ("tour" if self.tour else "")
        return f"a {flies} needs operationArea" if flies and not self.operation_area else ""

    @property
    def begins_mission(self) -> bool:
        """True if the drone takes off for the instance: a driver, or a passenger whose points of interest the system visits."""
        return self.class_ == "driver" or bool(self.tour)

    @property
    def awaited(self) -> str:
        """Reason why the mission must not begin yet; empty if it may."""
        names = ", ".join(self.awaits)
        return f"the mission begins when all components are ready; not ready: {names}" if names else ""

    def interfaces(self, service: Service) -> frozenset[Interface]:
        """Return the protocols over which the instance may call a service: gRPC unless the Grant lists others."""
        listed: frozenset[Interface] = frozenset(
            interface for s in self.services if s.service == service for interface in s.interfaces
        )
        return listed or frozenset(("grpc",))

    def methods(self, service: str) -> frozenset[str]:
        """Return the granted methods of a service. A driver may always get and return control."""
        granted = {m for s in self.services if s.service == service for m in s.methods}
        if service == "mobility" and self.class_ == "driver":
            granted |= {"GetControl", "ReturnControl"}
        return frozenset(granted)


GrantPhase = Literal["Pending", "Active", "Complete", "Revoked", "Failed"]
ENDED: frozenset[GrantPhase] = frozenset({"Complete", "Revoked", "Failed"})
"""Final phases. The phase of a Grant does not change after one of these phases."""


class ReportedWaypoints(OpenModel):
    """Numbers of waypoints of a mission that has ended, or of its points of interest."""

    reached: int = Field(ge=0, description="Waypoints to which the drone flew.")
    skipped: int = Field(ge=0, description="Waypoints whose legs were refused, or that the driver omitted.")
    corrected: int = Field(ge=0, description="Reached waypoints whose target or speed a policy corrected.")


_WAYPOINTS = "Numbers of reached, skipped and corrected waypoints, after the end of the mission. Missing if the service has not reported them."


class ReportedPictures(OpenModel):
    """Numbers of pictures that the components of an Application requested from the camera of the drone."""

    taken: int = Field(ge=0, description="Pictures that were taken.")
    refused: int = Field(ge=0, description="Requests that a policy or the rights of the component refused.")


_PICTURES = "Pictures that the Application requested from the drone's camera until the end of the mission. Missing without a request."


class GrantStatus(OpenModel):
    """State of the Grant on its node."""

    phase: GrantPhase | None = Field(
        default=None,
        description="Pending until the node has stored the Grant; then the state of its mission.",
    )
    message: str | None = Field(default=None, description="Human-readable explanation.")
    waypoints: ReportedWaypoints | None = Field(default=None, description=_WAYPOINTS)
    pictures: ReportedPictures | None = Field(default=None, description=_PICTURES)
    observed_generation: ObservedGeneration = None
    conditions: Conditions = ()


class Grant(Resource, plural="grants", short="fgr", written_by_operator=True, selectable=(".spec.node",)):
    """The policy configuration of one component instance on one node."""

    COLUMNS = (
        ("Node", "string", ".spec.node"),
        ("Application", "string", ".spec.application.name"),
        ("Component", "string", ".spec.component"),
        ("Phase", "string", ".status.phase"),
        AGE,
    )

    kind: Literal["Grant"] = "Grant"
    spec: GrantSpec
    status: GrantStatus | None = None


NODE_GRANTS_NAMESPACE = "fractus-nodes"
"""Namespace of the NodeGrants objects. The service account of a node may read only the object of this node."""

MAX_UNPACKED_BYTES = 64 * 2**20
"""Maximum size of the Grants of a node as JSON.

Compression reduces this size to about 1 %, because Grants share zones.
"""
MAX_PACKED_BYTES = 2**20
"""Maximum length of the packed text. The rest of the etcd object limit is left for the status."""
MAX_MESSAGE = 1024
PACKED_METADATA = ("name", "uid", "generation", "labels", "annotations")
"""Metadata fields of a Grant that are packed. Changes of other fields do not change the packed text."""

_FIELD = "spec.packed"
_MEMORY_BYTES = 128 * 2**20
_LEVEL = 1
"""Compression level of xz. Higher levels take several times as long and save a few per cent."""


class NodeGrantsSpec(OpenModel):
    """All Grants of the node."""

    # Unknown fields are ignored, because an older agent reads objects of a newer operator.
    count: int = Field(ge=0, description="Number of Grants.")
    packed: str = Field(
        description="The Grants without their status: a JSON list sorted by name, xz-compressed, base64-encoded."
    )


class ReportedGrant(OpenModel):
    """State of one Grant on the node, as in the status of the Grant."""

    uid: str = Field(max_length=128, description="metadata.uid of the Grant.")
    name: str = Field(max_length=253, description="Name of the Grant.")
    phase: GrantPhase = Field(description="Pending until the node has stored the Grant; then the state of its mission.")
    message: str = Field(default="", max_length=MAX_MESSAGE, description="Human-readable explanation.")
    waypoints: ReportedWaypoints | None = Field(default=None, description=_WAYPOINTS)
    pictures: ReportedPictures | None = Field(default=None, description=_PICTURES)
    observed_generation: Annotated[
        int, Field(ge=0, description="metadata.generation of the Grant that this state describes.")
    ]


class NodeGrantsStatus(OpenModel):
    """State of the Grants as reported by the agent. The operator copies it to the Grants."""

    observed_generation: ObservedGeneration = None
    grants: Annotated[tuple[ReportedGrant, ...], Field(json_schema_extra=keyed("uid"))] = Field(
        default=(), description="State of each Grant that the agent knows."
    )


class NodeGrants(Resource, plural="nodegrants", short="fng", namespaced=True, written_by_operator=True):
    """The Grants of one node. The object is named after the node, and its agent can read no other."""

    COLUMNS = (("Grants", "integer", ".spec.count"), AGE)

    kind: Literal["NodeGrants"] = "NodeGrants"
    spec: NodeGrantsSpec
    status: NodeGrantsStatus | None = None


def pack(bodies: Iterable[Mapping[str, Any]]) -> str:
    """Pack Grants for `NodeGrantsSpec.packed`. The result does not depend on their order.

    Packing takes about 2 ms per Grant of 31 kB, so pack many Grants in a thread.

    Args:
        bodies: Grants as returned by the API server.

    Raises:
        InvalidObject: The Grants exceed MAX_UNPACKED_BYTES, or MAX_PACKED_BYTES when packed.
    """
    grants = [
        {
            "apiVersion": body["apiVersion"],
            "kind": body["kind"],
            "metadata": {key: body["metadata"][key] for key in PACKED_METADATA if key in body["metadata"]},
            "spec": body["spec"],
        }
        for body in sorted(bodies, key=_name)
    ]
    text = json.dumps(grants, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    if len(text) > MAX_UNPACKED_BYTES:
        raise InvalidObject(_FIELD, f"would hold {len(text)} bytes, more than {MAX_UNPACKED_BYTES}")
    packed = base64.b64encode(lzma.compress(text, preset=_LEVEL)).decode()
    if len(packed) > MAX_PACKED_BYTES:
        raise InvalidObject(_FIELD, f"would have {len(packed)} bytes, more than {MAX_PACKED_BYTES}")
    return packed


def pack_oldest(bodies: Sequence[Mapping[str, Any]]) -> tuple[str, int]:
    """Pack the Grants of a node. If not all of them fit, pack the oldest ones.

    Keeping the oldest Grants means that revoked Grants always leave the node and that new Grants have to wait.

    Returns:
        The packed text and the number of packed Grants.
    """
    oldest = sorted(bodies, key=lambda body: (str(body["metadata"].get("creationTimestamp", "")), _name(body)))
    packed = ""
    fit = 0
    count = len(oldest)
    too_many = count + 1
    while True:
        try:
            packed = pack(oldest[:count])
            fit = count
        except InvalidObject:
            too_many = count
        if too_many - fit <= 1:
            return packed or pack(()), fit
        count = (fit + too_many) // 2


def _name(body: Mapping[str, Any]) -> str:
    return str(body["metadata"]["name"])


def unpack(packed: str, count: int) -> tuple[dict[str, Any], ...]:
    """Unpack the Grants of `NodeGrantsSpec.packed`.

    Args:
        packed: Text made by `pack`.
        count: Expected number of Grants.

    Raises:
        InvalidObject: The text is damaged, exceeds MAX_UNPACKED_BYTES, or holds another number of Grants.
    """
    try:
        # The output limit bounds the memory, regardless of the compression ratio.
        unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_MEMORY_BYTES)
        text = unpacker.decompress(base64.b64decode(packed, validate=True), MAX_UNPACKED_BYTES)
        if not unpacker.eof:
            reason = "is cut short" if unpacker.needs_input else f"holds more than {MAX_UNPACKED_BYTES} bytes"
            raise InvalidObject(_FIELD, f"{reason}; the operator writes it again")
        grants = json.loads(text)
    except (binascii.Error, lzma.LZMAError, ValueError, RecursionError) as error:
        if isinstance(error, InvalidObject):
            raise
        raise InvalidObject(_FIELD, f"cannot be unpacked ({error}); the operator writes it again") from None
    if not isinstance(grants, list) or not all(_has_identity(body) for body in grants):
        raise InvalidObject(_FIELD, "is not a list of Grants; the operator writes it again")
    if len(grants) != count:
        raise InvalidObject(
            _FIELD, f"holds {len(grants)} Grants, not the {count} of spec.count; the operator writes it again"
        )
    return tuple(grants)


def _has_identity(body: Any) -> bool:
    """Return True if a body has a uid, and a name that is safe as a file name."""
    metadata = body.get("metadata") if isinstance(body, dict) else None
    if not isinstance(metadata, dict):
        return False
    name = metadata.get("name")
    return isinstance(name, str) and is_subdomain(name) and isinstance(metadata.get("uid"), str)
