"""DirectLink: an ad hoc link that a drone may have with another node, and the traffic that may take it (thesis 8.6)."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from fractus_core.api.components import Heuristic
from fractus_core.api.geometry import Position
from fractus_core.api.model import AGE, Conditions, ObservedGeneration, OpenModel, Resource
from fractus_core.api.nodes import CONDITIONS_BY_TYPE, Pairing, Technology
from fractus_core.api.plans import ApplicationReference

LINKED = "Linked"
"""Condition of the drone's agent: whether the link is up, or why not."""
TRAFFIC_DIRECT = "TrafficDirect"
"""Condition of the drone's agent: whether the traffic takes the link, or why not."""
PEER_READY = "PeerReady"
"""Condition of the other node's agent: whether it takes the drone's calls, or why not."""


class VirtualAddress(OpenModel):
    """Where clients call a service: the address and port of its Service, which never change."""

    address: str = Field(max_length=45, description="The Service's cluster IP.")
    port: int = Field(ge=1, le=65535, description="The Service's port.")
    protocol: Literal["TCP", "UDP"] = Field(default="TCP", description="What it speaks.")


class TargetAddress(OpenModel):
    """Where the pod on the other node listens."""

    address: str = Field(max_length=45, description="The pod's IP.")
    port: int = Field(ge=1, le=65535, description="The pod's port.")


class Caller(OpenModel):
    """An instance on the drone that may call a service."""

    instance: str = Field(description="Name of the instance that calls.")
    address: str | None = Field(default=None, max_length=45, description="Its pod's IP; unset while there is none.")


class LinkedService(OpenModel):
    """A port of a hybrid component that the drone's components can reach over the link."""

    component: str = Field(description="The component that provides it.")
    instance: str = Field(description="Its instance on the node that is asked.")
    virtual: VirtualAddress
    target: TargetAddress | None = Field(default=None, description="Unset while no pod of the instance is ready.")
    callers: tuple[Caller, ...] | None = Field(
        default=None,
        description="Who on the drone may call it over the link; unset where the component names no caller, and all may.",
    )


class DirectLinkSpec(OpenModel):
    """Which two nodes may link, how they find each other, and what for."""

    # Open: an agent reads what a newer operator writes.
    drone: str = Field(description="The node that asks for the link: its agent decides when.")
    node: str = Field(description="The node that is asked.")
    application: ApplicationReference
    technology: Technology = Field(description="Of the two interfaces.")
    pairing: Pairing = Field(description="Of the node that is asked: the drone joins its network.")
    range: float = Field(gt=0, description="Metres that the link reaches: the lesser reach of the two interfaces.")
    bandwidth: float = Field(gt=0, description="Mbit/s that the link offers well inside its range, in each direction.")
    position: Position = Field(description="Of the node that is asked.")
    heuristic: Heuristic = Field(description="What makes one path better than another for the traffic.")
    path: tuple[Position, ...] = Field(
        default=(),
        description="The waypoints that the drone flies in this order; empty where it moves freely in a region.",
    )
    services: tuple[LinkedService, ...] = Field(
        default=(), description="What the drone's components call over the link."
    )


class DirectLinkStatus(OpenModel):
    """What became of the link; the drone's agent writes it, but for the condition PeerReady."""

    observed_generation: ObservedGeneration = None
    phase: Literal["Idle", "Connecting", "Up"] | None = Field(default=None, description="How far the link is.")
    traffic: Literal["cloud", "direct"] | None = Field(default=None, description="Which path the traffic takes.")
    reason: str | None = Field(default=None, description="CamelCase reason of the last decision, for programs.")
    message: str | None = Field(default=None, description="The last decision in one sentence, for people.")
    bandwidth: float | None = Field(default=None, ge=0, description="Mbit/s measured on the link last.")
    latency: float | None = Field(default=None, ge=0, description="Milliseconds one way, measured on the link last.")
    switches: int | None = Field(default=None, ge=0, description="How often the traffic changed its path.")
    last_switch: datetime | None = Field(default=None, description="When it last did.")
    conditions: Conditions = Field(default=(), json_schema_extra=CONDITIONS_BY_TYPE)


class DirectLink(
    Resource, plural="directlinks", short="dlk", written_by_operator=True, selectable=(".spec.drone", ".spec.node")
):
    """An ad hoc link between a drone and another node: the operator says who may link, the drone's agent when."""

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
