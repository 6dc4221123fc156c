"""DirectLink: an ad hoc link between a drone and another node, and the services that use it (thesis 8.6)."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from fractus_core.api.components import Heuristic
from fractus_core.api.geometry import Position
from fractus_core.api.grants import ApplicationReference
from fractus_core.api.model import AGE, Conditions, ObservedGeneration, OpenModel, Resource
from fractus_core.api.nodes import CONDITIONS_BY_TYPE, Pairing, Technology

LINKED = "Linked"
"""Condition set by the drone's agent: True if the link is up."""
TRAFFIC_DIRECT = "TrafficDirect"
"""Condition set by the drone's agent: True if the traffic uses the link."""
PEER_READY = "PeerReady"
"""Condition set by the agent of the other node: True if it accepts the drone's connections."""


class VirtualAddress(OpenModel):
    """Stable address of a service for its clients: the cluster IP and port of its Service."""

    address: str = Field(max_length=45, description="Cluster IP of the Service.")
    port: int = Field(ge=1, le=65535, description="Port of the Service.")
    protocol: Literal["TCP", "UDP"] = Field(default="TCP", description="Transport protocol (TCP or UDP).")


class TargetAddress(OpenModel):
    """Address of the pod on the other node."""

    address: str = Field(max_length=45, description="IP address of the pod.")
    port: int = Field(ge=1, le=65535, description="Port of the pod.")


class CallerAddress(OpenModel):
    """An instance on the drone that may call a service over the link."""

    instance: str = Field(description="Name of the calling instance.")
    address: str | None = Field(
        default=None,
        max_length=45,
        description="IP address of the pod of the instance; unset if the pod has no address yet.",
    )


class LinkedService(OpenModel):
    """A port of a hybrid component that is reachable over the link."""

    component: str = Field(description="Component that provides the service.")
    instance: str = Field(description="Instance of the component on the other node.")
    virtual: VirtualAddress
    target: TargetAddress | None = Field(
        default=None, description="Address of a ready pod of the instance; unset while there is none."
    )
    callers: tuple[CallerAddress, ...] | None = Field(
        default=None,
        description="Instances on the drone that may call the service; unset if the component does not restrict its callers.",
    )


class DirectLinkSpec(OpenModel):
    """The two nodes of the link, their network settings, and the services that use it."""

    # Unknown fields are ignored, because an older agent reads objects of a newer operator.
    drone: str = Field(description="Name of the drone, whose agent sets up the link.")
    node: str = Field(description="Name of the other node, which accepts the link.")
    application: ApplicationReference
    technology: Technology = Field(description="Network technology of both interfaces.")
    pairing: Pairing = Field(description="Network settings of the other node, which the drone joins.")
    range: float = Field(gt=0, description="Range in metres: the smaller range of the two interfaces.")
    bandwidth: float = Field(gt=0, description="Bandwidth in Mbit/s and direction at good reception.")
    position: Position = Field(description="Position of the other node.")
    heuristic: Heuristic = Field(description="Rule that selects the path of the traffic (cloud or direct).")
    path: tuple[Position, ...] = Field(
        default=(),
        description="Planned waypoints of the drone in order; empty if the drone flies freely in a region.",
    )
    services: tuple[LinkedService, ...] = Field(
        default=(), description="Services on the other node that components on the drone may call over the link."
    )


class DirectLinkStatus(OpenModel):
    """State of the link. The drone's agent writes it, except for the condition PeerReady."""

    observed_generation: ObservedGeneration = None
    phase: Literal["Idle", "Connecting", "Up"] | None = Field(default=None, description="State of the link.")
    traffic: Literal["cloud", "direct"] | None = Field(default=None, description="Current path of the traffic.")
    reason: str | None = Field(default=None, description="Machine-readable CamelCase reason for the last decision.")
    message: str | None = Field(default=None, description="Human-readable explanation of the last decision.")
    bandwidth: float | None = Field(default=None, ge=0, description="Last measured bandwidth of the link in Mbit/s.")
    latency: float | None = Field(
        default=None, ge=0, description="Last measured one-way latency of the link in milliseconds."
    )
    switches: int | None = Field(default=None, ge=0, description="Number of path changes of the traffic.")
    last_switch: datetime | None = Field(default=None, description="Time of the last path change.")
    conditions: Conditions = Field(default=(), json_schema_extra=CONDITIONS_BY_TYPE)


class DirectLink(
    Resource, plural="directlinks", short="dlk", written_by_operator=True, selectable=(".spec.drone", ".spec.node")
):
    """An ad hoc link between a drone and another node. The operator plans it, and the drone's agent sets it up."""

    COLUMNS = (
        ("Drone", "string", ".spec.drone"),
        ("Node", "string", ".spec.node"),
        ("Phase", "string", ".status.phase"),
        ("Traffic", "string", ".status.traffic"),
        ("Reason", "string", ".status.reason"),
        AGE,
    )

    kind: Literal["DirectLink"] = "DirectLink"
    spec: DirectLinkSpec
    status: DirectLinkStatus | None = None
